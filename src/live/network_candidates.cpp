#include "svort_ros/live/network_candidates.h"

#include <torch/types.h>

#include <optional>
#include <stdexcept>
#include <utility>

#include "estimator_network.h"
#include "svort_ros/geometry/rigid_fit.h"
#include "svort_ros/live/network_input.h"
#include "svort_ros/live/sequence_tensors.h"

namespace svort {
namespace {

constexpr const char* kWho = "estimator.network.candidate";
constexpr double kSameMm = 0.5;  // registration from a start that is as close to the prediction ends where it does

}  // namespace

NetworkCandidates::NetworkCandidates(const NetworkEstimatorOptions& options)
    : NetworkCandidates(options, load_estimator_network(options, kWho)) {}

NetworkCandidates::NetworkCandidates(const NetworkEstimatorOptions& options,
                                     std::pair<NetworkInstance, Checkpoint> loaded)
    : NetworkCandidates(options, loaded.first, loaded.second) {}

NetworkCandidates::NetworkCandidates(const NetworkEstimatorOptions& options, const NetworkInstance& network,
                                     const Checkpoint& about)
    : options_(options),
      formulation_(network_formulation(options)),
      module_(std::dynamic_pointer_cast<LiveNetwork>(network.module)),
      notes_(network_notes(network, about)) {
  if (!module_)
    throw std::invalid_argument(std::string(kWho) + ": the network is '" + network.name +
                                "'; only 'live' can be asked about one slice after another");
  require_cpu(options, kWho);
  if (options.precision != "float32" && options.precision != "bfloat16")
    throw std::invalid_argument("estimator.network.precision is '" + options.precision + "'; with " + kWho +
                                " it may be float32 or bfloat16");
  module_->set_precision(options.precision == "bfloat16" ? torch::kBFloat16 : torch::kFloat32);
  network_ = fresh();
}

std::unique_ptr<IncrementalLiveNetwork> NetworkCandidates::fresh() const {
  try {
    return std::make_unique<IncrementalLiveNetwork>(module_, options_.cache, formulation_,
                                                    network_iterations(options_));
  } catch (const std::invalid_argument& error) {
    throw std::invalid_argument(std::string("estimator.network.cache: ") + error.what());
  }
}

std::vector<PoseCandidate> NetworkCandidates::propose(const SliceSequence& sequence, std::size_t position,
                                                      IncrementalRefinement& engine) {
  const PreparedSlice& slice = *sequence.slices().at(position);
  network_->insert(position, pixel_tensor(slice)[0][0], slice.resolution, slice.info.thickness);

  const torch::Tensor volume = engine.volume();
  if (!volume.defined()) return {};
  std::vector<Pose> T_engine_crop;
  for (const RefinedSlice& each : engine.slices()) T_engine_crop.push_back(each.T_brain_slice);
  network_->refresh(position, T_engine_crop, volume, engine.voxel_mm());
  if (!engine.compares()) return {};
  const NetworkPlaces places =
      network_->place(position, network_geometry(sequence), T_engine_crop, volume, engine.voxel_mm());
  std::vector<PoseCandidate> candidates;
  const double half_field_mm = 0.5 * slice.size * slice.resolution;
  const auto add = [&](const char* name, const std::optional<Pose>& place) {
    if (place && plane_distance(*place, T_engine_crop[position], half_field_mm) > kSameMm)
      candidates.push_back({name, *place});
  };
  add("network", places.from_start);
  add("network image", places.from_first);
  return candidates;
}

void NetworkCandidates::reset() { network_ = fresh(); }

}  // namespace svort
