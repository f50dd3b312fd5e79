#pragma once

#include <memory>
#include <utility>
#include <vector>

#include "svort_ros/live/candidate_source.h"
#include "svort_ros/network/checkpoint.h"
#include "svort_ros/network/incremental_live_network.h"

namespace svort {

/// The live network's opinion on each new slice, as candidates for registration: "network", from where the slice is
/// predicted, and "network image", from where the first network puts the slice by its image.
class NetworkCandidates : public CandidateSource {
 public:
  /// Loads the weights that the options name.
  /// @throws std::invalid_argument naming the option that is out of range, or a network that is not the live network
  /// @throws std::runtime_error naming the file of weights and what is wrong with it
  explicit NetworkCandidates(const NetworkEstimatorOptions& options);
  /// With a network that is there already.
  NetworkCandidates(const NetworkEstimatorOptions& options, const NetworkInstance& network, const Checkpoint& about);

  std::vector<PoseCandidate> propose(const SliceSequence& sequence, std::size_t position,
                                     IncrementalRefinement& engine) override;
  void move_frame(const Pose& T_new_old) override { network_->move_frame(T_new_old); }
  void reset() override;
  std::size_t take_encoded() override { return network_->take_encoded(); }
  EstimatorNotes notes() const override { return notes_; }

 private:
  NetworkCandidates(const NetworkEstimatorOptions& options, std::pair<NetworkInstance, Checkpoint> loaded);
  std::unique_ptr<IncrementalLiveNetwork> fresh() const;

  NetworkEstimatorOptions options_;
  AcquisitionFormulation formulation_;
  std::shared_ptr<LiveNetwork> module_;
  std::unique_ptr<IncrementalLiveNetwork> network_;
  EstimatorNotes notes_;
};

}  // namespace svort
