#include "conjugate_gradient.h"

#include <torch/types.h>

#include <algorithm>
#include <array>
#include <cmath>
#include <cstdint>
#include <numeric>
#include <vector>

#include "../acquisition/parallel.h"

namespace svort {
namespace {

// Sums are formed block by block, in one order whatever the number of threads.
constexpr std::int64_t kBlock = std::int64_t{1} << 15;

// Sum over all elements of product(i), in float64; product may change element i of other arrays.
template <class Product>
double sum_of(std::int64_t count, const Product& product) {
  std::vector<double> sums(static_cast<std::size_t>((count + kBlock - 1) / kBlock), 0.);
  parallel_chunks(static_cast<std::int64_t>(sums.size()), [&](std::int64_t first, std::int64_t last) {
    // Independent sums, or each addition would wait for the last.
    constexpr std::int64_t kLanes = 8;
    for (std::int64_t block = first; block < last; ++block) {
      std::array<double, kLanes> lanes{};
      const std::int64_t end = std::min(count, (block + 1) * kBlock);
      std::int64_t i = block * kBlock;
      for (; i + kLanes <= end; i += kLanes) {
        for (std::int64_t lane = 0; lane < kLanes; ++lane) lanes[static_cast<std::size_t>(lane)] += product(i + lane);
      }
      for (; i < end; ++i) lanes[0] += product(i);
      sums[static_cast<std::size_t>(block)] = std::accumulate(lanes.begin(), lanes.end(), 0.);
    }
  });
  return std::accumulate(sums.begin(), sums.end(), 0.);
}

double inner_product(const torch::Tensor& a, const torch::Tensor& b) {
  const float* __restrict__ x = a.data_ptr<float>();
  const float* __restrict__ y = b.data_ptr<float>();
  return sum_of(a.numel(), [x, y](std::int64_t i) { return static_cast<double>(x[i]) * static_cast<double>(y[i]); });
}

}  // namespace

torch::Tensor conjugate_gradient(const LinearOperator& apply, const torch::Tensor& b, const torch::Tensor& start,
                                 const ConjugateGradientOptions& options, ConjugateGradientReport* report) {
  const std::int64_t count = start.numel();
  torch::Tensor solution = start.detach().clone(torch::MemoryFormat::Contiguous);
  torch::Tensor residual = apply(solution);
  float* __restrict__ x = solution.data_ptr<float>();
  float* __restrict__ r = residual.data_ptr<float>();
  const float* __restrict__ right = b.data_ptr<float>();
  // r = b - A x
  double squared_residual = sum_of(count, [right, r](std::int64_t i) {
    r[i] = right[i] - r[i];
    return static_cast<double>(r[i]) * static_cast<double>(r[i]);
  });
  torch::Tensor direction = residual.clone();
  float* __restrict__ p = direction.data_ptr<float>();
  const double norm_b = std::sqrt(inner_product(b, b));
  const double scale = norm_b > 0. ? norm_b : 1.;
  ConjugateGradientReport done;
  done.relative_residual.push_back(std::sqrt(squared_residual) / scale);
  while (done.iterations < options.iterations && done.relative_residual.back() > options.tolerance) {
    const torch::Tensor image = apply(direction);
    const double curvature = inner_product(direction, image);
    if (!(curvature > 0.)) break;
    const auto step = static_cast<float>(squared_residual / curvature);
    const float* __restrict__ image_values = image.data_ptr<float>();
    const double squared_residual_new = sum_of(count, [=](std::int64_t i) {
      x[i] += step * p[i];
      r[i] -= step * image_values[i];
      return static_cast<double>(r[i]) * static_cast<double>(r[i]);
    });
    const auto keep = static_cast<float>(squared_residual_new / squared_residual);
    parallel_chunks(count, [=](std::int64_t first, std::int64_t last) {
      for (std::int64_t i = first; i < last; ++i) p[i] = r[i] + keep * p[i];
    });
    squared_residual = squared_residual_new;
    ++done.iterations;
    done.relative_residual.push_back(std::sqrt(squared_residual) / scale);
  }
  if (report != nullptr) *report = done;
  return solution;
}

torch::Tensor unrolled_conjugate_gradient(const LinearOperator& apply, const torch::Tensor& b,
                                          const torch::Tensor& start, const ConjugateGradientOptions& options,
                                          ConjugateGradientReport* report) {
  const auto product = [](const torch::Tensor& x, const torch::Tensor& y) { return (x * y).sum(torch::kFloat64); };
  torch::Tensor x = start, r = b - apply(x), p = r;
  torch::Tensor squared_residual = product(r, r);
  const double norm_b = std::sqrt(product(b, b).item<double>());
  const double scale = norm_b > 0. ? norm_b : 1.;
  ConjugateGradientReport done;
  done.relative_residual.push_back(std::sqrt(squared_residual.item<double>()) / scale);
  while (done.iterations < options.iterations && done.relative_residual.back() > options.tolerance) {
    const torch::Tensor image = apply(p);
    const torch::Tensor curvature = product(p, image);
    if (!(curvature.item<double>() > 0.)) break;
    const torch::Tensor step = (squared_residual / curvature).to(x.scalar_type());
    x = x + step * p;
    r = r - step * image;
    const torch::Tensor squared_residual_new = product(r, r);
    p = r + (squared_residual_new / squared_residual).to(x.scalar_type()) * p;
    squared_residual = squared_residual_new;
    ++done.iterations;
    done.relative_residual.push_back(std::sqrt(squared_residual.item<double>()) / scale);
  }
  if (report != nullptr) *report = done;
  return x;
}

}  // namespace svort
