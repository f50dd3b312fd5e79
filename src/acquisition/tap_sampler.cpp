#include "tap_sampler.h"

#include <algorithm>

namespace svort {
namespace {

// Voxels kept between "certainly inside" and the rim, far above the rounding of a float32 coordinate.
constexpr float kMargin = 0.01F;

// Taps apart in the list that may be added to at the same time; a prime, so that it divides no row of taps.
constexpr std::size_t kSpread = 37;
// The same for a single row of taps.
constexpr std::size_t kSpreadOfRow = 2;

}  // namespace

PsfTaps nonzero_taps(const float* psf, const std::array<std::int64_t, 3>& size) {
  PsfTaps taps;
  for (std::int64_t z = 0; z < size[0]; ++z) {
    for (std::int64_t y = 0; y < size[1]; ++y) {
      for (std::int64_t x = 0; x < size[2]; ++x) {
        const float value = psf[(z * size[1] + y) * size[2] + x];
        if (value == 0.F) continue;
        taps.value.push_back(value);
        // Along an axis of even size the extra tap is on the negative side.
        taps.offset.push_back({static_cast<float>(x - size[2] / 2), static_cast<float>(y - size[1] / 2),
                               static_cast<float>(z - size[0] / 2)});
      }
    }
  }
  return taps;
}

PsfTaps spread_taps(const PsfTaps& taps) {
  const std::size_t step = taps.count() > 2 * kSpread ? kSpread : kSpreadOfRow;
  PsfTaps spread;
  for (std::size_t first = 0; first < std::min(step, taps.count()); ++first) {
    for (std::size_t i = first; i < taps.count(); i += step) {
      spread.value.push_back(taps.value[i]);
      spread.offset.push_back(taps.offset[i]);
    }
  }
  return spread;
}

SliceTaps::SliceTaps(const PsfTaps& taps, const float* transform, const VolumeShape& shape, std::int32_t slice_width,
                     std::int32_t slice_height, double resolution_ratio)
    : taps_(taps),
      shape_(shape),
      limit_{static_cast<float>(shape.width - 1), static_cast<float>(shape.height - 1),
             static_cast<float>(shape.depth - 1)},
      term_(9 * taps.count()) {
  std::copy(transform, transform + 12, plane_.transform);
  plane_.column_origin = (slice_width - 1) / 2.;
  plane_.row_origin = (slice_height - 1) / 2.;
  plane_.resolution_ratio = static_cast<float>(resolution_ratio);
  plane_.middle[0] = (shape.width - 1) / 2.;
  plane_.middle[1] = (shape.height - 1) / 2.;
  plane_.middle[2] = (shape.depth - 1) / 2.;
  const std::size_t count = taps.count();
  for (std::size_t axis = 0; axis < 3; ++axis) {
    for (std::size_t t = 0; t < count; ++t) {
      float reach = 0.F;
      for (std::size_t column = 0; column < 3; ++column) {
        const float term = plane_.transform[4 * axis + column] * taps.offset[t][column];
        term_[(3 * axis + column) * count + t] = term;
        reach += term;
      }
      lowest_[axis] = std::min(lowest_[axis], reach);
      highest_[axis] = std::max(highest_[axis], reach);
    }
  }
  for (const float value : taps.value) total_ += value;
}

std::array<float, 3> SliceTaps::centre(std::int32_t column, std::int32_t row) const {
  const float* m = plane_.transform;
  const float x =
      static_cast<float>((column - plane_.column_origin) * plane_.resolution_ratio + static_cast<double>(m[3]));
  const float y = static_cast<float>((row - plane_.row_origin) * plane_.resolution_ratio + static_cast<double>(m[7]));
  const float z = m[11];
  std::array<float, 3> centre{};
  for (std::size_t axis = 0; axis < 3; ++axis) {
    const float rotated = m[4 * axis] * x + m[4 * axis + 1] * y + m[4 * axis + 2] * z;
    centre[axis] = static_cast<float>(static_cast<double>(rotated) + plane_.middle[axis]);
  }
  return centre;
}

Reach SliceTaps::reach(const std::array<float, 3>& centre, float margin) const {
  bool interior = true;
  for (std::size_t axis = 0; axis < 3; ++axis) {
    const float low = centre[axis] + lowest_[axis], high = centre[axis] + highest_[axis];
    // Written so that a coordinate that is not a number is outside.
    if (!(high >= -kMargin && low <= limit_[axis] + kMargin)) return Reach::outside;
    interior = interior && low > margin + kMargin && high < limit_[axis] - margin - kMargin;
  }
  return interior ? Reach::interior : Reach::rim;
}

TapList SliceTaps::list() const {
  TapList list;
  list.count = taps_.count();
  list.value = taps_.value.data();
  for (std::size_t i = 0; i < 9; ++i) list.term[i] = term_.data() + i * list.count;
  for (std::size_t axis = 0; axis < 3; ++axis) list.limit[axis] = limit_[axis];
  list.stride_y = shape_.stride_y();
  list.stride_z = shape_.stride_z();
  return list;
}

}  // namespace svort
