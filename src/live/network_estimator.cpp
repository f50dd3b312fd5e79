#include "svort_ros/live/network_estimator.h"

#include <cmath>
#include <sstream>
#include <stdexcept>
#include <utility>

#include "estimator_network.h"
#include "svort_ros/geometry/rigid_transform.h"
#include "svort_ros/live/network_input.h"

namespace svort {
namespace {

bool runs_at_every_arrival(const NetworkEstimatorOptions& options) {
  if (options.when == "every_arrival") return true;
  if (options.when == "scan_end") return false;
  throw std::invalid_argument("estimator.network.when is '" + options.when + "'; known: scan_end, every_arrival");
}

RunnerOptions runner_options(const NetworkEstimatorOptions& options) { return {options.device, options.precision}; }

NetworkGrid network_grid(const EstimatorOptions& options) {
  const double resolution = options.network.volume_resolution_mm;
  if (!(resolution >= 0.2 && resolution <= 10.)) {
    std::ostringstream message;
    message << "estimator.network.volume_resolution_mm is " << resolution << "; it must be from 0.2 to 10 mm";
    throw std::invalid_argument(message.str());
  }
  const auto voxels = static_cast<std::int64_t>(std::lround(options.volume_size_mm / resolution));
  return {{voxels, voxels, voxels}, resolution};
}

}  // namespace

NetworkEstimator::NetworkEstimator(const EstimatorOptions& options)
    : NetworkEstimator(options, load_estimator_network(options.network, "estimator.method 'network'")) {}

NetworkEstimator::NetworkEstimator(const EstimatorOptions& options, std::pair<NetworkInstance, Checkpoint> loaded)
    : NetworkEstimator(options, std::move(loaded.first), loaded.second) {}

NetworkEstimator::NetworkEstimator(const EstimatorOptions& options, NetworkInstance network, const Checkpoint& about)
    : NominalEstimator(options),
      every_arrival_(runs_at_every_arrival(options.network)),
      iterations_(network_iterations(options.network)),
      grid_(network_grid(options)),
      formulation_(network_formulation(options.network)),
      notes_(network_notes(network, about)),
      runner_(std::move(network), runner_options(options.network)) {}

void NetworkEstimator::add(const SliceSequence& sequence) {
  if (!every_arrival_) {
    const bool back_to_nominal = poses_are_the_networks_;
    NominalEstimator::add(sequence);
    if (back_to_nominal) {
      make_nominal();
      ++estimate_.frame_revision;
      poses_are_the_networks_ = false;
    }
    return;
  }
  const bool frame_is_the_networks = poses_are_the_networks_;
  const std::uint64_t frame_revision = estimate_.frame_revision;
  NominalEstimator::add(sequence);
  // The base moves its own frame with the brain's centre; nobody sees that frame once the network has spoken.
  if (frame_is_the_networks) estimate_.frame_revision = frame_revision;
  run_network(sequence);
}

void NetworkEstimator::finalise(const SliceSequence& sequence, const std::atomic<bool>* stop) {
  if (!every_arrival_) run_network(sequence);
  NominalEstimator::finalise(sequence, stop);
}

void NetworkEstimator::reset() {
  NominalEstimator::reset();
  poses_are_the_networks_ = false;
}

EstimatorNotes NetworkEstimator::notes() const {
  EstimatorNotes notes = notes_;
  if (!runner_.diagnostic().empty()) notes.warnings.push_back(runner_.diagnostic());
  return notes;
}

void NetworkEstimator::run_network(const SliceSequence& sequence) {
  const SequenceInput prepared = network_input(sequence, runner_.network().common_frame);
  NetworkRun run;
  run.iterations = iterations_;
  run.formulation = formulation_;
  const NetworkStep result = runner_.run(prepared.input, grid_, run).back();
  // Weights count relative to each other (those of SVoRT have the mean 1); an estimate's go from 0 to 1.
  torch::Tensor weights = result.weights;
  if (weights.defined()) weights = weights / weights.max().clamp_min(1.);
  for (std::size_t i = 0; i < estimate_.slices.size(); ++i) {
    SliceEstimate& slice = estimate_.slices[i];
    const auto row = static_cast<std::int64_t>(i);
    slice.T_brain_slice = pose_from_tensor(result.transforms[row]) * prepared.T_slice_window[i].inverse();
    slice.T_scanner_brain = slice.info.T_scanner_slice * slice.T_brain_slice.inverse();
    if (weights.defined()) slice.weight = weights[row].item<double>();
    slice.status = PoseStatus::network;
  }
  if (!poses_are_the_networks_) ++estimate_.frame_revision;
  poses_are_the_networks_ = true;
  estimate_.encoded = estimate_.slices.size();
}

}  // namespace svort
