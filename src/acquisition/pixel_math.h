#pragma once

#include <cmath>
#include <cstddef>
#include <cstdint>

// What one pixel or one voxel takes to compute, for any scalar type, on the CPU and in CUDA kernels alike. Compilers
// must not fuse multiply-add here (nvcc: -fmad=false): the last bit of a position decides whether a tap counts.

#if defined(__CUDACC__)
#define SVORT_HOST_DEVICE __host__ __device__ inline
#else
#define SVORT_HOST_DEVICE inline
#endif

namespace svort {

/// Slices, taps and pixels of an operator as plain arrays, in the memory of the CPU or of a GPU.
template <class Real>
struct OperatorView {
  const Real* transforms = nullptr;               ///< n x 12, trans_first, voxels
  const std::int32_t* tap_begin = nullptr;        ///< n: first tap of each slice's PSF
  const std::int32_t* tap_end = nullptr;          ///< n: one past the last
  const float* taps = nullptr;                    ///< x, y, z in voxels, and the value, tap after tap
  const std::int32_t* slice = nullptr;            ///< slice of each pixel, in ascending order
  const std::uint16_t* column = nullptr;          ///< of each pixel
  const std::uint16_t* row = nullptr;             ///< of each pixel
  const std::int32_t* pixel_begin = nullptr;      ///< n + 1: first pixel of each slice
  std::int32_t slice_count = 0, pixel_count = 0;  ///< pixels that matter, of all slices
  std::int32_t slice_width = 0, slice_height = 0;
  std::int32_t width = 0, height = 0, depth = 0;  ///< of the volume
  double resolution_ratio = 1.;

  SVORT_HOST_DEVICE std::int64_t voxel_count() const { return std::int64_t{width} * height * depth; }
  /// Where pixel `i` is in an array n x 1 x slice_height x slice_width.
  SVORT_HOST_DEVICE std::int64_t offset(std::int32_t i) const {
    return (std::int64_t{slice[i]} * slice_height + row[i]) * slice_width + column[i];
  }
};

/// A pixel's centre in its slice's frame (translation included) and in the volume, in voxels.
template <class Real>
struct PixelPlace {
  Real in_slice[3], in_volume[3];
};

/// Rounded as SliceTaps::centre() if Real is float.
template <class Real>
SVORT_HOST_DEVICE PixelPlace<Real> place_of(const OperatorView<Real>& view, std::int32_t i) {
  const Real* m = view.transforms + 12 * std::int64_t{view.slice[i]};
  const auto ratio = static_cast<double>(static_cast<Real>(view.resolution_ratio));
  const double middle[3] = {(view.width - 1) / 2., (view.height - 1) / 2., (view.depth - 1) / 2.};
  PixelPlace<Real> place;
  place.in_slice[0] =
      static_cast<Real>((view.column[i] - (view.slice_width - 1) / 2.) * ratio + static_cast<double>(m[3]));
  place.in_slice[1] =
      static_cast<Real>((view.row[i] - (view.slice_height - 1) / 2.) * ratio + static_cast<double>(m[7]));
  place.in_slice[2] = m[11];
  for (int axis = 0; axis < 3; ++axis) {
    const Real rotated =
        m[4 * axis] * place.in_slice[0] + m[4 * axis + 1] * place.in_slice[1] + m[4 * axis + 2] * place.in_slice[2];
    place.in_volume[axis] = static_cast<Real>(static_cast<double>(rotated) + middle[axis]);
  }
  return place;
}

/// Calls visit(tap, value, offset of the cell's first voxel, position within the cell [3]) for each tap inside.
template <class Real, class Visit>
SVORT_HOST_DEVICE void visit_taps(const OperatorView<Real>& view, std::int32_t i, const PixelPlace<Real>& place,
                                  const Visit& visit) {
  const std::int32_t slice = view.slice[i];
  const Real* m = view.transforms + 12 * std::int64_t{slice};
  const Real limit[3] = {static_cast<Real>(view.width - 1), static_cast<Real>(view.height - 1),
                         static_cast<Real>(view.depth - 1)};
  for (std::int32_t t = view.tap_begin[slice]; t < view.tap_end[slice]; ++t) {
    const float* tap = view.taps + 4 * std::int64_t{t};
    Real within[3];
    std::int32_t cell[3];
    bool inside = true;
    for (int axis = 0; axis < 3; ++axis) {
      const Real position = ((place.in_volume[axis] + m[4 * axis] * static_cast<Real>(tap[0])) +
                             m[4 * axis + 1] * static_cast<Real>(tap[1])) +
                            m[4 * axis + 2] * static_cast<Real>(tap[2]);
      // Written so that a position that is not a number is outside.
      inside = inside && position >= Real{0} && position < limit[axis];
      cell[axis] = inside ? static_cast<std::int32_t>(position) : 0;
      within[axis] = position - static_cast<Real>(cell[axis]);
    }
    if (!inside) continue;
    visit(t, static_cast<Real>(tap[3]), (std::int64_t{cell[2]} * view.height + cell[1]) * view.width + cell[0], within);
  }
}

/// PSF-weighted sum of the volume at pixel `i`.
template <class Real>
SVORT_HOST_DEVICE Real gather_pixel(const OperatorView<Real>& view, std::int32_t i, const Real* volume) {
  const std::int64_t stride_y = view.width, stride_z = std::int64_t{view.width} * view.height;
  Real sum{0};
  visit_taps(view, i, place_of(view, i), [&](std::int32_t, Real value, std::int64_t cell, const Real* w) {
    const Real* v = volume + cell;
    const Real x0 = Real{1} - w[0], y0 = Real{1} - w[1];
    const Real lower = (x0 * v[0] + w[0] * v[1]) * y0 + (x0 * v[stride_y] + w[0] * v[stride_y + 1]) * w[1];
    v += stride_z;
    const Real upper = (x0 * v[0] + w[0] * v[1]) * y0 + (x0 * v[stride_y] + w[0] * v[stride_y + 1]) * w[1];
    sum += lower * ((Real{1} - w[2]) * value) + upper * (w[2] * value);
  });
  return sum;
}

/// Sum of the PSF values of pixel `i` whose taps are inside.
template <class Real>
SVORT_HOST_DEVICE Real weigh_pixel(const OperatorView<Real>& view, std::int32_t i) {
  Real sum{0};
  visit_taps(view, i, place_of(view, i), [&](std::int32_t, Real value, std::int64_t, const Real*) { sum += value; });
  return sum;
}

/// Calls add(voxel offset, amount) for what pixel `i` of value `pixel` adds to the volume.
template <class Real, class Add>
SVORT_HOST_DEVICE void scatter_pixel(const OperatorView<Real>& view, std::int32_t i, Real pixel, const Add& add) {
  const std::int64_t stride_y = view.width, stride_z = std::int64_t{view.width} * view.height;
  visit_taps(view, i, place_of(view, i), [&](std::int32_t, Real value, std::int64_t cell, const Real* w) {
    const Real tap = pixel * value;
    for (int corner = 0; corner < 8; ++corner) {
      const int dx = corner & 1, dy = (corner >> 1) & 1, dz = corner >> 2;
      const Real share = (dx != 0 ? w[0] : Real{1} - w[0]) * (dy != 0 ? w[1] : Real{1} - w[1]) *
                         ((dz != 0 ? w[2] : Real{1} - w[2]) * tap);
      add(cell + dx + dy * stride_y + dz * stride_z, share);
    }
  });
}

/// gradient[12] += d (coefficient x gather_pixel(view, i, volume)) / d transform, by the slope of the trilinear
/// interpolation at every tap. What changes in jumps (a tap crossing the border of the volume) has no slope.
template <class Real>
SVORT_HOST_DEVICE void add_pose_gradient(const OperatorView<Real>& view, std::int32_t i, const Real* volume,
                                         Real coefficient, double* gradient) {
  const std::int64_t stride_y = view.width, stride_z = std::int64_t{view.width} * view.height;
  const Real* m = view.transforms + 12 * std::int64_t{view.slice[i]};
  const PixelPlace<Real> place = place_of(view, i);
  // Sums over taps of the slope, and of the slope times the tap's offset in the slice.
  Real slope_sum[3] = {Real{0}, Real{0}, Real{0}}, moment[9] = {};
  visit_taps(view, i, place, [&](std::int32_t t, Real value, std::int64_t cell, const Real* w) {
    const Real *a = volume + cell, *b = a + stride_y, *c = a + stride_z, *d = c + stride_y;
    const Real x0 = Real{1} - w[0], y0 = Real{1} - w[1], z0 = Real{1} - w[2];
    const Real along_a = x0 * a[0] + w[0] * a[1], along_b = x0 * b[0] + w[0] * b[1];
    const Real along_c = x0 * c[0] + w[0] * c[1], along_d = x0 * d[0] + w[0] * d[1];
    const Real slope[3] = {
        value * (((a[1] - a[0]) * y0 + (b[1] - b[0]) * w[1]) * z0 + ((c[1] - c[0]) * y0 + (d[1] - d[0]) * w[1]) * w[2]),
        value * ((along_b - along_a) * z0 + (along_d - along_c) * w[2]),
        value * ((along_c * y0 + along_d * w[1]) - (along_a * y0 + along_b * w[1]))};
    for (int axis = 0; axis < 3; ++axis) {
      slope_sum[axis] += slope[axis];
      for (int j = 0; j < 3; ++j) {
        moment[3 * axis + j] += slope[axis] * static_cast<Real>(view.taps[4 * std::int64_t{t} + j]);
      }
    }
  });
  // A tap is at R (p + d), p = place.in_slice: its own translation is part of p.
  for (int axis = 0; axis < 3; ++axis) {
    for (int j = 0; j < 3; ++j) {
      gradient[4 * axis + j] +=
          static_cast<double>(coefficient * (slope_sum[axis] * place.in_slice[j] + moment[3 * axis + j]));
      gradient[4 * j + 3] += static_cast<double>(coefficient * slope_sum[axis] * m[4 * axis + j]);
    }
  }
}

/// One voxel of a blur along one axis, with zeros around the volume.
/// @param half    half a symmetric kernel, from the centre, radius + 1 values
/// @param index   of the voxel along the axis, of `count`; neighbours are `stride` apart; `in` points to the voxel
template <class Real>
SVORT_HOST_DEVICE Real blur_voxel(const Real* in, const float* half, std::int32_t radius, std::int32_t index,
                                  std::int32_t count, std::int64_t stride) {
  Real sum{0};
  for (std::int32_t k = -radius; k <= radius; ++k) {
    if (index + k < 0 || index + k >= count) continue;
    sum += in[k * stride] * static_cast<Real>(half[k < 0 ? -k : k]);
  }
  return sum;
}

/// Sums of many terms that are the same bytes in any order: integers, in units of 2^-31 of a power of two that no pixel
/// exceeds. Even 2^31 pixels at one voxel do not overflow.
class FixedPoint {
 public:
  /// @param largest no pixel's magnitude is above it; finite
  SVORT_HOST_DEVICE explicit FixedPoint(float largest) {
    int exponent = 0;
    frexpf(largest, &exponent);  // |largest| < 2^exponent
    scale_ = ldexp(1., kBits - exponent);
  }
  SVORT_HOST_DEVICE std::int64_t from(float value) const {
    return static_cast<std::int64_t>(rint(static_cast<double>(value) * scale_));
  }
  SVORT_HOST_DEVICE double to_double(std::int64_t sum) const { return static_cast<double>(sum) / scale_; }

 private:
  static constexpr int kBits = 31;
  double scale_ = 1.;
};

}  // namespace svort
