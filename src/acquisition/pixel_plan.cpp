#include "pixel_plan.h"

#include <algorithm>
#include <cmath>

namespace svort {
namespace {

// Thinner bars than this cost more in bookkeeping than they gain in balance.
constexpr std::int32_t kSmallestEdge = 12;

}  // namespace

TileGrid::TileGrid(const VolumeShape& shape, const std::vector<SliceTaps>& slices) {
  float reach = 0.F;
  for (const SliceTaps& slice : slices) reach = std::max({reach, slice.extent(1), slice.extent(2)});
  const std::int32_t largest = std::max(shape.height, shape.depth);
  // A cell is one voxel beyond its tap's position, and one more is kept for rounding.
  edge_ = reach < static_cast<float>(largest)
              ? std::max(kSmallestEdge, 2 * static_cast<std::int32_t>(std::ceil(reach)) + 3)
              : largest;
  rows_ = (shape.height + edge_ - 1) / edge_;
  layers_ = (shape.depth + edge_ - 1) / edge_;
}

std::int32_t TileGrid::tile_at(const std::array<float, 3>& centre) const {
  // Pixels just outside the volume reach no further into it than those on its border.
  const auto along = [this](float position, std::int32_t count) {
    const float last = static_cast<float>(count - 1);
    return static_cast<std::int32_t>(std::clamp(std::floor(position / static_cast<float>(edge_)), 0.F, last));
  };
  return along(centre[2], layers_) * rows_ + along(centre[1], rows_);
}

SlicePixels group_pixels(const SliceTaps& taps, const TileGrid& tiles, const bool* mask, std::int32_t height,
                         std::int32_t width) {
  struct Candidate {
    std::uint16_t column, row;
    std::int32_t key;
  };
  std::vector<Candidate> candidates;
  std::vector<std::int32_t> begin(static_cast<std::size_t>(2 * tiles.count() + 1), 0);
  for (std::int32_t row = 0; row < height; ++row) {
    for (std::int32_t column = 0; column < width; ++column) {
      if (mask != nullptr && !mask[std::int64_t{row} * width + column]) continue;
      const std::array<float, 3> centre = taps.centre(column, row);
      const Reach reach = taps.reach(centre);
      if (reach == Reach::outside) continue;
      const std::int32_t key = 2 * tiles.tile_at(centre) + (reach == Reach::rim ? 1 : 0);
      candidates.push_back({static_cast<std::uint16_t>(column), static_cast<std::uint16_t>(row), key});
      ++begin[static_cast<std::size_t>(key) + 1];
    }
  }
  SlicePixels pixels;
  pixels.column.resize(candidates.size());
  pixels.row.resize(candidates.size());
  for (std::int32_t key = 0; key < 2 * tiles.count(); ++key) {
    const auto k = static_cast<std::size_t>(key);
    begin[k + 1] += begin[k];
    if (begin[k + 1] > begin[k]) pixels.groups.push_back({key / 2, begin[k], begin[k + 1], key % 2 == 1});
  }
  // Counting sort by key.
  std::vector<std::int32_t> next(begin.begin(), begin.end() - 1), order(candidates.size());
  for (std::size_t i = 0; i < candidates.size(); ++i) {
    order[static_cast<std::size_t>(next[static_cast<std::size_t>(candidates[i].key)]++)] = static_cast<std::int32_t>(i);
  }
  constexpr auto kStep = static_cast<std::int32_t>(kLanes);
  for (const PixelGroup& group : pixels.groups) {
    const std::int32_t batches = (group.end - group.begin + kStep - 1) / kStep;
    auto to = static_cast<std::size_t>(group.begin);
    for (std::int32_t batch = 0; batch < batches; ++batch) {
      for (std::int32_t from = group.begin + batch; from < group.end; from += batches) {
        const Candidate& candidate = candidates[static_cast<std::size_t>(order[static_cast<std::size_t>(from)])];
        pixels.column[to] = candidate.column;
        pixels.row[to] = candidate.row;
        ++to;
      }
    }
  }
  return pixels;
}

PixelBatch batch_of(const SliceTaps& taps, const SlicePixels& pixels, const PixelGroup& group, std::int32_t first) {
  PixelBatch batch;
  batch.count = std::min(kLanes, static_cast<std::size_t>(group.end - first));
  batch.rim = group.rim;
  std::uint16_t columns[kLanes], rows[kLanes];
  for (std::size_t lane = 0; lane < kLanes; ++lane) {
    const std::size_t pixel = static_cast<std::size_t>(first) + (lane < batch.count ? lane : 0);
    columns[lane] = pixels.column[pixel];
    rows[lane] = pixels.row[pixel];
  }
  tap_kernels().place_pixels(taps.plane(), columns, rows, &batch);
  return batch;
}

}  // namespace svort
