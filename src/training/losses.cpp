#include "svort_ros/training/losses.h"

#include <torch/types.h>

namespace svort {

torch::Tensor smooth_l1_loss(const torch::Tensor& points, const torch::Tensor& truth, double beta) {
  const torch::Tensor distance = (points - truth).abs();
  return torch::where(distance < beta, distance.square() * (0.5 / beta), distance - 0.5 * beta).mean(1);
}

torch::Tensor mirror_loss(const torch::Tensor& points, const torch::Tensor& truth, double beta) {
  const torch::Tensor reflection =
      torch::tensor({-1., 1., 1., -1., 1., 1., -1., 1., 1.}, torch::kFloat64).to(truth.options());
  return torch::minimum(smooth_l1_loss(points, truth, beta), smooth_l1_loss(points, truth * reflection, beta));
}

torch::Tensor anchor_loss(const torch::Tensor& points, const torch::Tensor& truth) {
  return (points - truth).square().mean(1);
}

torch::Tensor scale_loss(const torch::Tensor& errors, const torch::Tensor& log_scale) {
  return errors.detach() * (-log_scale).exp() + log_scale;
}

}  // namespace svort
