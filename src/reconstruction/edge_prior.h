#pragma once

#include <torch/types.h>

#include <cstdint>
#include <vector>

namespace svort {

/// gradient += strength * dR(volume), the edge-preserving prior of refine_edge_preserving(); `edge` is its delta.
/// Both tensors are D x H x W, float32, contiguous, on the CPU. The one-voxel rim is left alone.
void add_edge_prior_gradient(const torch::Tensor& volume, double edge, double strength, torch::Tensor* gradient);

/// Weights of the differences between neighbours along the axes, one quadratic step of an edge-preserving prior:
/// 1 / sqrt(1 + (d / edge)^2) for a difference d, 0 where one of both voxels is unknown.
class EdgeWeights {
 public:
  /// @param volume D x H x W, float32, CPU @param known the same shape, bool
  EdgeWeights(const torch::Tensor& volume, const torch::Tensor& known, double edge);

  /// result += strength * L x, with (L x)_v = sum over neighbours u of weight_uv (x_v - x_u).
  void add_laplacian(const torch::Tensor& x, float strength, torch::Tensor* result) const;

 private:
  std::int64_t depth_, height_, width_;
  std::vector<float> x_, y_, z_;  ///< weight of each voxel and the next along the axis
};

}  // namespace svort
