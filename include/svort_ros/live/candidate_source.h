#pragma once

#include <cstddef>
#include <vector>

#include "svort_ros/live/incremental_estimator.h"
#include "svort_ros/registration/incremental_refinement.h"
#include "svort_ros/sequence/slice_sequence.h"

namespace svort {

/// Somebody beside the head's motion who says where a new slice may be. Registration tries it, and the images decide.
class CandidateSource {
 public:
  virtual ~CandidateSource() = default;

  /// Called once per slice, when it is in the engine with its predicted pose.
  /// @param position of the slice, in the sequence and in the engine
  /// @return in the engine's frame; empty if there is nothing to say, or if the engine would not compare them
  virtual std::vector<PoseCandidate> propose(const SliceSequence& sequence, std::size_t position,
                                             IncrementalRefinement& engine) = 0;
  /// All of the engine's poses have moved together.
  virtual void move_frame(const Pose& T_new_old) = 0;
  /// The scan is over.
  virtual void reset() = 0;
  /// Times that a network encoded a slice since the last call.
  virtual std::size_t take_encoded() = 0;
  virtual EstimatorNotes notes() const = 0;
};

}  // namespace svort
