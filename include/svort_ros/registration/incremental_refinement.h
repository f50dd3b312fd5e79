#pragma once

#include <torch/types.h>

#include <cstddef>
#include <memory>
#include <string>
#include <vector>

#include "svort_ros/geometry/pose.h"
#include "svort_ros/registration/pose_refinement.h"

namespace svort {

/// What is done for each slice that arrives.
struct IncrementalOptions {
  int window = 16;                 ///< slices that are registered together: the newest, and the sweep's
  int passes = 1;                  ///< times that the newest window is registered at each of its three levels of blur
  int sweeps = 1;                  ///< older windows that are registered again per arrival, one after another
  double candidate_margin = 0.02;  ///< a start other than the prediction must correlate better by this
  bool find_lost = true;           ///< look far away for a slice that does not fit where the head was
  double moved_mm = 0.02;          ///< slices that moved less keep their terms in the volume, mm

  template <class Visitor>
  void visit(Visitor&& v) {
    v("window", window, "slices that are registered together");
    v("passes", passes, "times that the newest window is registered at each level of blur");
    v("sweeps", sweeps, "older windows that are registered again per arrival");
    v("candidate_margin", candidate_margin, "a start other than the prediction must correlate better by this");
    v("find_lost", find_lost, "look far away for a slice that does not fit where the head was");
    v("moved_mm", moved_mm, "slices that moved less keep their terms in the volume, mm");
  }
};

/// @throws std::invalid_argument naming the option that is out of range
void validate(const IncrementalOptions& options);

/// One slice for IncrementalRefinement.
struct IncrementalSlice {
  torch::Tensor pixels;                   ///< h x w, float32, CPU; any unit, the same for all slices
  torch::Tensor mask;                     ///< h x w, bool; where the brain is
  Pose T_world_slice = Pose::Identity();  ///< nominal pose, mm, in any one frame
  int stack = 0;
  double thickness_mm = 3.;  ///< FWHM
};

/// Where a new slice may be.
struct PoseCandidate {
  std::string name;  ///< for the records, e.g. "prediction"
  Pose T_brain_slice = Pose::Identity();
};

/// refine_poses() for a sequence that grows: what has been computed for earlier slices is kept, and the work per slice
/// does not grow with their number.
///
/// The volume is a sum over slices; the terms of those that moved are replaced. A new slice is registered alone, from
/// each candidate, to the volume of the others; then the newest slices together, as one piece of the head's trajectory,
/// with the slices around them held. Sweeps do the same for older windows, one after another.
///
/// One resolution, the middle one of refine_poses() (2 mm, or RefinementOptions::finest_mm if that is coarser), at
/// three levels of blur. The same calls give the same bytes, for any number of threads. Not thread-safe: one owner.
class IncrementalRefinement {
 public:
  /// @param resolution_mm pixel size of the slices
  /// @param volume_size_mm edge of the cube around the brain frame's origin in which slices see each other
  /// @throws std::invalid_argument naming the option that is out of range
  IncrementalRefinement(const RefinementOptions& refinement, const IncrementalOptions& options, double resolution_mm,
                        double volume_size_mm);
  ~IncrementalRefinement();

  /// Takes in a slice; it is not part of the volume until refine_newest().
  /// @param position its place in acquisition order, 0 .. count()
  /// @param bright   intensity of bright tissue (0.99 quantile), in the slices' unit
  void insert(std::size_t position, const IncrementalSlice& slice, const Pose& T_brain_slice, double bright);

  /// Whether choose() compares candidates now: there is a volume, and more than one stack.
  bool compares() const;

  /// PSF reconstruction of the slices that take part, weighted, at their poses; a cube centred on the brain frame's
  /// origin. Undefined while none does. Do not write to it.
  /// @return d x d x d, float32, in the slices' unit
  torch::Tensor volume();
  /// Its voxel size. Known once there is a slice.
  double voxel_mm() const;

  /// Registers the slice alone to the others' volume, from each candidate; sets its pose to the best and says which.
  /// The first candidate wins unless another one correlates better by candidate_margin. Without a volume the first one
  /// is taken as it is.
  const PoseCandidate& choose(std::size_t position, const std::vector<PoseCandidate>& candidates);

  /// For a slice that choose() has placed and that correlates less than slices usually do: looks for it in the volume
  /// of the others, alone over turns of up to 45 degrees, and with up to seven slices before it, as of a head at rest,
  /// over turns of up to 80. It goes where it correlates clearly better, by more the farther that is. If it fits
  /// nowhere, it is lost: its weight is 0 until refinement brings it back. Needs 6 slices across the first stack.
  /// @return slices that were moved, the last one at `position`
  std::size_t find_lost(std::size_t position);

  /// Registers the slices around `position` together.
  void refine_around(std::size_t position);

  /// Registers the next window of the sweep. @return mean motion of its slices, mm
  double sweep();
  /// Windows in one whole sweep.
  std::size_t windows() const;

  /// Sets every slice's sigma_mm as it stands; moves nothing.
  void measure_uncertainty();

  /// All poses anew, e.g. after refine_poses() or in a new frame.
  void set(const std::vector<RefinedSlice>& slices);

  std::size_t count() const;
  /// In acquisition order.
  const std::vector<RefinedSlice>& slices() const;
  /// Slices whose terms in the volume were replaced since the last call.
  std::size_t take_replaced();

 private:
  class Engine;
  std::unique_ptr<Engine> engine_;
};

}  // namespace svort
