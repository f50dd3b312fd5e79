#include "tap_sampler.h"

#include <algorithm>
#include <cmath>

namespace svort {
namespace {

// Voxels kept between "certainly inside" and the rim, far above the rounding of a float32 coordinate.
constexpr float kMargin = 0.01F;

// Taps apart in the list that may be added to at the same time; a prime, so that it divides no row of taps.
constexpr std::size_t kSpread = 37;

// Cell and position within it along one axis, for positions that are not negative: truncation is floor(). Plain arrays
// that do not overlap, so that the compiler vectorises the loop.
void locate_along(float centre, const float* __restrict__ from_x, const float* __restrict__ from_y,
                  const float* __restrict__ from_z, std::size_t count, std::int32_t* __restrict__ cell,
                  float* __restrict__ within) {
  for (std::size_t t = 0; t < count; ++t) {
    const float position = centre + from_x[t] + from_y[t] + from_z[t];
    cell[t] = static_cast<std::int32_t>(position);
    within[t] = position - static_cast<float>(cell[t]);
  }
}

// Array offsets, and the PSF values split between the two planes of each cell; `upper` holds the position along z
// before.
void combine_axes(const VolumeShape& shape, const float* __restrict__ value, std::size_t count,
                  const std::int32_t* __restrict__ x, const std::int32_t* __restrict__ y,
                  const std::int32_t* __restrict__ z, std::int32_t* __restrict__ index, float* __restrict__ lower,
                  float* __restrict__ upper) {
  const std::int32_t stride_y = shape.stride_y(), stride_z = shape.stride_z();
  for (std::size_t t = 0; t < count; ++t) {
    index[t] = z[t] * stride_z + y[t] * stride_y + x[t];
    lower[t] = (1.F - upper[t]) * value[t];
    upper[t] = upper[t] * value[t];
  }
}

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
  PsfTaps spread;
  for (std::size_t first = 0; first < std::min(kSpread, taps.count()); ++first) {
    for (std::size_t i = first; i < taps.count(); i += kSpread) {
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
      column_origin_((slice_width - 1) / 2.),
      row_origin_((slice_height - 1) / 2.),
      resolution_ratio_(static_cast<float>(resolution_ratio)),
      limit_{static_cast<float>(shape.width - 1), static_cast<float>(shape.height - 1),
             static_cast<float>(shape.depth - 1)},
      middle_{(shape.width - 1) / 2., (shape.height - 1) / 2., (shape.depth - 1) / 2.} {
  std::copy(transform, transform + 12, transform_.begin());
  for (std::size_t axis = 0; axis < 3; ++axis) {
    for (std::size_t column = 0; column < 3; ++column) {
      std::vector<float>& term = term_[3 * axis + column];
      term.resize(taps.count());
      for (std::size_t t = 0; t < taps.count(); ++t) term[t] = transform_[4 * axis + column] * taps.offset[t][column];
    }
    for (std::size_t t = 0; t < taps.count(); ++t) {
      const float reach = term_[3 * axis][t] + term_[3 * axis + 1][t] + term_[3 * axis + 2][t];
      lowest_[axis] = std::min(lowest_[axis], reach);
      highest_[axis] = std::max(highest_[axis], reach);
    }
  }
  for (const float value : taps.value) total_ += value;
}

std::array<float, 3> SliceTaps::centre(std::int32_t column, std::int32_t row) const {
  const std::array<float, 12>& m = transform_;
  const float x = static_cast<float>((column - column_origin_) * resolution_ratio_ + static_cast<double>(m[3]));
  const float y = static_cast<float>((row - row_origin_) * resolution_ratio_ + static_cast<double>(m[7]));
  const float z = m[11];
  std::array<float, 3> centre{};
  for (std::size_t axis = 0; axis < 3; ++axis) {
    const float rotated = m[4 * axis] * x + m[4 * axis + 1] * y + m[4 * axis + 2] * z;
    centre[axis] = static_cast<float>(static_cast<double>(rotated) + middle_[axis]);
  }
  return centre;
}

std::array<std::int32_t, 2> SliceTaps::planes(const std::array<float, 3>& centre) const {
  const float last = limit_[2];
  const float low = std::clamp(std::floor(centre[2] + lowest_[2] - kMargin), 0.F, last);
  const float high = std::clamp(std::floor(centre[2] + highest_[2] + kMargin) + 1.F, 0.F, last);
  return {static_cast<std::int32_t>(low), static_cast<std::int32_t>(high)};
}

SliceTaps::Reach SliceTaps::reach(const std::array<float, 3>& centre) const {
  bool interior = true;
  for (std::size_t axis = 0; axis < 3; ++axis) {
    const float low = centre[axis] + lowest_[axis], high = centre[axis] + highest_[axis];
    if (high < -kMargin || low > limit_[axis] + kMargin) return Reach::kOutside;
    interior = interior && low > kMargin && high < limit_[axis] - kMargin;
  }
  return interior ? Reach::kInterior : Reach::kRim;
}

void SliceTaps::place(const std::array<float, 3>& centre, TapSamples* samples) const {
  switch (reach(centre)) {
    case Reach::kOutside:
      samples->count = 0;
      samples->weight = 0.F;
      return;
    case Reach::kInterior:
      place_interior(centre, samples);
      return;
    case Reach::kRim:
      place_rim(centre, samples);
      return;
  }
}

void SliceTaps::place_interior(const std::array<float, 3>& centre, TapSamples* samples) const {
  locate_along(centre[0], term_[0].data(), term_[1].data(), term_[2].data(), taps_.count(), samples->cell_x.data(),
               samples->wx.data());
  locate_along(centre[1], term_[3].data(), term_[4].data(), term_[5].data(), taps_.count(), samples->cell_y.data(),
               samples->wy.data());
  locate_along(centre[2], term_[6].data(), term_[7].data(), term_[8].data(), taps_.count(), samples->cell_z.data(),
               samples->upper.data());
  combine_axes(shape_, taps_.value.data(), taps_.count(), samples->cell_x.data(), samples->cell_y.data(),
               samples->cell_z.data(), samples->index.data(), samples->lower.data(), samples->upper.data());
  samples->count = taps_.count();
  samples->weight = total_;
}

void SliceTaps::place_rim(const std::array<float, 3>& centre, TapSamples* samples) const {
  std::size_t kept = 0;
  samples->weight = 0.F;
  for (std::size_t t = 0; t < taps_.count(); ++t) {
    const float x = centre[0] + term_[0][t] + term_[1][t] + term_[2][t];
    const float y = centre[1] + term_[3][t] + term_[4][t] + term_[5][t];
    const float z = centre[2] + term_[6][t] + term_[7][t] + term_[8][t];
    if (!contains(x, y, z)) continue;
    const auto ix = static_cast<std::int32_t>(x), iy = static_cast<std::int32_t>(y), iz = static_cast<std::int32_t>(z);
    samples->index[kept] = iz * shape_.stride_z() + iy * shape_.stride_y() + ix;
    samples->wx[kept] = x - static_cast<float>(ix);
    samples->wy[kept] = y - static_cast<float>(iy);
    const float wz = z - static_cast<float>(iz);
    samples->lower[kept] = (1.F - wz) * taps_.value[t];
    samples->upper[kept] = wz * taps_.value[t];
    samples->weight += taps_.value[t];
    ++kept;
  }
  samples->count = kept;
}

float SliceTaps::weight_inside(const std::array<float, 3>& centre) const {
  const Reach where = reach(centre);
  if (where == Reach::kInterior) return total_;
  float weight = 0.F;
  if (where == Reach::kOutside) return weight;
  for (std::size_t t = 0; t < taps_.count(); ++t) {
    const float x = centre[0] + term_[0][t] + term_[1][t] + term_[2][t];
    const float y = centre[1] + term_[3][t] + term_[4][t] + term_[5][t];
    const float z = centre[2] + term_[6][t] + term_[7][t] + term_[8][t];
    if (contains(x, y, z)) weight += taps_.value[t];
  }
  return weight;
}

}  // namespace svort
