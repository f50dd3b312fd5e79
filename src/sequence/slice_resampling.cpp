#include "slice_resampling.h"

#include <algorithm>
#include <cmath>
#include <cstddef>

namespace svort {
namespace {

/// One output sample along an axis: weights of consecutive source samples. Empty weights: off the image.
struct Taps {
  int first = 0;
  std::vector<double> weights;
};

/// Symmetric Gaussian weights for offsets -radius .. radius, sum 1; just {1} if the pixels do not grow.
std::vector<double> antialiasing_kernel(double source_spacing, double target_spacing) {
  const double ratio = target_spacing / source_spacing;
  if (ratio <= 1. + 1e-6) return {1.};
  const double sigma = 1.2 / (2. * std::sqrt(2. * std::log(2.))) * std::sqrt(ratio * ratio - 1.);
  const int radius = static_cast<int>(std::ceil(3. * sigma));
  std::vector<double> kernel;
  double sum = 0.;
  for (int i = -radius; i <= radius; ++i) {
    kernel.push_back(std::exp(-0.5 * i * i / (sigma * sigma)));
    sum += kernel.back();
  }
  for (double& weight : kernel) weight /= sum;
  return kernel;
}

/// Blur and linear interpolation of one axis in one step.
std::vector<Taps> axis_taps(int source_count, double source_spacing, int target_count, double target_spacing,
                            double shift) {
  const std::vector<double> kernel = antialiasing_kernel(source_spacing, target_spacing);
  const int radius = static_cast<int>(kernel.size() / 2);
  std::vector<Taps> taps(static_cast<std::size_t>(target_count));
  for (int i = 0; i < target_count; ++i) {
    const double position =
        ((i - 0.5 * (target_count - 1)) * target_spacing + shift) / source_spacing + 0.5 * (source_count - 1);
    if (!(position >= -0.5 && position <= source_count - 0.5)) continue;
    const double clamped = std::clamp(position, 0., static_cast<double>(source_count - 1));
    const int left = std::min(static_cast<int>(clamped), std::max(source_count - 2, 0));
    const double fraction = clamped - left;

    Taps& tap = taps[static_cast<std::size_t>(i)];
    tap.first = std::max(left - radius, 0);
    const int last = std::min(left + 1 + radius, source_count - 1);
    tap.weights.assign(static_cast<std::size_t>(last - tap.first + 1), 0.);
    // Taps beyond the border fall on the border pixel, which continues the image by its outermost value.
    const auto put = [&](int source, double weight) {
      const int index = std::clamp(source, 0, source_count - 1) - tap.first;
      tap.weights[static_cast<std::size_t>(index)] += weight;
    };
    for (int k = -radius; k <= radius; ++k) {
      const double weight = kernel[static_cast<std::size_t>(k + radius)];
      put(left + k, (1. - fraction) * weight);
      if (fraction > 0.) put(left + 1 + k, fraction * weight);
    }
  }
  return taps;
}

}  // namespace

std::vector<float> resample_plane(const std::vector<float>& image, const PlaneGrid& source, const PlaneGrid& target,
                                  const Eigen::Vector2d& shift, std::vector<std::uint8_t>* inside) {
  const auto x_taps = axis_taps(source.columns, source.spacing.x(), target.columns, target.spacing.x(), shift.x());
  const auto y_taps = axis_taps(source.rows, source.spacing.y(), target.rows, target.spacing.y(), shift.y());
  const auto width = static_cast<std::size_t>(target.columns);
  const auto source_width = static_cast<std::size_t>(source.columns);

  // Along x first, for the source rows that any output row uses.
  int first_row = source.rows;
  int end_row = 0;
  for (const Taps& tap : y_taps) {
    if (tap.weights.empty()) continue;
    first_row = std::min(first_row, tap.first);
    end_row = std::max(end_row, tap.first + static_cast<int>(tap.weights.size()));
  }
  std::vector<double> along_x(width * static_cast<std::size_t>(std::max(end_row - first_row, 0)), 0.);
  for (int row = first_row; row < end_row; ++row) {
    const float* in = image.data() + static_cast<std::size_t>(row) * source_width;
    double* out = along_x.data() + static_cast<std::size_t>(row - first_row) * width;
    for (std::size_t x = 0; x < width; ++x) {
      const Taps& tap = x_taps[x];
      for (std::size_t k = 0; k < tap.weights.size(); ++k)
        out[x] += tap.weights[k] * static_cast<double>(in[static_cast<std::size_t>(tap.first) + k]);
    }
  }

  std::vector<float> result(width * static_cast<std::size_t>(target.rows), 0.F);
  if (inside) inside->assign(result.size(), 0);
  std::vector<double> sums(width);
  for (std::size_t y = 0; y < y_taps.size(); ++y) {
    const Taps& tap = y_taps[y];
    if (tap.weights.empty()) continue;
    std::fill(sums.begin(), sums.end(), 0.);
    for (std::size_t k = 0; k < tap.weights.size(); ++k) {
      const double* in = along_x.data() + (static_cast<std::size_t>(tap.first - first_row) + k) * width;
      for (std::size_t x = 0; x < width; ++x) sums[x] += tap.weights[k] * in[x];
    }
    for (std::size_t x = 0; x < width; ++x) {
      if (x_taps[x].weights.empty()) continue;
      result[y * width + x] = static_cast<float>(sums[x]);
      if (inside) (*inside)[y * width + x] = 1;
    }
  }
  return result;
}

}  // namespace svort
