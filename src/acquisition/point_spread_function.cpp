#include "svort_ros/acquisition/point_spread_function.h"

#include <algorithm>
#include <cmath>
#include <stdexcept>
#include <string>
#include <vector>

namespace svort {
namespace {

// FWHM of a Gaussian of unit sigma is 2 sqrt(2 ln 2).
const double kSigmaOfFwhm = 1. / (2. * std::sqrt(2. * std::log(2.)));
// FWHM of the sinc that a Cartesian readout gives in plane, in pixels: the paper's "1.2 x pixel".
constexpr double kSincFwhm = 1.206709128803223;
constexpr float kThreshold = 1e-3F;  // taps below this fraction of the peak are dropped
constexpr int kSmallestDefaultRadius = 4;
constexpr int kLargestRadius = 256;  // a ratio beyond that is a mix-up of units, not a scan

}  // namespace

torch::Tensor gaussian_psf(const std::array<double, 3>& resolution_ratio, std::optional<int> r_max) {
  for (const double ratio : resolution_ratio) {
    if (!std::isfinite(ratio) || !(ratio > 0.)) {
      throw std::invalid_argument("gaussian_psf: resolution_ratio must be finite and positive, got " +
                                  std::to_string(ratio));
    }
  }
  const std::array<double, 3> sigma = {kSincFwhm * kSigmaOfFwhm * resolution_ratio[0],
                                       kSincFwhm * kSigmaOfFwhm * resolution_ratio[1],
                                       kSigmaOfFwhm * resolution_ratio[2]};
  const double widest = 2. * *std::max_element(sigma.begin(), sigma.end()) + 1.;
  if (widest > kLargestRadius || r_max.value_or(0) > kLargestRadius || r_max.value_or(0) < 0) {
    throw std::invalid_argument("gaussian_psf: the half width must be 0 to " + std::to_string(kLargestRadius) +
                                " voxels; resolution_ratio asks for " + std::to_string(widest) + ", r_max is " +
                                (r_max ? std::to_string(*r_max) : "not set"));
  }
  const int radius = r_max.value_or(std::max(static_cast<int>(widest), kSmallestDefaultRadius));

  // Every tap beyond an axis' own reach is zero, so the crop is the reach along each axis.
  const auto tap = [&sigma](int x, int y, int z) {
    const auto term = [](int offset, double s) {
      return static_cast<float>(offset * offset) / static_cast<float>(s * s);
    };
    const float value = std::exp(-0.5F * (term(x, sigma[0]) + term(y, sigma[1]) + term(z, sigma[2])));
    return value < kThreshold ? 0.F : value;
  };
  int rx = radius, ry = radius, rz = radius;
  while (rx > 0 && tap(rx, 0, 0) == 0.F) --rx;
  while (ry > 0 && tap(0, ry, 0) == 0.F) --ry;
  while (rz > 0 && tap(0, 0, rz) == 0.F) --rz;

  torch::Tensor psf = torch::empty({2 * rz + 1, 2 * ry + 1, 2 * rx + 1}, torch::kFloat32);
  auto values = psf.accessor<float, 3>();
  double sum = 0.;
  for (int z = -rz; z <= rz; ++z) {
    for (int y = -ry; y <= ry; ++y) {
      for (int x = -rx; x <= rx; ++x) {
        values[z + rz][y + ry][x + rx] = tap(x, y, z);
        sum += tap(x, y, z);
      }
    }
  }
  return psf.div_(sum);
}

torch::Tensor stack_psfs(const std::vector<torch::Tensor>& psfs) {
  if (psfs.empty()) throw std::invalid_argument("stack_psfs: no PSF given");
  std::array<std::int64_t, 3> size = {1, 1, 1};
  for (const torch::Tensor& psf : psfs) {
    if (!psf.defined() || psf.dim() != 3) throw std::invalid_argument("stack_psfs: a PSF must be three-dimensional");
    for (std::int64_t axis = 0; axis < 3; ++axis) {
      if (psf.size(axis) % 2 == 0) throw std::invalid_argument("stack_psfs: a PSF must have an odd size");
      auto& largest = size[static_cast<std::size_t>(axis)];
      largest = std::max(largest, psf.size(axis));
    }
  }
  torch::Tensor stacked =
      torch::zeros({static_cast<std::int64_t>(psfs.size()), size[0], size[1], size[2]}, torch::kFloat32);
  for (std::size_t i = 0; i < psfs.size(); ++i) {
    torch::Tensor target = stacked[static_cast<std::int64_t>(i)];
    for (std::int64_t axis = 0; axis < 3; ++axis) {
      const std::int64_t count = psfs[i].size(axis);
      target = target.narrow(axis, (size[static_cast<std::size_t>(axis)] - count) / 2, count);
    }
    target.copy_(psfs[i]);
  }
  return stacked;
}

}  // namespace svort
