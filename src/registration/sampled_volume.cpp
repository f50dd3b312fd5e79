#include "sampled_volume.h"

#include <algorithm>
#include <array>
#include <cmath>
#include <utility>

#include "../acquisition/psf_split.h"

namespace svort {

namespace {

/// Voxels first .. end along x, y, z.
struct Box {
  std::array<int, 3> first{}, end{};

  int width(std::size_t axis) const { return std::max(0, end[axis] - first[axis]); }
  std::size_t count() const {
    return static_cast<std::size_t>(width(0)) * static_cast<std::size_t>(width(1)) * static_cast<std::size_t>(width(2));
  }
};

/// The smallest box that holds all voxels that are not 0.
Box occupied(const std::vector<float>& values, int size) {
  Box box;
  box.first.fill(size);
  const float* row = values.data();
  for (int z = 0; z < size; ++z)
    for (int y = 0; y < size; ++y, row += size) {
      const auto is_set = [](float value) { return value != 0.F; };
      const float* const begin = std::find_if(row, row + size, is_set);
      if (begin == row + size) continue;
      const float* last = row + size;
      while (!is_set(*(last - 1))) --last;
      const std::array<int, 3> from{static_cast<int>(begin - row), y, z},
          to{static_cast<int>(last - row), y + 1, z + 1};
      for (std::size_t axis = 0; axis < 3; ++axis) {
        box.first[axis] = std::min(box.first[axis], from[axis]);
        box.end[axis] = std::max(box.end[axis], to[axis]);
      }
    }
  return box;
}

Box grown(Box box, int by, int size) {
  if (box.count() == 0) return box;
  for (std::size_t axis = 0; axis < 3; ++axis) {
    box.first[axis] = std::max(0, box.first[axis] - by);
    box.end[axis] = std::min(size, box.end[axis] + by);
  }
  return box;
}

}  // namespace

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

  // The head fills a small part of its cube: only there, and as far as the blur reaches, is there anything to do.
  const Box box = grown(occupied(values, size), radius, size);
  if (box.count() == 0) return values;
  std::vector<float> part(box.count());
  const auto rows = [&](const auto& copy) {
    float* inside = part.data();
    for (int z = box.first[2]; z < box.end[2]; ++z)
      for (int y = box.first[1]; y < box.end[1]; ++y, inside += box.width(0))
        copy(inside, values.data() + (static_cast<std::int64_t>(z) * size + y) * size + box.first[0]);
  };
  rows([&](float* inside, const float* row) { std::copy(row, row + box.width(0), inside); });
  blur_volume(half, {box.width(0), box.width(1), box.width(2)}, part.data(), part.data());
  rows([&](const float* inside, float* row) { std::copy(inside, inside + box.width(0), row); });
  return values;
}

}  // namespace svort
