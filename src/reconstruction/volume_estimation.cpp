#include "svort_ros/reconstruction/volume_estimation.h"

#include <torch/torch.h>

#include <cmath>
#include <stdexcept>
#include <string>

#include "conjugate_gradient.h"
#include "edge_prior.h"

namespace svort {
namespace {

// The weights as n x 1 x 1 x 1, or undefined.
torch::Tensor checked_weights(const torch::Tensor& weights, std::int64_t slices, const char* function) {
  if (!weights.defined()) return weights;
  if (weights.dim() != 1 || weights.size(0) != slices || weights.scalar_type() != torch::kFloat32 ||
      !weights.device().is_cpu()) {
    throw std::invalid_argument(std::string(function) + ": weights must be " + std::to_string(slices) +
                                " float32 values on the CPU, one per slice");
  }
  if (!(torch::isfinite(weights) & (weights >= 0)).all().item<bool>()) {
    throw std::invalid_argument(std::string(function) + ": weights must be finite and not negative");
  }
  return weights.detach().view({-1, 1, 1, 1});
}

torch::Tensor weighted(const torch::Tensor& slices, const torch::Tensor& weights) {
  return weights.defined() ? slices * weights : slices;
}

void check_start(const torch::Tensor& start, const SliceAcquisition& acquisition, const char* function) {
  const std::array<std::int64_t, 3> shape = acquisition.volume_shape();
  if (!start.defined() || start.sizes() != torch::IntArrayRef(shape) || start.scalar_type() != torch::kFloat32 ||
      !start.device().is_cpu()) {
    throw std::invalid_argument(std::string(function) + ": start must be " + std::to_string(shape[0]) + " x " +
                                std::to_string(shape[1]) + " x " + std::to_string(shape[2]) +
                                ", float32, on the CPU, as the operator's volume");
  }
}

void check_slices(const torch::Tensor& slices, const SliceAcquisition& acquisition, const char* function) {
  const std::array<std::int64_t, 4> shape = {acquisition.slice_count(), 1, acquisition.height(), acquisition.width()};
  if (!slices.defined() || slices.sizes() != torch::IntArrayRef(shape) || slices.scalar_type() != torch::kFloat32 ||
      !slices.device().is_cpu()) {
    throw std::invalid_argument(std::string(function) + ": slices must be " + std::to_string(shape[0]) + " x 1 x " +
                                std::to_string(shape[2]) + " x " + std::to_string(shape[3]) +
                                ", float32, on the CPU, as the operator's slices");
  }
}

// The weights, contiguous, or undefined.
torch::Tensor flat(const torch::Tensor& weights) {
  return weights.defined() ? weights.reshape({-1}).contiguous() : weights;
}

}  // namespace

torch::Tensor reconstruct_psf(const torch::Tensor& slices, const SliceAcquisition& acquisition) {
  return acquisition.adjoint(slices, /*equalize=*/true);
}

torch::Tensor reconstruct_psf(const torch::Tensor& slices, const SliceAcquisition& acquisition,
                              const torch::Tensor& weights) {
  const torch::Tensor w = checked_weights(weights, acquisition.slice_count(), "reconstruct_psf");
  if (!w.defined() || (w == 1).all().item<bool>()) return reconstruct_psf(slices, acquisition);
  const torch::Tensor sums = acquisition.adjoint((slices * w).contiguous(), false);
  const torch::Tensor total = acquisition.adjoint(w.expand_as(slices).contiguous(), false);
  // As for equal weights: what only the far end of a PSF reaches is empty.
  constexpr double kThreshold = 1e-3;
  const torch::Tensor least = (kThreshold * total.max()).clamp_min(1e-12);
  return torch::where(total > least, sums / total.clamp_min(least.item<float>()), torch::zeros_like(sums));
}

torch::Tensor solve_weighted_inverse(const torch::Tensor& slices, const SliceAcquisition& acquisition,
                                     const torch::Tensor& weights, const torch::Tensor& start,
                                     const ConjugateGradientOptions& options, ConjugateGradientReport* report) {
  const char* function = "solve_weighted_inverse";
  if (options.iterations < 0 || !std::isfinite(options.tolerance) || options.tolerance < 0.) {
    throw std::invalid_argument(std::string(function) + ": iterations and tolerance must not be negative, got " +
                                std::to_string(options.iterations) + " and " + std::to_string(options.tolerance));
  }
  check_start(start, acquisition, function);
  check_slices(slices, acquisition, function);
  const torch::Tensor w = checked_weights(weights, slices.size(0), function);
  const torch::NoGradGuard no_grad;
  // A^T W A x = A^T W y
  const torch::Tensor b = acquisition.adjoint(weighted(slices, w), /*equalize=*/false);
  const auto apply = [&, of_slices = flat(w)](const torch::Tensor& x) { return acquisition.normal(x, of_slices); };
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
  check_start(start, acquisition, function);
  check_slices(slices, acquisition, function);
  const torch::Tensor w = checked_weights(weights, slices.size(0), function);
  const torch::NoGradGuard no_grad;
  torch::Tensor x = start.detach().clone(torch::MemoryFormat::Contiguous);
  for (int i = 0; i < options.iterations; ++i) {
    const torch::Tensor error = acquisition.forward(x) - slices;
    torch::Tensor gradient = acquisition.adjoint(weighted(error, w), /*equalize=*/false);
    add_edge_prior_gradient(x, options.edge, options.strength * options.edge * options.edge, &gradient);
    x.sub_(gradient * options.step);
  }
  return x.clamp_min_(0);
}

}  // namespace svort
