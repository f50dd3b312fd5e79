#pragma once

#include <torch/types.h>

namespace svort {

/// gradient += strength * dR(volume), the edge-preserving prior of refine_edge_preserving(); `edge` is its delta.
/// Both tensors are D x H x W, float32, contiguous, on the CPU. The one-voxel rim is left alone.
void add_edge_prior_gradient(const torch::Tensor& volume, double edge, double strength, torch::Tensor* gradient);

}  // namespace svort
