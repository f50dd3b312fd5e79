#pragma once

#include <cmath>
#include <cstdint>
#include <functional>
#include <string>

#include "svort_ros/acquisition/slice.h"

namespace svort {

constexpr std::int64_t kSecond_ns = 1000000000;

/// A slice of a stack of 10 parallel slices, 3 mm apart along the stack's normal, TR 1 s, interleave none: uniform
/// intensity 100 and a disc of 20 mm radius as its mask.
inline Slice make_slice(int stack, int index, const std::string& scan_id = "a") {
  Slice slice;
  slice.info.scan_id = scan_id;
  slice.info.stack = stack;
  slice.info.index = index;
  slice.info.slices_in_stack = 10;
  slice.info.stamp_ns = (100 * stack + index + 1) * kSecond_ns;
  const Pose orientation(Eigen::AngleAxisd(0.3 + stack, Eigen::Vector3d(1., 2., 0.5).normalized()));
  slice.info.T_scanner_slice =
      Eigen::Translation3d(12., -7., 30.) * orientation * Eigen::Translation3d(0., 0., 3. * index);
  slice.info.pixel_spacing = {1.25, 1.1};
  slice.info.thickness = 3.;
  slice.info.columns = 60;
  slice.info.rows = 64;
  slice.pixels.assign(60 * 64, 100.F);
  slice.mask.assign(60 * 64, 0);
  for (int row = 0; row < 64; ++row)
    for (int column = 0; column < 60; ++column)
      if (std::hypot((column - 29.5) * 1.25, (row - 31.5) * 1.1) < 20.)
        slice.mask[static_cast<std::size_t>(row * 60 + column)] = 1;
  return slice;
}

/// Position of a pixel in slice coordinates, mm.
inline Eigen::Vector2d pixel_position(const SliceInfo& info, int column, int row) {
  return {(column - 0.5 * (info.columns - 1)) * info.pixel_spacing.x(),
          (row - 0.5 * (info.rows - 1)) * info.pixel_spacing.y()};
}

/// Fills image and mask from functions of the position in slice coordinates (mm).
inline void paint(Slice& slice, const std::function<double(double, double)>& image,
                  const std::function<bool(double, double)>& brain) {
  slice.pixels.clear();
  slice.mask.clear();
  for (int row = 0; row < slice.info.rows; ++row)
    for (int column = 0; column < slice.info.columns; ++column) {
      const Eigen::Vector2d p = pixel_position(slice.info, column, row);
      slice.pixels.push_back(static_cast<float>(image(p.x(), p.y())));
      slice.mask.push_back(brain(p.x(), p.y()) ? 1 : 0);
    }
}

}  // namespace svort
