#pragma once

#include <torch/types.h>

#include <array>
#include <cstdint>

/// Separable low-pass filters and cubic B-splines on a regular lattice, as one matrix per axis.
namespace svort {

/// out x in matrix that low-passes (Gaussian of sigma_mm) and samples one axis. Positions are index * spacing + first,
/// mm.
torch::Tensor low_pass_matrix(std::int64_t in, double in_first, double in_mm, std::int64_t out, double out_first,
                              double out_mm, double sigma_mm);

/// Control points along an axis that reaches this far to both sides of 0.
std::int64_t spline_points(double reach_mm, double spacing_mm);

/// positions x points matrix, float32, of uniform cubic B-splines whose control points lie around 0.
/// @param position_mm float64, one dimension
torch::Tensor spline_matrix(const torch::Tensor& position_mm, std::int64_t points, double spacing_mm);

/// Standard deviation of a spline in three dimensions with independent coefficients of deviation 1, on average over the
/// lattice.
constexpr double kSplineDeviation = 0.33189;  // (151 / 315)^1.5

/// Applies one matrix per axis (z, y, x) to c x d x h x w.
torch::Tensor apply_axes(const torch::Tensor& volume, const std::array<torch::Tensor, 3>& axes);

}  // namespace svort
