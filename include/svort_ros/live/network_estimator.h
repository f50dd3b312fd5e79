#pragma once

#include <memory>
#include <string>
#include <utility>
#include <vector>

#include "svort_ros/live/nominal_estimator.h"
#include "svort_ros/network/checkpoint.h"
#include "svort_ros/network/network_runner.h"

namespace svort {

/// Poses from a network that sees all slices at once (SVoRT, the live network, the baselines).
///
/// It runs at the end of the scan, or causally at every arrival over the slices that are here. Until it has run, poses
/// are nominal; a slice that arrives after the end of a scan makes them all nominal again until the next end. The brain
/// frame is then the one that the network was trained in: the change counts as a frame revision, not as motion.
class NetworkEstimator : public NominalEstimator {
 public:
  /// Loads the weights that the options name.
  /// @throws std::invalid_argument naming the option that is out of range
  /// @throws std::runtime_error naming the file of weights and what is wrong with it
  explicit NetworkEstimator(const EstimatorOptions& options);
  /// With a network that is there already.
  NetworkEstimator(const EstimatorOptions& options, NetworkInstance network, const Checkpoint& about);

  void add(const SliceSequence& sequence) override;
  void finalise(const SliceSequence& sequence, const std::atomic<bool>* stop) override;
  void reset() override;
  std::string device() const override { return runner_.device(); }
  EstimatorNotes notes() const override;

 private:
  NetworkEstimator(const EstimatorOptions& options, std::pair<NetworkInstance, Checkpoint> loaded);
  void run_network(const SliceSequence& sequence);

  bool every_arrival_ = false;
  int iterations_ = 0;
  NetworkGrid grid_;
  AcquisitionFormulation formulation_;
  EstimatorNotes notes_;
  NetworkRunner runner_;
  bool poses_are_the_networks_ = false;
};

}  // namespace svort
