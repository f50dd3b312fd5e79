#include "sampled_volume.h"

#include <algorithm>
#include <cmath>
#include <utility>

#include "../acquisition/parallel.h"

namespace svort {

SampledVolume::SampledVolume(std::vector<float> values, int size, double voxel_mm)
    : values_(std::move(values)),
      size_(size),
      voxel_mm_(voxel_mm),
      inverse_voxel_(static_cast<float>(1. / voxel_mm)),
      centre_(static_cast<float>(0.5 * (size - 1))) {}

std::vector<float> blurred(std::vector<float> values, int size, double sigma) {
  if (sigma < 0.1) return values;
  const int radius = std::max(1, static_cast<int>(std::ceil(3. * sigma)));
  std::vector<float> half(static_cast<std::size_t>(radius) + 1);
  double sum = 0.;
  for (int i = 0; i <= radius; ++i) sum += (i ? 2. : 1.) * std::exp(-0.5 * i * i / (sigma * sigma));
  for (int i = 0; i <= radius; ++i)
    half[static_cast<std::size_t>(i)] = static_cast<float>(std::exp(-0.5 * i * i / (sigma * sigma)) / sum);

  const std::int64_t n = size, plane = n * n;
  std::vector<float> other(values.size());
  // x, y and z pass alike: `stride` apart along the axis, whole rows of x at a time for y and z.
  const auto pass = [&](const std::vector<float>& from, std::vector<float>& to, std::int64_t stride) {
    parallel_chunks(n, [&](std::int64_t begin, std::int64_t end) {
      for (std::int64_t z = begin; z < end; ++z) {
        for (std::int64_t y = 0; y < n; ++y) {
          const std::int64_t row = z * plane + y * n;
          const std::int64_t along = stride == n ? y : z;
          float* out = to.data() + row;
          if (stride == 1) {
            for (std::int64_t x = 0; x < n; ++x) {
              float total = half[0] * from[static_cast<std::size_t>(row + x)];
              for (std::int64_t i = 1; i <= radius; ++i) {
                const float weight = half[static_cast<std::size_t>(i)];
                if (x >= i) total += weight * from[static_cast<std::size_t>(row + x - i)];
                if (x + i < n) total += weight * from[static_cast<std::size_t>(row + x + i)];
              }
              out[x] = total;
            }
            continue;
          }
          const float* in = from.data() + row;
          for (std::int64_t x = 0; x < n; ++x) out[x] = half[0] * in[x];
          for (std::int64_t i = 1; i <= radius; ++i) {
            const float weight = half[static_cast<std::size_t>(i)];
            if (along >= i)
              for (std::int64_t x = 0; x < n; ++x) out[x] += weight * in[x - i * stride];
            if (along + i < n)
              for (std::int64_t x = 0; x < n; ++x) out[x] += weight * in[x + i * stride];
          }
        }
      }
    });
  };
  pass(values, other, 1);
  pass(other, values, n);
  pass(values, other, plane);
  return other;
}

}  // namespace svort
