#include "svort_ros/reconstruction/volume_estimation.h"

#include <torch/types.h>

#include <array>
#include <cmath>
#include <cstdint>
#include <sstream>
#include <stdexcept>
#include <string>
#include <vector>

#include "conjugate_gradient.h"
#include "edge_prior.h"

namespace svort {
namespace {

// "4 x 1 x 8 x 8, Float, on cpu", for messages.
std::string text_of(const std::vector<std::int64_t>& shape, const torch::TensorOptions& options) {
  std::ostringstream text;
  for (std::size_t axis = 0; axis < shape.size(); ++axis) text << (axis ? " x " : "") << shape[axis];
  text << ", " << c10::toString(c10::typeMetaToScalarType(options.dtype())) << ", on " << options.device();
  return text.str();
}

void check(const torch::Tensor& tensor, const std::vector<std::int64_t>& shape, const SliceAcquisition& acquisition,
           const char* function, const char* name) {
  const torch::TensorOptions options = acquisition.options();
  if (tensor.defined() && tensor.sizes() == torch::IntArrayRef(shape) && tensor.dtype() == options.dtype() &&
      tensor.device() == options.device()) {
    return;
  }
  throw std::invalid_argument(std::string(function) + ": " + name + " must be " + text_of(shape, options) +
                              ", as the operator's");
}

void check_weights(const torch::Tensor& weights, const SliceAcquisition& acquisition, const char* function) {
  if (!weights.defined()) return;
  check(weights, {acquisition.slice_count()}, acquisition, function, "weights");
  if (!(torch::isfinite(weights) & (weights >= 0)).all().item<bool>()) {
    throw std::invalid_argument(std::string(function) + ": weights must be finite and not negative");
  }
}

void check_problem(const torch::Tensor& slices, const SliceAcquisition& acquisition, const torch::Tensor& weights,
                   const torch::Tensor& start, const char* function) {
  const std::array<std::int64_t, 3> shape = acquisition.volume_shape();
  const std::int64_t n = acquisition.slice_count();
  check(start, {shape[0], shape[1], shape[2]}, acquisition, function, "start");
  check(slices, {n, 1, acquisition.height(), acquisition.width()}, acquisition, function, "slices");
  check_weights(weights, acquisition, function);
}

torch::Tensor weighted(const torch::Tensor& slices, const torch::Tensor& weights) {
  return weights.defined() ? slices * weights.view({-1, 1, 1, 1}) : slices;
}

}  // namespace

torch::Tensor reconstruct_psf(const torch::Tensor& slices, const SliceAcquisition& acquisition) {
  return acquisition.adjoint(slices, /*equalize=*/true);
}

torch::Tensor reconstruct_psf(const torch::Tensor& slices, const SliceAcquisition& acquisition,
                              const torch::Tensor& weights) {
  check_weights(weights, acquisition, "reconstruct_psf");
  const bool records = torch::GradMode::is_enabled() && weights.defined() && weights.requires_grad();
  if (!weights.defined() || (!records && (weights == 1).all().item<bool>())) {
    return reconstruct_psf(slices, acquisition);
  }
  const torch::Tensor sums = acquisition.adjoint(weighted(slices, weights), /*equalize=*/false);
  const torch::Tensor total = acquisition.adjoint(weighted(torch::ones_like(slices), weights), /*equalize=*/false);
  // As for equal weights: what only the far end of a PSF reaches is empty.
  constexpr double kThreshold = 1e-3;
  const torch::Tensor least = (kThreshold * total.detach().max()).clamp_min(1e-12);
  return torch::where(total > least, sums / total.clamp_min(least.item<double>()), torch::zeros_like(sums));
}

torch::Tensor solve_weighted_inverse(const torch::Tensor& slices, const SliceAcquisition& acquisition,
                                     const torch::Tensor& weights, const torch::Tensor& start,
                                     const ConjugateGradientOptions& options, ConjugateGradientReport* report) {
  const char* function = "solve_weighted_inverse";
  if (options.iterations < 0 || !std::isfinite(options.tolerance) || options.tolerance < 0.) {
    throw std::invalid_argument(std::string(function) + ": iterations and tolerance must not be negative, got " +
                                std::to_string(options.iterations) + " and " + std::to_string(options.tolerance));
  }
  check_problem(slices, acquisition, weights, start, function);
  const bool records =
      torch::GradMode::is_enabled() && (slices.requires_grad() || start.requires_grad() ||
                                        acquisition.requires_grad() || (weights.defined() && weights.requires_grad()));
  // A^T W A x = A^T W y
  const auto apply = [&](const torch::Tensor& x) { return acquisition.normal(x, weights); };
  const torch::Tensor b = acquisition.adjoint(weighted(slices, weights), /*equalize=*/false);
  if (records || !start.device().is_cpu() || start.scalar_type() != torch::kFloat32) {
    return unrolled_conjugate_gradient(apply, b, start, options, report).clamp_min(0);
  }
  const torch::NoGradGuard no_grad;
  return conjugate_gradient(apply, b, start, options, report).clamp_min_(0);
}

torch::Tensor refine_edge_preserving(const torch::Tensor& slices, const SliceAcquisition& acquisition,
                                     const torch::Tensor& weights, const torch::Tensor& start,
                                     const EdgePreservingOptions& options) {
  const char* function = "refine_edge_preserving";
  if (options.iterations < 0 || !(options.step > 0.) || !(options.strength >= 0.) || !(options.edge > 0.)) {
    throw std::invalid_argument(std::string(function) +
                                ": iterations and strength must not be negative, step and edge must be positive");
  }
  check_problem(slices, acquisition, weights, start, function);
  if (!start.device().is_cpu() || start.scalar_type() != torch::kFloat32) {
    throw std::invalid_argument(std::string(function) + ": the operator must be float32 on the CPU");
  }
  const torch::NoGradGuard no_grad;
  torch::Tensor x = start.detach().clone(torch::MemoryFormat::Contiguous);
  for (int i = 0; i < options.iterations; ++i) {
    const torch::Tensor error = acquisition.forward(x) - slices;
    torch::Tensor gradient = acquisition.adjoint(weighted(error, weights), /*equalize=*/false);
    add_edge_prior_gradient(x, options.edge, options.strength * options.edge * options.edge, &gradient);
    x.sub_(gradient * options.step);
  }
  return x.clamp_min_(0);
}

}  // namespace svort
