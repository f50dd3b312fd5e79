#include "conjugate_gradient.h"

#include <torch/torch.h>

#include <array>
#include <cmath>
#include <cstdint>

namespace svort {
namespace {

// Inner product in float64 and in one fixed order: BLAS would change the last bits with the number of threads. A volume
// of 128^3 takes about a millisecond, the operator a hundred times that.
double inner_product(const torch::Tensor& a, const torch::Tensor& b) {
  const float* x = a.data_ptr<float>();
  const float* y = b.data_ptr<float>();
  const std::int64_t count = a.numel();
  // Independent sums, or each addition would wait for the last.
  constexpr std::int64_t kLanes = 8;
  std::array<double, kLanes> sums{};
  std::int64_t i = 0;
  for (; i + kLanes <= count; i += kLanes) {
    for (std::int64_t lane = 0; lane < kLanes; ++lane) {
      sums[static_cast<std::size_t>(lane)] += static_cast<double>(x[i + lane]) * static_cast<double>(y[i + lane]);
    }
  }
  double sum = 0.;
  for (; i < count; ++i) sum += static_cast<double>(x[i]) * static_cast<double>(y[i]);
  for (const double lane : sums) sum += lane;
  return sum;
}

// y <- a x + b y, element by element, so that no vectorised tail rounds differently.
void combine(double a, const torch::Tensor& x, double b, torch::Tensor* y) {
  const float* source = x.data_ptr<float>();
  float* target = y->data_ptr<float>();
  const auto fa = static_cast<float>(a), fb = static_cast<float>(b);
  for (std::int64_t i = 0; i < x.numel(); ++i) target[i] = fa * source[i] + fb * target[i];
}

}  // namespace

torch::Tensor conjugate_gradient(const LinearOperator& apply, const torch::Tensor& b, const torch::Tensor& start,
                                 const ConjugateGradientOptions& options, ConjugateGradientReport* report) {
  torch::Tensor x = start.detach().clone(torch::MemoryFormat::Contiguous);
  torch::Tensor r = apply(x);
  combine(1., b, -1., &r);  // r = b - A x
  torch::Tensor p = r.clone();
  double squared_residual = inner_product(r, r);
  const double norm_b = std::sqrt(inner_product(b, b));
  const double scale = norm_b > 0. ? norm_b : 1.;
  ConjugateGradientReport done;
  done.relative_residual.push_back(std::sqrt(squared_residual) / scale);
  while (done.iterations < options.iterations && done.relative_residual.back() > options.tolerance) {
    const torch::Tensor image = apply(p);
    const double curvature = inner_product(p, image);
    if (!(curvature > 0.)) break;
    const double step = squared_residual / curvature;
    combine(step, p, 1., &x);
    combine(-step, image, 1., &r);
    const double squared_residual_new = inner_product(r, r);
    combine(1., r, squared_residual_new / squared_residual, &p);
    squared_residual = squared_residual_new;
    ++done.iterations;
    done.relative_residual.push_back(std::sqrt(squared_residual) / scale);
  }
  if (report != nullptr) *report = done;
  return x;
}

}  // namespace svort
