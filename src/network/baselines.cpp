#include "svort_ros/network/baselines.h"

#include <torch/nn/modules/activation.h>
#include <torch/nn/modules/conv.h>
#include <torch/nn/modules/normalization.h>

#include <cmath>
#include <numeric>
#include <stdexcept>

#include "svort_ros/geometry/anchor_points.h"

namespace svort {
namespace {

namespace nn = torch::nn;

constexpr int kNormGroups = 8;
constexpr double kUnitMm = 50.;  // of the outputs, so that they are of order 1
// Convolutions per group of VGG-16, and their channels as multiples of the first.
constexpr int kConvolutions[] = {2, 2, 3, 3, 3};
constexpr int kMultiples[] = {1, 2, 4, 8, 8};

void require(bool condition, const std::string& message) {
  if (!condition) throw std::invalid_argument("baseline: " + message);
}

}  // namespace

VggEncoderImpl::VggEncoderImpl(const BaselineOptions& options) {
  std::int64_t in = 1;
  for (int group = 0; group < 5; ++group) {
    groups_.emplace_back();
    for (int index = 0; index < kConvolutions[group]; ++index) {
      const std::int64_t out = std::int64_t{options.width} * kMultiples[group];
      nn::Sequential layer(nn::Conv2d(nn::Conv2dOptions(in, out, 3).padding(1).bias(false)),
                           nn::GroupNorm(nn::GroupNormOptions(kNormGroups, out)), nn::ReLU());
      groups_.back().push_back(register_module("group" + std::to_string(group) + "_" + std::to_string(index), layer));
      in = out;
    }
  }
  const std::int64_t cells = options.input_px / 32;
  out_ = register_module("out", nn::Linear(in * cells * cells, options.dim));
}

torch::Tensor VggEncoderImpl::forward(const torch::Tensor& images) {
  torch::Tensor x = images;
  for (auto& group : groups_) {
    for (auto& layer : group) x = layer->forward(x);
    x = torch::max_pool2d(x, 2);
  }
  return torch::relu(out_(x.flatten(1)));
}

AnchorRegressor::AnchorRegressor(const std::string& name, const BaselineOptions& options)
    : PoseNetwork(name), options_(options) {
  require(options.input_px >= 32 && options.input_px <= 256 && options.input_px % 32 == 0,
          "input_px is " + std::to_string(options.input_px) + "; it must be a multiple of 32 from 32 to 256");
  require(options.input_resolution_mm >= 0.25 && options.input_resolution_mm <= 16.,
          "input_resolution_mm must be 0.25 to 16 mm");
  require(options.width >= kNormGroups && options.width % kNormGroups == 0 && options.width <= 256,
          "width is " + std::to_string(options.width) + "; it must be a multiple of 8 up to 256");
  require(options.dim >= 1 && options.dim <= 8192, "dim must be 1 to 8192");
}

torch::Tensor AnchorRegressor::reduce(const NetworkInput& input) const {
  const torch::Tensor& slices = input.slices;
  require(slices.defined() && slices.dim() == 4 && slices.size(1) == 1, "slices must be n x 1 x h x w");
  const double ratio = options_.input_resolution_mm / input.slice_resolution_mm;
  const auto factor = static_cast<std::int64_t>(std::lround(ratio));
  require(factor >= 1 && std::abs(static_cast<double>(factor) / ratio - 1.) < 1e-6 &&
              slices.size(2) == factor * options_.input_px && slices.size(3) == factor * options_.input_px,
          "slices of " + std::to_string(slices.size(3)) + " x " + std::to_string(slices.size(2)) + " pixels of " +
              std::to_string(input.slice_resolution_mm) + " mm cannot be averaged to " +
              std::to_string(options_.input_px) + " x " + std::to_string(options_.input_px) + " of " +
              std::to_string(options_.input_resolution_mm) + " mm");
  return factor == 1 ? slices : torch::avg_pool2d(slices, {factor, factor});
}

std::vector<NetworkStep> AnchorRegressor::run(const NetworkInput& input, const NetworkGrid& /*grid*/,
                                              const NetworkRun& /*run*/) {
  const torch::NoGradGuard no_grad;
  NetworkStep step;
  step.transforms = matrix_from_anchor_points(regress(input));
  step.points = anchor_points_from_matrix(
      step.transforms,
      {static_cast<int>(input.slices.size(3)), static_cast<int>(input.slices.size(2)), input.slice_resolution_mm});
  return {step};
}

SvrNet::SvrNet(const BaselineOptions& options) : AnchorRegressor("svrnet", options) {
  encoder_ = register_module("encoder", VggEncoder(options));
  head_ = register_module("head", nn::Linear(options.dim, 9));
}

torch::Tensor SvrNet::regress(const NetworkInput& input, const std::vector<std::int64_t>& /*lengths*/) {
  return kUnitMm * head_(encoder_(reduce(input)));
}

PlaneInVol::PlaneInVol(const BaselineOptions& options) : AnchorRegressor("planeinvol", options) {
  const std::int64_t dim = options.dim;
  encoder_ = register_module("encoder", VggEncoder(options));
  query_ = register_module("query", nn::Linear(dim, dim));
  key_ = register_module("key", nn::Linear(dim, dim));
  value_ = register_module("value", nn::Linear(dim, dim));
  hidden_ = register_module("hidden", nn::Linear(2 * dim, dim));
  head_ = register_module("head", nn::Linear(dim, 9));
}

torch::Tensor PlaneInVol::regress(const NetworkInput& input, const std::vector<std::int64_t>& lengths) {
  const torch::Tensor features = encoder_(reduce(input));
  const std::vector<std::int64_t> scans = lengths.empty() ? std::vector<std::int64_t>{features.size(0)} : lengths;
  require(std::accumulate(scans.begin(), scans.end(), std::int64_t{0}) == features.size(0),
          "lengths do not add up to the number of slices");
  std::vector<torch::Tensor> taken;
  std::int64_t begin = 0;
  for (const std::int64_t length : scans) {
    const torch::Tensor own = features.narrow(0, begin, length);
    const torch::Tensor resemblance =
        torch::matmul(query_(own), key_(own).t()) / std::sqrt(static_cast<double>(own.size(1)));
    taken.push_back(torch::matmul(resemblance.softmax(-1), value_(own)));
    begin += length;
  }
  return kUnitMm * head_(torch::relu(hidden_(torch::cat({features, torch::cat(taken)}, 1))));
}

}  // namespace svort
