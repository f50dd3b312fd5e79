#pragma once

#include <array>
#include <cstdint>
#include <vector>

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

/// Where the taps of one pixel fall in the volume. A tap's cell is the 2 x 2 x 2 voxels around it.
struct TapSamples {
  explicit TapSamples(std::size_t capacity)
      : index(capacity),
        wx(capacity),
        wy(capacity),
        lower(capacity),
        upper(capacity),
        cell_x(capacity),
        cell_y(capacity),
        cell_z(capacity) {}

  std::size_t count = 0;
  float weight = 0.F;               ///< sum of the PSF values
  std::vector<std::int32_t> index;  ///< array offset of the cell's first voxel
  std::vector<float> wx, wy;        ///< position within the cell, [0, 1)
  std::vector<float> lower, upper;  ///< PSF value times the share of the cell's lower and upper z plane
  std::vector<std::int32_t> cell_x, cell_y, cell_z;  ///< working space
};

/// Taps of one slice, rotated once and placed at one pixel after the other.
///
/// Positions are rounded exactly as in the public implementation, pixel centre + (r1 dx) + (r2 dy) + (r3 dz) in float32
/// and in this order: whether a tap on the rim of the volume counts depends on the last bit.
class SliceTaps {
 public:
  /// @param transform 3 x 4, trans_first, voxels
  SliceTaps(const PsfTaps& taps, const float* transform, const VolumeShape& shape, std::int32_t slice_width,
            std::int32_t slice_height, double resolution_ratio);

  /// Voxel coordinates of a pixel's centre.
  std::array<float, 3> centre(std::int32_t column, std::int32_t row) const;

  /// Smallest and largest z plane that taps around `centre` can touch, with a margin for rounding.
  std::array<std::int32_t, 2> planes(const std::array<float, 3>& centre) const;

  /// Places the taps that fall into the volume. Only taps whose whole cell of 8 voxels is inside do.
  void place(const std::array<float, 3>& centre, TapSamples* samples) const;

  /// Sum of the PSF values that place() would keep, in list order.
  float weight_inside(const std::array<float, 3>& centre) const;

 private:
  enum class Reach { kOutside, kRim, kInterior };
  Reach reach(const std::array<float, 3>& centre) const;
  bool contains(float x, float y, float z) const {
    return x >= 0.F && y >= 0.F && z >= 0.F && x < limit_[0] && y < limit_[1] && z < limit_[2];
  }
  void place_interior(const std::array<float, 3>& centre, TapSamples* samples) const;
  void place_rim(const std::array<float, 3>& centre, TapSamples* samples) const;

  const PsfTaps& taps_;
  VolumeShape shape_;
  std::array<float, 12> transform_{};
  double column_origin_, row_origin_, resolution_ratio_;
  std::array<float, 3> limit_{};               // positions at or beyond are outside
  std::array<double, 3> middle_{};             // voxel coordinates of the volume's centre
  std::array<std::vector<float>, 9> term_;     // term_[3 i + j][t] = R(i, j) * offset_j of tap t
  std::array<float, 3> lowest_{}, highest_{};  // reach of the taps along x, y, z of the volume
  float total_ = 0.F;
};

}  // namespace svort
