#pragma once

#include <torch/types.h>

#include <cstddef>
#include <map>
#include <memory>
#include <vector>

#include "svort_ros/geometry/pose.h"
#include "svort_ros/live/incremental_estimator.h"
#include "svort_ros/network/checkpoint.h"
#include "svort_ros/network/live_network.h"
#include "svort_ros/registration/registration_input.h"
#include "svort_ros/sequence/slice_sequence.h"

namespace svort {

/// Of the network's votes, at least so many must fit one frame for it to be the canonical one.
constexpr double kFrameAgreement = 0.4;

/// The live network beside registration, without its shared part: it places slices by what they show, coarsely, but
/// without losing a head that jumps; and it knows where the brain's canonical frame is.
///
/// A slice is encoded once, when it is first asked about. Runs on the CPU. The same calls give the same answers. Not
/// thread-safe: one owner.
class NetworkGuide {
 public:
  /// Loads the weights that the options name.
  /// @throws std::invalid_argument naming the option that is out of range, or a network that is not the live network
  /// @throws std::runtime_error naming the file of weights and what is wrong with it
  explicit NetworkGuide(const NetworkEstimatorOptions& options);
  /// With a network that is there already.
  NetworkGuide(const NetworkInstance& network, const Checkpoint& about);

  /// Where the slices lie as far as the network alone can tell, from the scanner's poses: T_canonical_crop, off by a
  /// centimetre.
  /// @return one pose per slice of the sequence, of its crop
  std::vector<Pose> place(const SliceSequence& sequence);

  struct Frame {
    Pose T_canonical_brain = Pose::Identity();
    double agreement = 0.;  ///< share of the network's votes that it fits, see vote_agreement()
  };
  /// The canonical frame, from slices that have been registered to each other.
  /// @param T_brain_crop one pose per slice of the sequence, of its crop, in any one frame
  Frame find_frame(const SliceSequence& sequence, const std::vector<Pose>& T_brain_crop);

  /// Times that a slice was encoded since the last call.
  std::size_t take_encoded();
  const EstimatorNotes& notes() const { return notes_; }

 private:
  struct Encoded {
    torch::Tensor features;  ///< n x dim
    torch::Tensor reduced;   ///< n x 1 x p x p, LiveNetwork::reduce()
  };
  /// Of all slices; those that have left the sequence are forgotten.
  Encoded encoded(const SliceSequence& sequence);

  std::shared_ptr<LiveNetwork> network_;
  EstimatorNotes notes_;
  /// By slice; holding it keeps its address from being given to another.
  std::map<std::shared_ptr<const PreparedSlice>, Encoded> encoded_;
  std::size_t count_ = 0;
};

/// Where register_scan() of the sequence starts: from where the guide places the slices, if there is one, and from the
/// scanner's poses.
/// @param input registration_input() of the sequence
/// @param guide may be null
std::vector<std::vector<Pose>> registration_starts(const RegistrationInput& input, NetworkGuide* guide,
                                                   const SliceSequence& sequence);

}  // namespace svort
