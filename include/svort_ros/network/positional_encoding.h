#pragma once

#include <torch/nn/module.h>
#include <torch/nn/pimpl.h>

#include <cstdint>

namespace svort {

/// Sinusoids of a few coordinates, at frequencies from 1 down to 0.001 in geometric steps (the paper's positional
/// embedding; values and order as in the public implementation).
///
/// There are K = floor(features / 2 / coordinates) frequencies. The result holds the sines of all coordinates at the
/// first frequency, at the second, .., then the cosines likewise, then zeros up to `features`.
class PositionalEncodingImpl : public torch::nn::Module {
 public:
  /// @throws std::invalid_argument unless there is room for two frequencies
  PositionalEncodingImpl(std::int64_t coordinates, std::int64_t features);

  /// @param positions n x coordinates @return n x features
  torch::Tensor forward(const torch::Tensor& positions);

 private:
  std::int64_t features_;
  torch::Tensor w_;  ///< 1 x K x coordinates; part of the public checkpoints
};
TORCH_MODULE(PositionalEncoding);

}  // namespace svort
