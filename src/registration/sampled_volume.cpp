#include "sampled_volume.h"

#include <algorithm>
#include <cmath>
#include <utility>

#include "../acquisition/psf_split.h"

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

  const std::int32_t n = size;
  blur_volume(half, {n, n, n}, values.data(), values.data());
  return values;
}

}  // namespace svort
