#include "svort_ros/sequence/brain_roi.h"

namespace svort {

void BrainRoi::add(const Slice& slice) {
  const SliceInfo& info = slice.info;
  const bool has_mask = !slice.mask.empty();
  Box& box = has_mask ? masked_ : unmasked_;

  // Half the size of one rotated voxel along the scanner's axes.
  const Eigen::Vector3d half_voxel(0.5 * info.pixel_spacing.x(), 0.5 * info.pixel_spacing.y(), 0.5 * info.thickness);
  const Eigen::Vector3d half_box = info.T_scanner_slice.linear().cwiseAbs() * half_voxel;

  const auto include = [&](int row, int column) {
    const Eigen::Vector3d in_slice((column - 0.5 * (info.columns - 1)) * info.pixel_spacing.x(),
                                   (row - 0.5 * (info.rows - 1)) * info.pixel_spacing.y(), 0.);
    const Eigen::Vector3d centre = info.T_scanner_slice * in_slice;
    box.lower = box.empty ? Eigen::Vector3d(centre - half_box) : Eigen::Vector3d(box.lower.cwiseMin(centre - half_box));
    box.upper = box.empty ? Eigen::Vector3d(centre + half_box) : Eigen::Vector3d(box.upper.cwiseMax(centre + half_box));
    box.empty = false;
  };

  for (int row = 0; row < info.rows; ++row) {
    // The first and the last brain pixel of a row span all others, as the map to the scanner is linear.
    int first = has_mask ? info.columns : 0;
    int last = has_mask ? -1 : info.columns - 1;
    for (int column = 0; has_mask && column < info.columns; ++column) {
      const std::size_t offset =
          static_cast<std::size_t>(row) * static_cast<std::size_t>(info.columns) + static_cast<std::size_t>(column);
      if (!slice.mask[offset]) continue;
      if (column < first) first = column;
      last = column;
    }
    if (last < first) continue;
    include(row, first);
    include(row, last);
  }
}

void BrainRoi::clear() { *this = BrainRoi(); }

Eigen::Vector3d BrainRoi::centre() const { return 0.5 * (box().lower + box().upper); }

Eigen::Vector3d BrainRoi::extent() const { return box().upper - box().lower; }

}  // namespace svort
