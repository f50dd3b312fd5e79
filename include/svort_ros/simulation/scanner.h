#pragma once

#include <Eigen/Core>
#include <cstdint>
#include <string>
#include <vector>

#include "svort_ros/geometry/pose.h"
#include "svort_ros/simulation/fetal_motion.h"
#include "svort_ros/simulation/random_stream.h"

namespace svort {

/// What the simulated scanner acquires. Ranges are drawn from uniformly, once per scan unless said otherwise.
struct ScannerOptions {
  /// "scanner": stacks are roughly orthogonal and share the scanner's frame, the head lies in it in any orientation,
  /// as in live use. "uniform": each stack has an orientation of its own, uniform on SO(3), and its nominal poses say
  /// nothing about the other stacks (the paper's protocol).
  std::string protocol = "scanner";
  int stacks_min = 1;             ///< stacks
  int stacks_max = 6;             ///< stacks
  int slices_min = 15;            ///< slices per stack; within the limits, as many as cover the brain
  int slices_max = 30;            ///< slices per stack
  int spare_slices = 3;           ///< up to so many more than cover the brain, per stack
  double thickness_min_mm = 2.5;  ///< slice thickness
  double thickness_max_mm = 3.5;  ///< slice thickness
  double gap_max = 0.1;           ///< gap between slices, up to this share of the thickness
  int interleave_min = 2;         ///< acquisition order: every interleave-th slice, then the next pass
  int interleave_max = 3;         ///< acquisition order
  double tr_min_s = 1.;           ///< time between slices
  double tr_max_s = 2.;           ///< time between slices
  double pause_max_s = 10.;       ///< pause between stacks, drawn for each, s
  double planned_share = 0.7;     ///< share of scans planned on the head's axes; the others on the scanner's axes
  double tilt_deg = 8.;           ///< deviation of a stack from the axes it is planned on, per axis, degrees
  double offset_mm = 4.;          ///< deviation of a stack's centre from the brain's, per axis, mm
  double reversed_share = 0.5;    ///< share of stacks whose slices are counted against their normal
  double displaced_mm = 5.;       ///< a slice is displaced if the head moved by more since its stack was planned
  double prefix_share = 0.;       ///< share of scans that are cut at a random slice, in acquisition order
  int prefix_slices_min = 3;      ///< at least so many slices through the brain's inner part are left

  template <class Visitor>
  void visit(Visitor&& v) {
    v("protocol", protocol, "scanner (stacks share the scanner's frame) or uniform (each stack in any orientation)");
    v("stacks_min", stacks_min, "smallest number of stacks");
    v("stacks_max", stacks_max, "largest number of stacks");
    v("slices_min", slices_min, "smallest number of slices per stack");
    v("slices_max", slices_max, "largest number of slices per stack");
    v("spare_slices", spare_slices, "up to so many slices more than cover the brain");
    v("thickness_min_mm", thickness_min_mm, "thinnest slice, mm");
    v("thickness_max_mm", thickness_max_mm, "thickest slice, mm");
    v("gap_max", gap_max, "largest gap between slices, as a share of the thickness");
    v("interleave_min", interleave_min, "smallest interleave: every n-th slice, then the next pass");
    v("interleave_max", interleave_max, "largest interleave");
    v("tr_min_s", tr_min_s, "shortest time between slices, s");
    v("tr_max_s", tr_max_s, "longest time between slices, s");
    v("pause_max_s", pause_max_s, "longest pause between stacks, s");
    v("planned_share", planned_share, "share of scans planned on the head's axes, the others on the scanner's");
    v("tilt_deg", tilt_deg, "deviation of a stack from the axes it is planned on, per axis, degrees");
    v("offset_mm", offset_mm, "deviation of a stack's centre from the brain's, per axis, mm");
    v("reversed_share", reversed_share, "share of stacks whose slices are counted against their normal");
    v("displaced_mm", displaced_mm, "a slice is displaced if the head moved by more since its stack was planned, mm");
    v("prefix_share", prefix_share, "share of scans that are cut at a random slice, in acquisition order");
    v("prefix_slices_min", prefix_slices_min, "slices that are left at least when a scan is cut");
  }
};

/// @throws std::invalid_argument naming the option that is out of range
void check(const ScannerOptions& options);

/// Where a brain is in its canonical frame: the box around its mask, mm.
struct BrainExtent {
  Eigen::Vector3d centre = Eigen::Vector3d::Zero();
  Eigen::Vector3d half_size = Eigen::Vector3d::Constant(45.);
};

/// One slice of a simulated scan, before it has an image.
struct PlannedSlice {
  int stack = 0;
  int index = 0;                            ///< position within the stack
  int slices_in_stack = 0;                  ///< prescribed
  double time_s = 0.;                       ///< of acquisition, since the scan began
  Pose T_scanner_slice = Pose::Identity();  ///< nominal pose
  Pose T_stack_slice = Pose::Identity();    ///< the same in the stack's own frame: origin at its centre, z its normal
  Pose T_scanner_brain = Pose::Identity();  ///< truth: where the brain was
  double head_speed = 0.;                   ///< mm/s, see HeadTrajectory::speed()
  double head_displacement = 0.;            ///< mm, see sphere_distance(): since the slice's stack was planned
  bool displaced = false;                   ///< head_displacement above the limit

  /// Truth.
  Pose T_brain_slice() const { return T_scanner_brain.inverse() * T_scanner_slice; }
};

/// Geometry, timing and motion of a simulated scan.
struct ScanPlan {
  double thickness_mm = 0.;
  double spacing_mm = 0.;  ///< between slices
  double tr_s = 0.;        ///< between slices of a stack
  int interleave = 0;
  int stacks = 0;                      ///< prescribed
  std::size_t slices = 0;              ///< prescribed; more than `acquired.size()` if the scan is cut
  std::vector<PlannedSlice> acquired;  ///< in acquisition order
};

/// Plans stacks on the moving head and acquires them.
/// @throws std::invalid_argument naming the option that is out of range
ScanPlan plan_scan(const ScannerOptions& options, const MotionOptions& motion, const BrainExtent& brain,
                   std::uint64_t seed, std::uint64_t scan);

}  // namespace svort
