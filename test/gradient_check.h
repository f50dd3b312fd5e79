#pragma once

#include <torch/autograd.h>
#include <torch/types.h>

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <functional>
#include <limits>

namespace svort {

/// Largest difference between the gradient of a scalar function and central differences, relative to the largest
/// derivative; infinite if the gradient is 0 everywhere. For float64.
/// @param checks number of elements that are checked, spread over the argument
inline double gradient_error(const std::function<torch::Tensor(const torch::Tensor&)>& function,
                             const torch::Tensor& argument, std::int64_t checks, double step = 1e-5) {
  const torch::Tensor at = argument.detach().clone().requires_grad_();
  function(at).backward();
  if (!at.grad().defined()) return std::numeric_limits<double>::infinity();
  const torch::Tensor gradient = at.grad().reshape({-1});
  const double largest = gradient.abs().max().item<double>();
  if (!(largest > 0.)) return std::numeric_limits<double>::infinity();
  const torch::NoGradGuard no_grad;
  const std::int64_t count = argument.numel();
  double worst = 0.;
  for (std::int64_t i = -1; i < std::min(checks, count); ++i) {
    // The largest derivative is always among them; the others are spread by a stride that shares no factor.
    std::int64_t element = gradient.abs().argmax().item<std::int64_t>();
    if (i >= 0) element = checks >= count ? i : (i * 7919) % count;
    const auto moved = [&](double by) {
      torch::Tensor other = argument.detach().clone();
      other.view({-1})[element] += by;
      return function(other).item<double>();
    };
    const double difference = (moved(step) - moved(-step)) / (2 * step);
    worst = std::max(worst, std::abs(difference - gradient[element].item<double>()) / largest);
  }
  return worst;
}

}  // namespace svort
