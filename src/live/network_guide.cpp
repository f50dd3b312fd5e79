#include "svort_ros/live/network_guide.h"

#include <stdexcept>
#include <utility>

#include "estimator_network.h"
#include "svort_ros/geometry/rigid_transform.h"
#include "svort_ros/live/network_input.h"
#include "svort_ros/live/sequence_tensors.h"

namespace svort {
namespace {

constexpr const char* kWho = "estimator.network.guide";

std::pair<NetworkInstance, Checkpoint> load(const NetworkEstimatorOptions& options) {
  require_cpu(options, kWho);
  return load_estimator_network(options, kWho);
}

}  // namespace

NetworkGuide::NetworkGuide(const NetworkEstimatorOptions& options) {
  const auto [network, about] = load(options);
  *this = NetworkGuide(network, about);
}

NetworkGuide::NetworkGuide(const NetworkInstance& network, const Checkpoint& about)
    : network_(std::dynamic_pointer_cast<LiveNetwork>(network.module)), notes_(network_notes(network, about)) {
  if (!network_)
    throw std::invalid_argument(std::string(kWho) + ": the network is '" + network.name +
                                "'; only 'live' can guide registration");
  network_->eval();
}

NetworkGuide::Encoded NetworkGuide::encoded(const SliceSequence& sequence) {
  std::map<std::shared_ptr<const PreparedSlice>, Encoded> kept;
  std::vector<torch::Tensor> features, reduced;
  for (const auto& slice : sequence.slices()) {
    auto found = encoded_.find(slice);
    if (found == encoded_.end()) {
      const torch::Tensor pixels = pixel_tensor(*slice);
      Encoded row = {network_->encode(pixels, slice->resolution), {}};
      // A copy: where nothing is averaged, the slice's own memory would be kept.
      row.reduced = network_->reduce(pixels, slice->resolution).clone();
      found = encoded_.emplace(slice, std::move(row)).first;
      ++count_;
    }
    features.push_back(found->second.features);
    reduced.push_back(found->second.reduced);
    kept.insert(*found);
  }
  encoded_ = std::move(kept);
  return {torch::cat(features), torch::cat(reduced)};
}

std::vector<Pose> NetworkGuide::place(const SliceSequence& sequence) {
  const torch::NoGradGuard no_grad;
  const NetworkInput input = network_geometry(sequence);
  return poses_from_tensor(network_->place(encoded(sequence).features, input));
}

NetworkGuide::Frame NetworkGuide::find_frame(const SliceSequence& sequence, const std::vector<Pose>& T_brain_crop) {
  const torch::NoGradGuard no_grad;
  if (T_brain_crop.size() != sequence.slices().size())
    throw std::invalid_argument("NetworkGuide::find_frame: " + std::to_string(T_brain_crop.size()) + " poses for " +
                                std::to_string(sequence.slices().size()) + " slices");
  NetworkInput input = network_geometry(sequence);
  // Around the middle of the slices' centres, about where the brain's is: what the network is trained on.
  Eigen::Vector3d low = T_brain_crop.front().translation(), high = low;
  for (const Pose& pose : T_brain_crop) {
    low = low.cwiseMin(pose.translation());
    high = high.cwiseMax(pose.translation());
  }
  Pose T_centred_brain = Pose::Identity();
  T_centred_brain.translation() = -0.5 * (low + high);
  std::vector<Pose> T_centred_crop;
  for (const Pose& pose : T_brain_crop) T_centred_crop.push_back(T_centred_brain * pose);
  input.transforms = tensor_from_poses(T_centred_crop);
  const Encoded slices = encoded(sequence);
  const LiveFrame frame = network_->find_frame(slices.features, slices.reduced, input);
  return {pose_from_tensor(frame.motion) * T_centred_brain, frame.agreement};
}

std::size_t NetworkGuide::take_encoded() { return std::exchange(count_, 0); }

std::vector<std::vector<Pose>> registration_starts(const RegistrationInput& input, NetworkGuide* guide,
                                                   const SliceSequence& sequence) {
  std::vector<std::vector<Pose>> starts;
  if (guide != nullptr) starts.push_back(guide->place(sequence));
  starts.push_back(input.T_world_slice);
  return starts;
}

}  // namespace svort
