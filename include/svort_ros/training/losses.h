#pragma once

#include <torch/types.h>

namespace svort {

// Losses per slice: the mean over its nine anchor coordinates, in whatever unit the points are given.

/// Smooth L1: quadratic below `beta`, linear above. points, truth: n x 9 -> n
torch::Tensor smooth_l1_loss(const torch::Tensor& points, const torch::Tensor& truth, double beta);

/// The smaller of smooth_l1_loss() against the truth and against the truth with x reflected: a brain is nearly
/// symmetric, and a slice alone often cannot tell which it is. points, truth: n x 9 -> n
torch::Tensor mirror_loss(const torch::Tensor& points, const torch::Tensor& truth, double beta);

/// The paper's transformation loss: squared distance. points, truth: n x 9 -> n
torch::Tensor anchor_loss(const torch::Tensor& points, const torch::Tensor& truth);

/// Negative log-likelihood of errors under a Laplace distribution of the estimated scale. Trains the scale alone: no
/// gradient reaches the errors. errors, log_scale: n -> n
torch::Tensor scale_loss(const torch::Tensor& errors, const torch::Tensor& log_scale);

}  // namespace svort
