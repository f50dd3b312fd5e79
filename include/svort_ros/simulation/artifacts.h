#pragma once

#include <Eigen/Core>
#include <array>
#include <cstdint>
#include <vector>

#include "svort_ros/simulation/scanner.h"

namespace svort {

/// What goes wrong between brain and image. Shares are probabilities per slice unless said otherwise.
struct ArtifactOptions {
  double noise_min = 0.005;         ///< Rician noise: deviation of its two channels, of the brain's brightest tissue
  double noise_max = 0.05;          ///< the same, largest; drawn per scan
  double noisy_share = 0.04;        ///< slices with much more noise
  double noisy_factor = 4.;         ///< so many times more
  double bias = 0.15;               ///< bias field: deviation of the log of the gain's terms at 60 mm
  double void_share = 0.03;         ///< slices with a signal void although the head rests
  double void_speed = 25.;          ///< mm/s: a head this fast makes a void with a probability of 63 %
  double void_whole_share = 0.4;    ///< share of the voids that darken the whole slice
  double void_size_min_mm = 6.;     ///< deviation of a local void
  double void_size_max_mm = 25.;    ///< deviation of a local void
  double void_depth_min = 0.4;      ///< share of the signal that is lost at its centre
  double void_depth_max = 1.;       ///< the same, largest
  double gamma = 0.12;              ///< contrast jitter: deviation of the log of the exponent, per scan
  double stack_scale = 0.1;         ///< intensity scale per stack: deviation of its log
  double slice_scale = 0.04;        ///< intensity scale per slice: deviation of its log
  double drop_share = 0.02;         ///< slices that never arrive
  double mask_lost_share = 0.02;    ///< slices whose mask is empty
  double mask_cut_share = 0.05;     ///< slices whose mask ends at a straight line through the brain
  double mask_eroded_share = 0.08;  ///< slices whose mask is too small
  double mask_erosion_mm = 4.;      ///< by up to so much

  template <class Visitor>
  void visit(Visitor&& v) {
    v("noise_min", noise_min, "Rician noise: deviation of its two channels, of the brightest tissue; drawn per scan");
    v("noise_max", noise_max, "the same, largest");
    v("noisy_share", noisy_share, "share of slices with much more noise");
    v("noisy_factor", noisy_factor, "how many times more");
    v("bias", bias, "bias field: deviation of the log of the gain's terms at 60 mm from the centre");
    v("void_share", void_share, "share of slices with a signal void although the head rests");
    v("void_speed", void_speed, "a head of this speed makes a void with a probability of 63 %, mm/s");
    v("void_whole_share", void_whole_share, "share of the voids that darken the whole slice");
    v("void_size_min_mm", void_size_min_mm, "smallest deviation of a local void, mm");
    v("void_size_max_mm", void_size_max_mm, "largest deviation of a local void, mm");
    v("void_depth_min", void_depth_min, "smallest share of the signal that is lost");
    v("void_depth_max", void_depth_max, "largest share of the signal that is lost");
    v("gamma", gamma, "contrast jitter: deviation of the log of the exponent, per scan");
    v("stack_scale", stack_scale, "intensity scale per stack: deviation of its log");
    v("slice_scale", slice_scale, "intensity scale per slice: deviation of its log");
    v("drop_share", drop_share, "share of slices that never arrive");
    v("mask_lost_share", mask_lost_share, "share of slices whose mask is empty");
    v("mask_cut_share", mask_cut_share, "share of slices whose mask ends at a straight line through the brain");
    v("mask_eroded_share", mask_eroded_share, "share of slices whose mask is too small");
    v("mask_erosion_mm", mask_erosion_mm, "by up to so much, mm");
  }
};

/// Perfect images.
ArtifactOptions no_artifacts();

/// @throws std::invalid_argument naming the option that is out of range
void check(const ArtifactOptions& options);

/// A quadratic in the plane of a slice: c0 + cu u + cv v + cuu u^2 + cuv u v + cvv v^2, u and v in mm.
using PlaneQuadratic = std::array<double, 6>;

/// What happens to one slice. Positions are in slice coordinates, mm.
struct SliceArtifacts {
  bool dropped = false;  ///< never arrives
  bool mask_lost = false;
  bool mask_cut = false;
  Eigen::Vector2d cut_normal = Eigen::Vector2d::UnitX();  ///< brain beyond the line is cut off
  double cut_offset = 0.;                                 ///< of the line from the brain's centre, mm
  double erosion_mm = 0.;
  bool noisy = false;
  double noise = 0.;  ///< deviation of each channel
  double gain = 1.;   ///< scale of stack and slice
  bool voided = false;
  double whole_loss = 0.;                                 ///< share of the signal lost everywhere
  double local_loss = 0.;                                 ///< share lost at the void's centre
  Eigen::Vector2d void_centre = Eigen::Vector2d::Zero();  ///< from the brain's centre in the slice, mm
  Eigen::Matrix2d void_shape = Eigen::Matrix2d::Zero();   ///< inverse covariance, 1/mm^2
};

/// What happens to one scan.
struct ScanArtifacts {
  double gamma = 1.;
  Eigen::Vector3d bias_slope = Eigen::Vector3d::Zero();      ///< of the log of the gain, 1/mm, scanner frame
  Eigen::Matrix3d bias_curvature = Eigen::Matrix3d::Zero();  ///< 1/mm^2
  std::vector<SliceArtifacts> slices;                        ///< one per acquired slice of the plan

  /// Log of the gain in the plane of a slice.
  PlaneQuadratic log_bias(const Pose& T_scanner_slice) const;
};

/// Draws what happens to the slices of a plan. Fast motion makes voids.
/// @throws std::invalid_argument naming the option that is out of range
ScanArtifacts draw_artifacts(const ArtifactOptions& options, const ScanPlan& plan, std::uint64_t seed,
                             std::uint64_t scan);

}  // namespace svort
