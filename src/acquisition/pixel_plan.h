#pragma once

#include <cstdint>
#include <vector>

#include "tap_sampler.h"

namespace svort {

/// Pixels of one slice whose centres lie in one tile: [begin, end) of the slice's list.
struct PixelGroup {
  std::int32_t tile = 0;
  std::int32_t begin = 0, end = 0;
  bool rim = false;  ///< some taps may lie outside the volume
};

/// The pixels of one slice that matter: in the mask, with taps in the volume. In the order of the kernels, group by
/// group; pixels of one batch are far apart, so that their additions do not wait for one another.
struct SlicePixels {
  std::vector<std::uint16_t> column, row;
  std::vector<float> weight;  ///< PSF weight inside the volume and its mask
  std::vector<float> share;   ///< PSF weight inside the volume; empty if there is no mask: the same as `weight`
  std::vector<PixelGroup> groups;

  std::size_t count() const { return column.size(); }
  float share_of(std::size_t pixel) const { return share.empty() ? weight[pixel] : share[pixel]; }
};

/// Bars of the volume, as long as it is wide, that hold the centres of the pixels that one thread works on at a time.
///
/// A bar is more than twice as thick as the taps reach, so taps of pixels in two bars of the same colour (of four: even
/// or odd along y, even or odd along z) never meet in a voxel: bars of one colour scatter in parallel, colour after
/// colour. Which pixels meet in which order depends on the bars alone: no atomics, no private copies of the volume,
/// the same bytes for any number of threads.
class TileGrid {
 public:
  TileGrid(const VolumeShape& shape, const std::vector<SliceTaps>& slices);

  std::int32_t count() const { return rows_ * layers_; }
  std::int32_t tile_at(const std::array<float, 3>& centre) const;
  int colour(std::int32_t tile) const { return (tile % rows_) % 2 + 2 * ((tile / rows_) % 2); }

 private:
  std::int32_t edge_, rows_, layers_;
};

/// Finds and groups the pixels of one slice; weights are left empty.
/// @param mask height x width, or null for all pixels
SlicePixels group_pixels(const SliceTaps& taps, const TileGrid& tiles, const bool* mask, std::int32_t height,
                         std::int32_t width);

/// Up to kLanes pixels of `group` from `first` on.
PixelBatch batch_of(const SliceTaps& taps, const SlicePixels& pixels, const PixelGroup& group, std::int32_t first);

}  // namespace svort
