#pragma once

#include <cstddef>
#include <cstdint>

namespace svort {

/// Pixels that the kernels work on at a time.
constexpr std::size_t kLanes = 8;

/// The rotated taps of one slice and the volume they fall into; see SliceTaps.
struct TapList {
  std::size_t count = 0;
  const float* value = nullptr;  ///< PSF values
  const float* term[9] = {};  ///< a tap's position is centre + term[3 i] + term[3 i + 1] + term[3 i + 2], i = x, y, z
  float limit[3] = {};        ///< positions in [0, limit) have a whole cell of 2 x 2 x 2 voxels
  std::int32_t stride_y = 0, stride_z = 0;  ///< of the volume's array [z][y][x]
};

/// Up to kLanes pixels of one slice.
struct alignas(32) PixelBatch {
  float x[kLanes], y[kLanes], z[kLanes];  ///< centres, voxels; lanes beyond `count` repeat the first
  std::size_t count = 0;
  bool rim = false;  ///< some taps may lie outside the volume
};

/// Where the pixels of a slice lie; see SliceTaps.
struct SlicePlane {
  float transform[12] = {};
  double column_origin = 0., row_origin = 0., resolution_ratio = 1.;
  double middle[3] = {};  ///< voxel coordinates of the volume's centre
};

/// The inner loops, compiled for one instruction set. All variants give the same bytes: none uses fused
/// multiply-add, and lanes are pixels, so that a pixel's sum has one order.
struct TapKernels {
  /// PSF-weighted sum of the volume at each pixel; taps outside add nothing.
  void (*gather)(const TapList& taps, const PixelBatch& batch, const float* volume, float* sums);
  /// Sum of the PSF values of the taps inside.
  void (*weigh)(const TapList& taps, const PixelBatch& batch, float* sums);
  /// Adds PSF value x `value` of each pixel to the volume.
  void (*scatter)(const TapList& taps, const PixelBatch& batch, const float* value, float* volume);
  /// Adds PSF value x (`value`, `scale`) of each pixel to pairs (sum, weight) of the volume.
  void (*scatter_pairs)(const TapList& taps, const PixelBatch& batch, const float* value, const float* scale,
                        float* pairs);
  /// The same with float64 sums: what was added can be taken away again without a trace.
  void (*scatter_double_pairs)(const TapList& taps, const PixelBatch& batch, const float* value, const float* scale,
                               double* pairs);
  /// out[i] = sum over k of weight[k] rows[k][i].
  void (*combine_rows)(const float* const* rows, const float* weight, std::size_t row_count, std::int64_t count,
                       float* out);
  /// Centres of kLanes pixels.
  void (*place_pixels)(const SlicePlane& plane, const std::uint16_t* columns, const std::uint16_t* rows,
                       PixelBatch* batch);
};

/// The best variant for this processor.
const TapKernels& tap_kernels();

/// The variants by themselves, for tests and tap_kernels().
const TapKernels& baseline_tap_kernels();
#if defined(__x86_64__)
const TapKernels& avx2_tap_kernels();
#endif

}  // namespace svort
