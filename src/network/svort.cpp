#include "svort_ros/network/svort.h"

#include <torch/nn/modules/container/modulelist.h>

#include <cmath>
#include <stdexcept>
#include <string>

#include "svort_ros/acquisition/point_spread_function.h"
#include "svort_ros/geometry/anchor_points.h"
#include "svort_ros/geometry/rigid_transform.h"
#include "svort_ros/network/stage_clock.h"
#include "svort_ros/reconstruction/volume_estimation.h"

namespace svort {
namespace {

constexpr std::int64_t kPoints = 9;         // anchor points of a slice, 3 x 3 coordinates
constexpr std::int64_t kAxisAngle = 6;      // rotation and translation
constexpr std::int64_t kSlicePosition = 2;  // index in the stack, stack
constexpr int kConjugateGradients = 2;      // of the public implementation

void require(bool condition, const std::string& message) {
  if (!condition) throw std::invalid_argument("SVoRT: " + message);
}

std::string shape_of(const torch::Tensor& tensor) {
  if (!tensor.defined()) return "undefined";
  std::string text;
  for (const std::int64_t size : tensor.sizes()) text += (text.empty() ? "" : " x ") + std::to_string(size);
  return text;
}

void check_tensor(const char* name, const torch::Tensor& tensor, torch::IntArrayRef shape) {
  require(tensor.defined() && tensor.sizes() == shape,
          std::string(name) + " is " + shape_of(tensor) + ", expected " + shape_of(torch::empty(shape)));
  require(tensor.is_floating_point(), std::string(name) + " must hold floating-point numbers");
  require(torch::isfinite(tensor).all().item<bool>(), std::string(name) + " holds NaN or infinity");
}

void check_input(const NetworkInput& input, const NetworkGrid& grid) {
  require(input.slices.defined() && input.slices.dim() == 4 && input.slices.size(0) >= 1 && input.slices.size(1) == 1,
          "slices are " + shape_of(input.slices) + ", expected n x 1 x h x w with n of at least 1");
  const std::int64_t n = input.slices.size(0);
  check_tensor("slices", input.slices, input.slices.sizes());
  check_tensor("transforms", input.transforms, {n, 3, 4});
  check_tensor("positions", input.positions, {n, kSlicePosition});
  require(std::isfinite(input.slice_resolution_mm) && input.slice_resolution_mm > 0.,
          "slice_resolution_mm must be positive");
  require(std::isfinite(input.thickness_mm) && input.thickness_mm > 0., "thickness_mm must be positive");
  require(std::isfinite(grid.resolution_mm) && grid.resolution_mm > 0., "resolution_mm must be positive");
  for (const std::int64_t size : grid.volume_shape) require(size >= 2, "volume_shape must be at least 2 x 2 x 2");
}

/// Where the forward model computes: on the network's device if it can, else on the CPU.
torch::Device model_device([[maybe_unused]] const NetworkInput& input) {
#ifdef SVORT_WITH_CUDA
  if (input.slices.is_cuda()) return input.slices.device();
#endif
  return torch::kCPU;
}

/// What the forward model takes. It carries no gradient.
torch::Tensor for_model(const torch::Tensor& tensor, const NetworkInput& input) {
  return tensor.detach().to(model_device(input)).contiguous();
}

/// The transforms of anchor points, on the CPU in float32, whatever the precision of the layers.
torch::Tensor transforms_of(const torch::Tensor& points) {
  return matrix_from_anchor_points(points.detach().to(torch::kCPU));
}

SliceAcquisition acquisition_at(const torch::Tensor& points, const NetworkInput& input, const NetworkGrid& grid,
                                const NetworkRun& run) {
  const double ratio = input.slice_resolution_mm / grid.resolution_mm;
  AcquisitionGeometry geometry;
  geometry.transforms = for_model(change_resolution(transforms_of(points), 1., grid.resolution_mm), input);
  geometry.psf = gaussian_psf({ratio, ratio, input.thickness_mm / grid.resolution_mm});
  geometry.resolution_ratio = ratio;
  return {geometry, static_cast<int>(input.slices.size(2)), static_cast<int>(input.slices.size(3)), grid.volume_shape,
          run.formulation};
}

torch::Tensor simulate(const SliceAcquisition& acquisition, const torch::Tensor& volume, const NetworkInput& input,
                       const NetworkRun& run) {
  const StageClock::Scope scope(run.clock, "forward_model");
  return acquisition.forward(for_model(volume, input)).to(input.slices.device());
}

torch::Tensor reconstruct(const SliceAcquisition& acquisition, const NetworkInput& input, const NetworkRun& run) {
  const StageClock::Scope scope(run.clock, "adjoint");
  return reconstruct_psf(for_model(input.slices, input), acquisition).to(input.slices.device());
}

torch::Tensor solve(const SliceAcquisition& acquisition, const torch::Tensor& start, const torch::Tensor& weights,
                    const NetworkInput& input, const NetworkRun& run, bool gradient) {
  const StageClock::Scope scope(run.clock, "conjugate_gradients");
  ConjugateGradientOptions options;
  options.iterations = kConjugateGradients;
  const torch::Tensor trusted = gradient ? weights.to(model_device(input)).contiguous() : for_model(weights, input);
  return solve_weighted_inverse(for_model(input.slices, input), acquisition, trusted, for_model(start, input), options)
      .to(input.slices.device());
}

/// n x 1 -> n, positive, mean 1.
torch::Tensor weights_from_score(const torch::Tensor& score) {
  return torch::softmax(score.flatten(), 0) * static_cast<double>(score.numel());
}

SliceVolumeTransformer pose_transformer(const SvortOptions& options, bool simulated, bool score) {
  SliceVolumeTransformerOptions network;
  network.encoder.depth = static_cast<int>(options.encoder_depth);
  network.encoder.width = options.encoder_width;
  network.transformer = {simulated ? options.later_layers : options.layers, options.heads, options.features,
                         options.hidden, options.gelu};
  network.simulated = simulated;
  network.positions = kPoints + kSlicePosition;
  network.outputs = kPoints;
  network.score = score;
  return SliceVolumeTransformer(network);
}

SliceVolumeTransformer quality_transformer(const SvortOptions& options) {
  SliceVolumeTransformerOptions network;
  network.encoder.depth = static_cast<int>(options.quality_depth);
  network.encoder.width = options.encoder_width;
  network.transformer = {options.quality_layers, options.quality_heads, options.quality_features,
                         options.quality_hidden};
  network.simulated = true;
  network.coordinates = false;
  network.positions = kAxisAngle + kSlicePosition;
  network.outputs = 1;
  return SliceVolumeTransformer(network);
}

void check_iterations(std::int64_t iterations) {
  require(iterations >= 1 && iterations <= 100,
          "iterations is " + std::to_string(iterations) + "; it must be 1 to 100");
}

}  // namespace

SvortOptions svort_v1_options() { return {}; }

SvortOptions svort_v2_options() {
  SvortOptions options;
  options.iterations = 4;
  options.later_layers = 8;
  options.gelu = true;
  return options;
}

std::vector<NetworkStep> Svort::run(const NetworkInput& input, const NetworkGrid& grid, const NetworkRun& run) {
  check_input(input, grid);
  require(run.iterations >= 0, "iterations must not be negative");
  const std::int64_t iterations = run.iterations > 0 ? run.iterations : options_.iterations;
  pose_network(iterations - 1);  // too many are an error before the work begins
  const AnchorFrame frame{static_cast<int>(input.slices.size(3)), static_cast<int>(input.slices.size(2)),
                          input.slice_resolution_mm};
  torch::Tensor points = anchor_points_from_matrix(input.transforms, frame);
  torch::Tensor volume;
  std::vector<NetworkStep> steps;
  for (std::int64_t k = 0; k < iterations; ++k) {
    const PoseUpdate poses = update_poses(k, points, volume, input, grid, run);
    const VolumeUpdate estimate = estimate_volume(poses.points, poses.weights, input, grid, run);
    points = poses.points;
    volume = estimate.volume;
    steps.push_back({points, matrix_from_anchor_points(points), estimate.weights, volume, poses.attention});
  }
  return steps;
}

Svort::PoseUpdate Svort::update_poses(std::int64_t iteration, const torch::Tensor& points, const torch::Tensor& volume,
                                      const NetworkInput& input, const NetworkGrid& grid, const NetworkRun& run) {
  torch::Tensor simulated;
  if (iteration > 0) simulated = simulate(acquisition_at(points, input, grid, run), volume, input, run);
  // The points that the embedding is made of carry no gradient from the iteration before.
  const torch::Tensor before = points.detach();
  const auto output =
      pose_network(iteration)->forward(input.slices, simulated, torch::cat({before, input.positions}, 1), run);
  PoseUpdate update;
  update.points = before + output.values;
  if (output.score.defined()) update.weights = weights_from_score(output.score);
  update.attention = output.attention;
  return update;
}

SvortV1::SvortV1(const SvortOptions& options) : Svort(options) {
  check_iterations(options.iterations);
  torch::nn::ModuleList networks;
  for (std::int64_t k = 0; k < options.iterations; ++k) {
    pose_networks_.push_back(pose_transformer(options, k > 0, false));
    networks->push_back(pose_networks_.back());
  }
  register_module("svrnet", networks);
  quality_network = register_module("srrnet", quality_transformer(options));
}

SliceVolumeTransformer& SvortV1::pose_network(std::int64_t iteration) {
  require(iteration >= 0 && iteration < static_cast<std::int64_t>(pose_networks_.size()),
          "version 1 has " + std::to_string(pose_networks_.size()) + " pose networks, iteration " +
              std::to_string(iteration + 1) + " needs another");
  return pose_networks_[static_cast<std::size_t>(iteration)];
}

Svort::VolumeUpdate SvortV1::estimate_volume(const torch::Tensor& points, const torch::Tensor& /*weights*/,
                                             const NetworkInput& input, const NetworkGrid& grid,
                                             const NetworkRun& run) {
  const SliceAcquisition acquisition = acquisition_at(points, input, grid, run);
  VolumeUpdate update;
  update.reconstructed = reconstruct(acquisition, input, run);
  const torch::Tensor simulated = simulate(acquisition, update.reconstructed, input, run);
  const torch::Tensor axisangle = matrix_to_axisangle(transforms_of(points)).to(input.slices.device());
  update.weights = weights_from_score(
      quality_network(input.slices, simulated, torch::cat({axisangle, input.positions}, 1), run).values);
  update.volume = solve(acquisition, update.reconstructed, update.weights, input, run, volume_gradient_);
  return update;
}

SvortV2::SvortV2(const SvortOptions& options) : Svort(options) {
  check_iterations(options.iterations);
  first_ = register_module("svrnet1", pose_transformer(options, false, true));
  later_ = register_module("svrnet2", pose_transformer(options, true, true));
}

SliceVolumeTransformer& SvortV2::pose_network(std::int64_t iteration) {
  require(iteration >= 0, "iteration must not be negative");
  return iteration == 0 ? first_ : later_;
}

Svort::VolumeUpdate SvortV2::estimate_volume(const torch::Tensor& points, const torch::Tensor& weights,
                                             const NetworkInput& input, const NetworkGrid& grid,
                                             const NetworkRun& run) {
  const SliceAcquisition acquisition = acquisition_at(points, input, grid, run);
  VolumeUpdate update;
  update.weights = weights;
  update.reconstructed = reconstruct(acquisition, input, run);
  update.volume = solve(acquisition, update.reconstructed, weights, input, run, volume_gradient_);
  return update;
}

}  // namespace svort
