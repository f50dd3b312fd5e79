#pragma once

#include <cstdint>
#include <limits>
#include <string>
#include <vector>

#include "svort_ros/registration/registration_input.h"

namespace svort {

struct RefinementOptions {
  double finest_mm = 1.;         ///< pixel and voxel size of the last level; 2 is four times faster and less accurate
  double step_mm = 0.7;          ///< expected head motion from one slice to the next; raise it for a restless head
  double jump_mm = 2.0;          ///< motion between two slices that is taken for a jump, and no longer smoothed away
  double stack_gap_factor = 3.;  ///< how much freer the head is between stacks than within; 0: stacks are independent
  double lever_mm = 40.;         ///< distance from the centre at which rotations are measured, about a head's radius
  double image_scale = 0.12;     ///< Cauchy scale of intensity differences, as part of the 0.99 quantile
  double image_trust = 0.005;    ///< independent measurements per mm^2 of slice; lower it if poses follow noise
  /// The same, as a factor, while there is one stack: its slices hardly overlap, and would gather where they look
  /// alike.
  double one_stack_trust = 0.4;
  double largest_step_mm = 3.;  ///< bound of one Gauss-Newton step of a slice
  double convergence_mm = 0.1;  ///< converged when the mean motion of the last pass is below this
  double outlier_ncc = 0.3;     ///< a slice that correlates less with the volume gets weight 0
  int stack_passes = 3;         ///< volumes reconstructed in the stack stage; 0 skips it
  int trajectory_passes = 3;    ///< volumes reconstructed per level of the trajectory stage

  template <class Visitor>
  void visit(Visitor&& v) {
    v("finest_mm", finest_mm, "pixel and voxel size of the last level, mm");
    v("step_mm", step_mm, "expected head motion from one slice to the next, mm");
    v("jump_mm", jump_mm, "motion between two slices that is no longer smoothed away, mm");
    v("stack_gap_factor", stack_gap_factor, "how much freer the head is between stacks; 0: stacks are independent");
    v("lever_mm", lever_mm, "distance from the centre at which rotations are measured, mm");
    v("image_scale", image_scale, "Cauchy scale of intensity differences, as part of the 0.99 quantile");
    v("image_trust", image_trust, "independent measurements per mm^2 of slice");
    v("one_stack_trust", one_stack_trust, "factor of image_trust while there is one stack only");
    v("largest_step_mm", largest_step_mm, "bound of one Gauss-Newton step of a slice, mm");
    v("convergence_mm", convergence_mm, "converged when the mean motion of the last pass is below this, mm");
    v("outlier_ncc", outlier_ncc, "a slice that correlates less with the volume gets weight 0");
    v("stack_passes", stack_passes, "volumes reconstructed in the stack stage; 0 skips it");
    v("trajectory_passes", trajectory_passes, "volumes reconstructed per level of the trajectory stage");
  }
};

/// How much refine_poses() does.
enum class RefinementEffort {
  full,  ///< from the coarsest level on: start poses may be centimetres off
  warm,  ///< one volume for each of the two middle levels: start poses come from an earlier refinement
};

/// What refinement knows about one slice.
struct RefinedSlice {
  Pose T_brain_slice = Pose::Identity();
  double ncc = 0.;     ///< correlation with the slice simulated from the volume, over its mask; NaN if it has no pixels
  double weight = 1.;  ///< in the reconstruction: ncc^4, or 0 for an outlier
  double gain = 1.;    ///< slice = gain x simulated + offset
  double offset = 0.;
  std::string reason;  ///< why the weight is 0; empty otherwise
  /// Expected error of the pose relative to the others (root mean square, rotations at the lever), mm, if the image's
  /// noise is what is left of the differences and all else is right. It is not: see docs/live.md. NaN if unknown.
  double sigma_mm = std::numeric_limits<double>::quiet_NaN();
};

struct RefinementReport {
  bool converged = false;
  double last_motion_mm = 0.;  ///< mean motion of the slices in the last pass
  int passes = 0;              ///< volumes reconstructed
  double first_cost = 0.;      ///< mean robust image cost per pixel at the start and end of the last level
  double last_cost = 0.;
};

struct Refinement {
  std::vector<RefinedSlice> slices;
  RefinementReport report;
};

/// Registers slices to the volume that they form together, without any trained weights.
///
/// Stack stage: one rigid motion per stack. Trajectory stage: one head motion per slice; those of all slices are solved
/// together, as a random walk in acquisition order whose large steps count little (the head may jump). Both are
/// Gauss-Newton on the difference of each slice and the slice that the forward model's PSF makes of the volume,
/// with a Cauchy loss and gain and offset per slice; coarse to fine.
///
/// Only relative motion is observable: the frame is that of `start`, up to a drift of the whole.
///
/// @param start poses to start from, one per slice; usually input.T_world_slice
/// @return same bytes for any number of threads
/// @throws std::invalid_argument naming what does not fit
Refinement refine_poses(const RegistrationInput& input, const std::vector<Pose>& start,
                        const RefinementOptions& options = {}, RefinementEffort effort = RefinementEffort::full);

/// Levels of refine_by_level(): stacks, then slices blurred by 6, 4 and 2 mm.
constexpr std::size_t kRefinementLevels = 4;

/// One short run of refine_poses(), coarse to fine, and where it stands after each level: where images pull slices, for
/// whoever decides how far to follow them. 2 mm pixels, or RefinementOptions::finest_mm if that is coarser.
///
/// @return kRefinementLevels + 1 entries of one RefinedSlice per slice. The first is `start` itself, with the
///         correlations that it has at the coarsest level; sigma_mm is not set
/// @throws std::invalid_argument naming what does not fit
std::vector<std::vector<RefinedSlice>> refine_by_level(const RegistrationInput& input, const std::vector<Pose>& start,
                                                       const RefinementOptions& options = {});

/// @throws std::invalid_argument naming the option that is out of range
void validate(const RefinementOptions& options);

/// Weighted PSF reconstruction, the volume that refinement registers to.
///
/// @param poses, weights one per slice
/// @param voxel_mm edge of a voxel; the volume is a cube of `size` voxels centred on the frame's origin
/// @param fading   fade where less was seen than half of what one stack without gaps shows, so that the brain does not
///                 grow by the width of the PSF
/// @return size x size x size, float32
torch::Tensor reconstruct_weighted(const RegistrationInput& input, const std::vector<Pose>& poses,
                                   const std::vector<double>& weights, std::int64_t size, double voxel_mm,
                                   bool fading = false);

}  // namespace svort
