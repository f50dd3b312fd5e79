#include "svort_ros/network/incremental_live_network.h"

#include <algorithm>
#include <cmath>
#include <limits>
#include <sstream>
#include <stdexcept>
#include <string>
#include <utility>

#include "svort_ros/acquisition/geometry_of_poses.h"
#include "svort_ros/geometry/rigid_fit.h"
#include "svort_ros/geometry/rigid_transform.h"

namespace svort {
namespace {

/// Mean over the slice's own pixels of how much its simulated image changed, over the slice's mean intensity.
double change_of_view(const torch::Tensor& reduced, const torch::Tensor& before, const torch::Tensor& now) {
  const torch::Tensor brain = reduced > 0;
  const double intensity = reduced.sum().item<double>();
  if (!(intensity > 0.)) return 0.;
  return ((now - before).slice(1, 0, 1).abs() * brain).sum().item<double>() / intensity;
}

}  // namespace

void validate(const NetworkCacheOptions& options) {
  const auto require = [](bool condition, const char* name, double value, const char* range) {
    if (condition) return;
    std::ostringstream message;
    message << name << " is " << value << "; it must be " << range;
    throw std::invalid_argument(message.str());
  };
  require(options.stale_mm >= 0. && std::isfinite(options.stale_mm), "stale_mm", options.stale_mm, "zero or positive");
  require(options.stale_share >= 0. && std::isfinite(options.stale_share), "stale_share", options.stale_share,
          "zero or positive");
  require(options.refreshed >= 1 && options.refreshed <= 10000, "refreshed", options.refreshed, "from 1 to 10000");
}

IncrementalLiveNetwork::IncrementalLiveNetwork(std::shared_ptr<LiveNetwork> network, const NetworkCacheOptions& options,
                                               AcquisitionFormulation formulation, int iterations)
    : network_(std::move(network)), options_(options), formulation_(formulation), iterations_(iterations) {
  validate(options);
  if (!network_) throw std::invalid_argument("IncrementalLiveNetwork: there is no network");
  if (iterations < 0 || iterations > 100)
    throw std::invalid_argument("iterations is " + std::to_string(iterations) + "; it must be 0 to 100");
  if (iterations_ == 0) iterations_ = network_->options().iterations;
  network_->eval();
}

void IncrementalLiveNetwork::insert(std::size_t position, const torch::Tensor& pixels, double resolution_mm,
                                    double thickness_mm) {
  const torch::NoGradGuard no_grad;
  if (position > kept_.size())
    throw std::invalid_argument("IncrementalLiveNetwork::insert: position " + std::to_string(position) + " of " +
                                std::to_string(kept_.size()) + " slices");
  if (!pixels.defined() || pixels.dim() != 2)
    throw std::invalid_argument("IncrementalLiveNetwork::insert: pixels must be h x w");
  Kept kept;
  const torch::Tensor image = pixels.view({1, 1, pixels.size(0), pixels.size(1)});
  kept.reduced = network_->reduce(image, resolution_mm).contiguous();
  kept.thickness_mm = thickness_mm;
  kept.first = network_->encode(image, resolution_mm);
  ++encoded_;
  kept_.insert(kept_.begin() + static_cast<std::ptrdiff_t>(position), std::move(kept));
}

torch::Tensor IncrementalLiveNetwork::views(const std::vector<std::size_t>& slices,
                                            const std::vector<Pose>& T_volume_slice, const torch::Tensor& volume,
                                            double voxel_mm) const {
  std::vector<torch::Tensor> reduced;
  std::vector<double> thickness_mm;
  for (const std::size_t i : slices) {
    reduced.push_back(kept_[i].reduced);
    thickness_mm.push_back(kept_[i].thickness_mm);
  }
  const torch::Tensor images = torch::cat(reduced);
  // Ablation "w/o Vol": the shared network sees the slice alone.
  if (!network_->options().volume_conditioned)
    return torch::zeros({images.size(0), kLiveSimulatedChannels, images.size(2), images.size(3)}, images.options());
  return simulate_live_channels(
      images, geometry_of_poses(T_volume_slice, thickness_mm, network_->options().input_resolution_mm, voxel_mm),
      volume, voxel_mm, formulation_);
}

void IncrementalLiveNetwork::refresh(std::size_t newest, const std::vector<Pose>& T_volume_slice,
                                     const torch::Tensor& volume, double voxel_mm) {
  const torch::NoGradGuard no_grad;
  if (T_volume_slice.size() != kept_.size())
    throw std::invalid_argument("IncrementalLiveNetwork::refresh: " + std::to_string(T_volume_slice.size()) +
                                " poses for " + std::to_string(kept_.size()) + " slices");
  if (iterations_ < 2) return;
  const LiveNetworkOptions& shape = network_->options();
  const double half_field_mm = 0.5 * shape.input_px * shape.input_resolution_mm;
  std::vector<std::pair<double, std::size_t>> moved;  // by how much (negative, so that the largest comes first)
  std::vector<bool> is_stale(kept_.size(), false);
  for (std::size_t i = 0; i < kept_.size(); ++i) {
    if (i == newest) continue;
    const double mm = kept_[i].placed.defined()
                          ? plane_distance(kept_[i].T_volume_slice, T_volume_slice[i], half_field_mm)
                          : std::numeric_limits<double>::infinity();
    if (mm <= options_.stale_mm) continue;
    is_stale[i] = true;
    moved.emplace_back(-mm, i);
  }
  std::sort(moved.begin(), moved.end());
  const auto most = static_cast<std::size_t>(options_.refreshed);
  std::vector<std::size_t> seen;
  for (const auto& [negative_mm, i] : moved)
    if (seen.size() < most) seen.push_back(i);
  const std::size_t stale = seen.size();
  for (std::size_t step = 0; step < kept_.size() && seen.size() < most; ++step) {
    turn_ = (turn_ + 1) % kept_.size();
    if (turn_ != newest && !is_stale[turn_]) seen.push_back(turn_);
  }
  if (seen.empty()) return;

  std::vector<Pose> places;
  for (const std::size_t i : seen) places.push_back(T_volume_slice[i]);
  const torch::Tensor view = views(seen, places, volume, voxel_mm);
  std::vector<std::size_t> changed;
  std::vector<torch::Tensor> images, simulated;
  for (std::size_t k = 0; k < seen.size(); ++k) {
    Kept& kept = kept_[seen[k]];
    const torch::Tensor now = view.slice(0, static_cast<std::int64_t>(k), static_cast<std::int64_t>(k) + 1);
    if (k >= stale && change_of_view(kept.reduced, kept.view, now) <= options_.stale_share) continue;
    kept.view = now.clone();
    kept.T_volume_slice = places[k];
    changed.push_back(seen[k]);
    images.push_back(kept.reduced);
    simulated.push_back(kept.view);
  }
  if (changed.empty()) return;
  const torch::Tensor features = network_->encode_placed(torch::cat(images), torch::cat(simulated));
  for (std::size_t k = 0; k < changed.size(); ++k)
    kept_[changed[k]].placed = features.slice(0, static_cast<std::int64_t>(k), static_cast<std::int64_t>(k) + 1);
  encoded_ += changed.size();
}

NetworkPlaces IncrementalLiveNetwork::place(std::size_t newest, const NetworkInput& nominal,
                                            const std::vector<Pose>& T_volume_slice, const torch::Tensor& volume,
                                            double voxel_mm) {
  const torch::NoGradGuard no_grad;
  const std::size_t n = kept_.size();
  if (newest >= n || n < 2 || T_volume_slice.size() != n || nominal.transforms.size(0) != static_cast<std::int64_t>(n))
    throw std::invalid_argument("IncrementalLiveNetwork::place: slice " + std::to_string(newest) + " of " +
                                std::to_string(n) + ", which must be two at least; " +
                                std::to_string(T_volume_slice.size()) + " poses; " +
                                std::to_string(nominal.transforms.size(0)) + " prescriptions");
  const LiveNetworkOptions& shape = network_->options();
  // First network: where the whole head is in the brain's frame, and where this slice's image says that it is.
  std::vector<torch::Tensor> first;
  for (const Kept& kept : kept_) first.push_back(kept.first);
  const LiveOutput said = network_->attend(torch::cat(first), nominal);
  const PoseVotes votes = live_votes(said, nominal, shape);
  const torch::Tensor agreed = compose_transforms(pose_consensus(votes, shape.consensus), nominal.transforms);
  // The volume's frame lies in the brain's where the other slices say so.
  std::vector<Pose> in_brain, in_volume;
  for (std::size_t i = 0; i < n; ++i) {
    if (i == newest) continue;
    in_brain.push_back(pose_from_tensor(agreed[static_cast<std::int64_t>(i)]));
    in_volume.push_back(T_volume_slice[i]);
  }
  const Pose T_brain_volume = fit_planes(in_volume, in_brain, 0.5 * shape.input_px * shape.input_resolution_mm);

  // Shared network: the others as they lie, with the features they have.
  std::vector<std::int64_t> members;
  std::vector<torch::Tensor> features;
  std::vector<Pose> places;
  std::int64_t row = 0;
  for (std::size_t i = 0; i < n; ++i) {
    if (i == newest) row = static_cast<std::int64_t>(members.size());
    if (i != newest && !kept_[i].placed.defined()) continue;
    members.push_back(static_cast<std::int64_t>(i));
    features.push_back(kept_[i].placed);
    places.push_back(T_brain_volume * T_volume_slice[i]);
  }
  const torch::Tensor index = torch::tensor(members, torch::kInt64);
  NetworkInput input = nominal;
  input.slices = torch::Tensor();
  input.transforms = tensor_from_poses(places);
  input.positions = nominal.positions.index_select(0, index);
  input.slice_counts = nominal.slice_counts.index_select(0, index);
  input.times = nominal.times.index_select(0, index);
  const auto moved_from = [&](Pose T_volume_newest) -> std::optional<Pose> {
    for (int k = 1; k < iterations_ && is_rigid(T_volume_newest); ++k) {
      input.transforms[row].copy_(tensor_from_pose(T_brain_volume * T_volume_newest)[0]);
      features[static_cast<std::size_t>(row)] =
          network_->encode_placed(kept_[newest].reduced, views({newest}, {T_volume_newest}, volume, voxel_mm));
      ++encoded_;
      const LiveOutput update = network_->attend_placed(torch::cat(features), {}, input);
      const torch::Tensor place =
          apply_live_update(input.transforms.slice(0, row, row + 1), update.points.slice(0, row, row + 1), shape);
      T_volume_newest = T_brain_volume.inverse() * pose_from_tensor(place);
    }
    if (!is_rigid(T_volume_newest)) return std::nullopt;
    return T_volume_newest;
  };
  NetworkPlaces result;
  const torch::Tensor vote = matrix_from_anchor_points(
      votes.direct.slice(0, static_cast<std::int64_t>(newest), static_cast<std::int64_t>(newest) + 1));
  result.from_first = moved_from(T_brain_volume.inverse() * pose_from_tensor(vote));
  if (iterations_ > 1) result.from_start = moved_from(T_volume_slice[newest]);
  return result;
}

void IncrementalLiveNetwork::move_frame(const Pose& T_new_old) {
  for (Kept& kept : kept_) kept.T_volume_slice = T_new_old * kept.T_volume_slice;
}

std::size_t IncrementalLiveNetwork::take_encoded() { return std::exchange(encoded_, 0); }

}  // namespace svort
