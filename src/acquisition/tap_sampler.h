#pragma once

#include <array>
#include <cstdint>
#include <vector>

#include "tap_kernels.h"

namespace svort {

/// Size of a volume and the strides of its array [z][y][x].
struct VolumeShape {
  std::int32_t width = 0, height = 0, depth = 0;

  std::int32_t stride_y() const { return width; }
  std::int32_t stride_z() const { return width * height; }
  std::int64_t voxel_count() const { return std::int64_t{width} * height * depth; }
};

/// The taps of a PSF that are not zero.
struct PsfTaps {
  std::vector<float> value;
  std::vector<std::array<float, 3>> offset;  ///< x, y, z in voxels, in the slice's frame

  std::size_t count() const { return value.size(); }
};

/// Taps of `psf`, an array of `size` (z, y, x), in array order.
PsfTaps nonzero_taps(const float* psf, const std::array<std::int64_t, 3>& size);

/// The same taps, ordered so that neighbours in space are far apart in the list: consecutive additions to the same
/// voxels would wait for one another.
PsfTaps spread_taps(const PsfTaps& taps);

/// Where the taps of a pixel fall: all in the volume, none, or some.
enum class Reach { outside, rim, interior };

/// Taps of one slice, rotated once, for one pixel after the other.
///
/// Positions are rounded exactly as in the public implementation, pixel centre + (r1 dx) + (r2 dy) + (r3 dz) in float32
/// and in this order: whether a tap on the rim of the volume counts depends on the last bit.
class SliceTaps {
 public:
  /// @param taps      must outlive this object
  /// @param transform 3 x 4, trans_first, voxels
  SliceTaps(const PsfTaps& taps, const float* transform, const VolumeShape& shape, std::int32_t slice_width,
            std::int32_t slice_height, double resolution_ratio);

  /// Voxel coordinates of a pixel's centre.
  std::array<float, 3> centre(std::int32_t column, std::int32_t row) const;

  /// @param margin interior: every tap is at least so many voxels from the border
  Reach reach(const std::array<float, 3>& centre, float margin = 0.F) const;

  /// Largest distance of a tap from its pixel's centre along an axis (x, y, z) of the volume, in voxels.
  float extent(std::size_t axis) const { return std::max(-lowest_[axis], highest_[axis]); }

  /// Sum of all PSF values.
  float total() const { return total_; }

  /// Where its pixels lie.
  const SlicePlane& plane() const { return plane_; }

  /// What the kernels need; valid as long as this object.
  TapList list() const;

 private:
  const PsfTaps& taps_;
  VolumeShape shape_;
  SlicePlane plane_;
  std::array<float, 3> limit_{};               // positions at or beyond are outside
  std::vector<float> term_;                    // term_[(3 i + j) n + t] = R(i, j) * offset_j of tap t, of n
  std::array<float, 3> lowest_{}, highest_{};  // reach of the taps along x, y, z of the volume
  float total_ = 0.F;
};

}  // namespace svort
