#include "svort_ros/network/positional_encoding.h"

#include <stdexcept>
#include <string>

namespace svort {

PositionalEncodingImpl::PositionalEncodingImpl(std::int64_t coordinates, std::int64_t features) : features_(features) {
  const std::int64_t frequencies = coordinates < 1 ? 0 : features / 2 / coordinates;
  if (frequencies < 2) {
    throw std::invalid_argument("PositionalEncoding: " + std::to_string(features) + " features for " +
                                std::to_string(coordinates) + " coordinates; it takes at least 4 for each");
  }
  const torch::Tensor exponent = torch::linspace(0., 1., frequencies, torch::kFloat64);
  const torch::Tensor w = torch::pow(1e-3, exponent).view({1, -1, 1}).expand({1, frequencies, coordinates});
  w_ = register_parameter("w", w.to(torch::kFloat32).contiguous());
}

torch::Tensor PositionalEncodingImpl::forward(const torch::Tensor& positions) {
  const torch::Tensor phase = (positions.unsqueeze(1) * w_).flatten(1);
  const torch::Tensor waves = torch::cat({torch::sin(phase), torch::cos(phase)}, 1);
  return torch::constant_pad_nd(waves, {0, features_ - waves.size(1)});
}

}  // namespace svort
