#include "svort_ros/network/slice_volume_transformer.h"

#include <stdexcept>
#include <vector>

#include "bfloat16_layers.h"
#include "svort_ros/network/stage_clock.h"

namespace svort {
namespace {

ResNetOptions encoder_options(const SliceVolumeTransformerOptions& options) {
  ResNetOptions encoder = options.encoder;
  encoder.channels = 1 + (options.simulated ? 1 : 0) + (options.coordinates ? 2 : 0);
  encoder.features = options.transformer.features;
  return encoder;
}

/// Distances of the pixels from the centre, in units of 128 pixels. The public implementation divides by 256 what runs
/// from -(size - 1) to size - 1.
torch::Tensor pixel_coordinates(std::int64_t size, const torch::Tensor& like) {
  const double end = static_cast<double>(size - 1) / 256.;
  return torch::linspace(-end, end, size, like.options());
}

}  // namespace

SliceVolumeTransformerImpl::SliceVolumeTransformerImpl(const SliceVolumeTransformerOptions& options)
    : options_(options) {
  const std::int64_t features = options.transformer.features;
  image_encoder = register_module("img_encoder", ImageEncoder(encoder_options(options)));
  positional_encoding = register_module("pos_emb", PositionalEncoding(options.positions, features));
  encoder = register_module("encoder", TransformerEncoder(options.transformer));
  fc_ = register_module("fc", torch::nn::Linear(features, options.outputs));
  if (options.score) fc_score_ = register_module("fc_score", torch::nn::Linear(features, 1));
}

torch::Tensor SliceVolumeTransformerImpl::image_channels(const torch::Tensor& slices,
                                                         const torch::Tensor& simulated) const {
  if (options_.simulated != simulated.defined()) {
    throw std::invalid_argument(options_.simulated ? "SliceVolumeTransformer: the simulated slices are missing"
                                                   : "SliceVolumeTransformer: takes no simulated slices");
  }
  std::vector<torch::Tensor> channels = {slices};
  if (options_.simulated) channels.push_back(simulated);
  if (options_.coordinates) {
    const std::int64_t height = slices.size(2), width = slices.size(3);
    channels.push_back(pixel_coordinates(height, slices).view({1, 1, height, 1}).expand_as(slices));
    channels.push_back(pixel_coordinates(width, slices).view({1, 1, 1, width}).expand_as(slices));
  }
  return torch::cat(channels, 1);
}

SliceVolumeTransformerImpl::Output SliceVolumeTransformerImpl::forward(const torch::Tensor& slices,
                                                                       const torch::Tensor& simulated,
                                                                       const torch::Tensor& positions,
                                                                       const NetworkRun& run) {
  const BFloat16Layers layers(run.precision == torch::kBFloat16, slices.device().type());
  torch::Tensor features;
  {
    const StageClock::Scope scope(run.clock, "encoder");
    features = image_encoder(image_channels(slices, simulated));
  }
  const StageClock::Scope scope(run.clock, "transformer");
  Output output;
  const torch::Tensor x = encoder(features, positional_encoding(positions), &output.attention);
  output.values = fc_(x).to(slices.scalar_type());
  if (options_.score) output.score = fc_score_(x).to(slices.scalar_type());
  return output;
}

}  // namespace svort
