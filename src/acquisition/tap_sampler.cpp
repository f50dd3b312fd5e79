#include "tap_sampler.h"

#include <algorithm>
#include <cmath>

namespace svort {
namespace {

// Voxels kept between "certainly inside" and the rim, far above the rounding of a float32 coordinate.
constexpr float kMargin = 0.01F;

// Taps apart in the list that may be added to at the same time; a prime, so that it divides no row of taps.
constexpr std::size_t kSpread = 37;

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
  const std::size_t count = taps_.count();
  const std::int32_t stride_y = shape_.stride_y(), stride_z = shape_.stride_z();
  const float *xx = term_[0].data(), *xy = term_[1].data(), *xz = term_[2].data();
  const float *yx = term_[3].data(), *yy = term_[4].data(), *yz = term_[5].data();
  const float *zx = term_[6].data(), *zy = term_[7].data(), *zz = term_[8].data();
  std::int32_t* __restrict__ index = samples->index.data();
  float* __restrict__ wx = samples->wx.data();
  float* __restrict__ wy = samples->wy.data();
  float* __restrict__ wz = samples->wz.data();
  const float cx = centre[0], cy = centre[1], cz = centre[2];
  for (std::size_t t = 0; t < count; ++t) {
    const float x = cx + xx[t] + xy[t] + xz[t];
    const float y = cy + yx[t] + yy[t] + yz[t];
    const float z = cz + zx[t] + zy[t] + zz[t];
    // Positions are positive here, so truncation is floor().
    const auto ix = static_cast<std::int32_t>(x), iy = static_cast<std::int32_t>(y), iz = static_cast<std::int32_t>(z);
    index[t] = iz * stride_z + iy * stride_y + ix;
    wx[t] = x - static_cast<float>(ix);
    wy[t] = y - static_cast<float>(iy);
    wz[t] = z - static_cast<float>(iz);
  }
  std::copy(taps_.value.begin(), taps_.value.end(), samples->value.begin());
  samples->count = count;
}

void SliceTaps::place_rim(const std::array<float, 3>& centre, TapSamples* samples) const {
  std::size_t kept = 0;
  for (std::size_t t = 0; t < taps_.count(); ++t) {
    const float x = centre[0] + term_[0][t] + term_[1][t] + term_[2][t];
    const float y = centre[1] + term_[3][t] + term_[4][t] + term_[5][t];
    const float z = centre[2] + term_[6][t] + term_[7][t] + term_[8][t];
    if (!contains(x, y, z)) continue;
    const auto ix = static_cast<std::int32_t>(x), iy = static_cast<std::int32_t>(y), iz = static_cast<std::int32_t>(z);
    samples->value[kept] = taps_.value[t];
    samples->index[kept] = iz * shape_.stride_z() + iy * shape_.stride_y() + ix;
    samples->wx[kept] = x - static_cast<float>(ix);
    samples->wy[kept] = y - static_cast<float>(iy);
    samples->wz[kept] = z - static_cast<float>(iz);
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
