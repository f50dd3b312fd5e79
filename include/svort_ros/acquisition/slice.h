#pragma once

#include <Eigen/Core>
#include <cstdint>
#include <string>
#include <vector>

#include "svort_ros/geometry/pose.h"

namespace svort {

/// What the scanner says about one slice; everything but the pixels.
struct SliceInfo {
  std::string scan_id;                      ///< identifies the examination; a new one starts a new sequence
  int stack = 0;                            ///< number of the stack (series) within the scan
  int index = 0;                            ///< position of the slice within its stack, 0 .. slices_in_stack - 1
  int slices_in_stack = 0;                  ///< number of slices prescribed for the stack
  std::int64_t stamp_ns = 0;                ///< acquisition time, ns since the epoch
  Pose T_scanner_slice = Pose::Identity();  ///< nominal pose; origin at the slice centre, x along columns, y along rows
  Eigen::Vector2d pixel_spacing = {0., 0.};  ///< x (between columns), y (between rows), mm
  double thickness = 0.;                     ///< slice thickness (FWHM of the slice profile), mm
  int columns = 0;                           ///< pixels along x
  int rows = 0;                              ///< pixels along y
};

/// One slice as it was acquired.
struct Slice {
  SliceInfo info;
  std::vector<float> pixels;       ///< rows x columns, row-major, arbitrary units
  std::vector<std::uint8_t> mask;  ///< brain mask, same layout, non-zero is brain; empty if the slice came without one
};

/// "stack 1 slice 4 of scan x", for messages.
std::string describe(const SliceInfo& info);

/// Acquisition order of a stack of `count` slices: every `interleave`-th slice, then the next pass
/// (count 5, interleave 2: 0 2 4 1 3). @throws std::invalid_argument unless count >= 0 and interleave >= 1.
std::vector<int> interleaved_order(int count, int interleave);

}  // namespace svort
