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

void check_start(const torch::Tensor& start, const char* function) {
  if (!start.defined() || start.dim() != 3 || start.scalar_type() != torch::kFloat32 || !start.device().is_cpu()) {
    throw std::invalid_argument(std::string(function) + ": start must be D x H x W, float32, on the CPU");
  }
}

void check_slices(const torch::Tensor& slices, const AcquisitionGeometry& geometry, const char* function) {
  if (!slices.defined() || slices.dim() != 4 || slices.size(1) != 1 || slices.scalar_type() != torch::kFloat32 ||
      !slices.device().is_cpu() || !geometry.transforms.defined() || geometry.transforms.dim() != 3 ||
      geometry.transforms.size(0) != slices.size(0)) {
    throw std::invalid_argument(std::string(function) +
                                ": slices must be n x 1 x h x w, float32, on the CPU, with n transforms");
  }
}

std::array<std::int64_t, 3> shape_of(const torch::Tensor& volume) {
  return {volume.size(0), volume.size(1), volume.size(2)};
}

// A slice pixel outside the mask takes no part, whatever its value.
torch::Tensor normal_operator(const torch::Tensor& volume, const AcquisitionGeometry& geometry, std::int64_t height,
                              std::int64_t width, const torch::Tensor& weights, const AcquisitionMasks& masks) {
  const torch::Tensor simulated =
      acquire_slices(volume, geometry, static_cast<int>(height), static_cast<int>(width), masks);
  return scatter_slices(weighted(simulated, weights), geometry, shape_of(volume), /*equalize=*/false, masks);
}

}  // namespace

torch::Tensor reconstruct_psf(const torch::Tensor& slices, const AcquisitionGeometry& geometry,
                              const std::array<std::int64_t, 3>& volume_shape, const AcquisitionMasks& masks) {
  return scatter_slices(slices, geometry, volume_shape, /*equalize=*/true, masks);
}

torch::Tensor apply_normal_operator(const torch::Tensor& volume, const AcquisitionGeometry& geometry, int height,
                                    int width, const torch::Tensor& weights, const AcquisitionMasks& masks) {
  const char* function = "apply_normal_operator";
  check_start(volume, function);
  const std::int64_t slices =
      geometry.transforms.defined() && geometry.transforms.dim() > 0 ? geometry.transforms.size(0) : 0;
  return normal_operator(volume, geometry, height, width, checked_weights(weights, slices, function), masks);
}

torch::Tensor solve_weighted_inverse(const torch::Tensor& slices, const AcquisitionGeometry& geometry,
                                     const torch::Tensor& weights, const torch::Tensor& start,
                                     const ConjugateGradientOptions& options, const AcquisitionMasks& masks,
                                     ConjugateGradientReport* report) {
  const char* function = "solve_weighted_inverse";
  if (options.iterations < 0 || !std::isfinite(options.tolerance) || options.tolerance < 0.) {
    throw std::invalid_argument(std::string(function) + ": iterations and tolerance must not be negative, got " +
                                std::to_string(options.iterations) + " and " + std::to_string(options.tolerance));
  }
  check_start(start, function);
  check_slices(slices, geometry, function);
  const torch::Tensor w = checked_weights(weights, slices.size(0), function);
  // A^T W A x = A^T W y
  const torch::Tensor b =
      scatter_slices(weighted(slices.detach(), w), geometry, shape_of(start), /*equalize=*/false, masks);
  const auto apply = [&](const torch::Tensor& x) {
    return normal_operator(x, geometry, slices.size(2), slices.size(3), w, masks);
  };
  return conjugate_gradient(apply, b, start, options, report).clamp_min_(0);
}

torch::Tensor refine_edge_preserving(const torch::Tensor& slices, const AcquisitionGeometry& geometry,
                                     const torch::Tensor& weights, const torch::Tensor& start,
                                     const EdgePreservingOptions& options, const AcquisitionMasks& masks) {
  const char* function = "refine_edge_preserving";
  if (options.iterations < 0 || !(options.step > 0.) || !(options.strength >= 0.) || !(options.edge > 0.)) {
    throw std::invalid_argument(std::string(function) +
                                ": iterations and strength must not be negative, step and edge must be positive");
  }
  check_start(start, function);
  check_slices(slices, geometry, function);
  const torch::Tensor w = checked_weights(weights, slices.size(0), function);
  torch::Tensor x = start.detach().clone(torch::MemoryFormat::Contiguous);
  for (int i = 0; i < options.iterations; ++i) {
    const torch::Tensor error =
        acquire_slices(x, geometry, static_cast<int>(slices.size(2)), static_cast<int>(slices.size(3)), masks) -
        slices.detach();
    torch::Tensor gradient = scatter_slices(weighted(error, w), geometry, shape_of(x), /*equalize=*/false, masks);
    add_edge_prior_gradient(x, options.edge, options.strength * options.edge * options.edge, &gradient);
    x.sub_(gradient * options.step);
  }
  return x.clamp_min_(0);
}

}  // namespace svort
