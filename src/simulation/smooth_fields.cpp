#include "smooth_fields.h"

#include <cmath>

namespace svort {
namespace {

/// Uniform cubic B-spline.
double b_spline(double t) {
  t = std::abs(t);
  if (t < 1.) return 2. / 3. - t * t + 0.5 * t * t * t;
  if (t < 2.) return (2. - t) * (2. - t) * (2. - t) / 6.;
  return 0.;
}

}  // namespace

torch::Tensor low_pass_matrix(std::int64_t in, double in_first, double in_mm, std::int64_t out, double out_first,
                              double out_mm, double sigma_mm) {
  const torch::Tensor from = torch::arange(in, torch::kFloat64) * in_mm + in_first;
  const torch::Tensor to = torch::arange(out, torch::kFloat64) * out_mm + out_first;
  const torch::Tensor distance = (to.unsqueeze(1) - from.unsqueeze(0)).abs();
  // A Gaussian much narrower than a voxel would pick single voxels: interpolate linearly then.
  const torch::Tensor weights = sigma_mm < 0.35 * in_mm ? (1. - distance / in_mm).clamp_min(0.)
                                                        : torch::exp(-0.5 * torch::pow(distance / sigma_mm, 2));
  return (weights / weights.sum(1, true).clamp_min(1e-6)).to(torch::kFloat32);
}

std::int64_t spline_points(double reach_mm, double spacing_mm) {
  return 2 * static_cast<std::int64_t>(std::ceil(reach_mm / spacing_mm)) + 3;
}

torch::Tensor spline_matrix(const torch::Tensor& position_mm, std::int64_t points, double spacing_mm) {
  const std::int64_t count = position_mm.size(0);
  torch::Tensor matrix = torch::empty({count, points}, torch::kFloat32);
  auto values = matrix.accessor<float, 2>();
  const auto where = position_mm.accessor<double, 1>();
  for (std::int64_t i = 0; i < count; ++i)
    for (std::int64_t k = 0; k < points; ++k)
      values[i][k] = static_cast<float>(
          b_spline(where[i] / spacing_mm - (static_cast<double>(k) - 0.5 * static_cast<double>(points - 1))));
  return matrix;
}

torch::Tensor apply_axes(const torch::Tensor& volume, const std::array<torch::Tensor, 3>& axes) {
  torch::Tensor result = torch::matmul(volume, axes[2].t());
  result = torch::matmul(axes[1], result);
  return torch::matmul(axes[0], result.transpose(1, 2)).transpose(1, 2);
}

}  // namespace svort
