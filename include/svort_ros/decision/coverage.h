#pragma once

#include <Eigen/Core>
#include <array>
#include <cstdint>
#include <vector>

#include "svort_ros/decision/slice_quality.h"
#include "svort_ros/geometry/image_grid.h"

namespace svort {

/// When a part of the brain counts as seen well; docs/reacquisition.md explains the quantities.
struct CoverageOptions {
  double resolution_mm = 4.;  ///< voxel size of the coverage volume
  int planned_stacks = 3;     ///< stacks of the protocol; while fewer have begun, accordingly less is expected
  double views = 2.;          ///< slices, each counted by its quality, that must have seen a place by the end
  /// And views that show it sharply in whichever direction is seen worst: 0 with one orientation, however many slices.
  double sharp_views = 1.;
  double well = 0.8;             ///< a place is seen well from this share of both on
  double complete = 0.95;        ///< the scan is complete when this share of the brain is seen well
  double hull_quantile = 0.999;  ///< share of the brain pixels inside the brain's hull; lower it if masks are wild

  template <class Visitor>
  void visit(Visitor&& v) {
    v("resolution_mm", resolution_mm, "voxel size of the coverage volume, mm");
    v("planned_stacks", planned_stacks, "stacks of the protocol; while fewer have begun, less is expected");
    v("views", views, "slices, counted by their quality, that must have seen a place by the end");
    v("sharp_views", sharp_views, "the same for the direction that is seen worst: needs two orientations");
    v("well", well, "a place is seen well from this share of both on, 0 .. 1");
    v("complete", complete, "the scan is complete when this share of the brain is seen well, 0 .. 1");
    v("hull_quantile", hull_quantile, "share of the brain pixels that lie inside the brain's hull, 0 .. 1");
  }
};

/// @throws std::invalid_argument naming the option that is out of range
void validate(const CoverageOptions& options);

/// What a place should have by now.
struct CoverageTarget {
  double views = 2.;
  double sharp_views = 1.;
};
/// The full target, or that after `stacks` of the planned ones.
CoverageTarget coverage_target(const CoverageOptions& options, int stacks);

/// Sum over the slices that see a place: quality x slice profile x n n', n the slice's normal. Symmetric: xx xy xz yy
/// yz zz. Its trace counts the views; trace minus largest eigenvalue counts the sharp ones in the worst direction.
using ViewTensor = std::array<float, 6>;
void add_view(ViewTensor* tensor, const Eigen::Vector3d& normal, double amount);
double view_count(const ViewTensor& tensor);
/// 1 with one orientation, 3 with three orthogonal ones alike: tr^2 / tr(A^2). 0 without views.
double orientation_count(const ViewTensor& tensor);
/// 0 (not seen) .. 1 (target reached): mean of the reached shares of both targets.
double place_score(const ViewTensor& tensor, const CoverageTarget& target);

/// A connected part of the brain that is not seen well.
struct CoverageGap {
  Eigen::Vector3d centre = Eigen::Vector3d::Zero();  ///< its deepest place, brain frame, mm
  double width_mm = 0.;                              ///< diameter of the largest ball that fits into it
  double volume_ml = 0.;
};

/// The brain as a volume of places, and how well each is seen.
struct CoverageMap {
  ImageGrid grid;                   ///< in the brain frame
  std::vector<std::uint8_t> brain;  ///< 1 inside the brain's hull
  std::vector<ViewTensor> views;    ///< 0 off the brain
  std::vector<float> score;         ///< place_score() against what is expected by now
  std::size_t places = 0;           ///< ones in `brain`
  double brain_mm3 = 0.;            ///< volume of the hull
  int stacks = 0;                   ///< orientations of the protocol that have begun
  CoverageTarget target;            ///< expected by now
  double mean_score = 0.;           ///< over the brain, against `target`
  double seen_well = 0.;            ///< share of the brain, against `target`
  double complete = 0.;             ///< share of the brain that is seen well against the full target
  double mean_orientations = 0.;    ///< orientation_count() over the brain
  std::vector<CoverageGap> gaps;    ///< against `target`, largest first

  bool empty() const { return places == 0; }
  /// Scores as a volume, 0 off the brain.
  Volume score_volume() const;
  /// orientation_count() as a volume.
  Volume orientation_volume() const;
};

/// How much a slice at distance `z_mm` of its plane sees of a place: its profile, so that gapless slices add up to 1.
double profile_weight(double z_mm, double thickness_mm);

/// @param quality last updated with this estimate; its scores weigh the slices. Slices of weight 0 do not count.
/// @param stacks  stacks of the protocol that have begun; repeated ones not counted
CoverageMap measure_coverage(const Estimate& estimate, const QualityMonitor& quality, int stacks,
                             const CoverageOptions& options);

}  // namespace svort
