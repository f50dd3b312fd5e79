#pragma once

#include <Eigen/Geometry>
#include <cmath>
#include <string>
#include <vector>

#include "svort_ros/acquisition/slice.h"

namespace svort_test {

/// A small, noise-free scan of an analytic head that does not move: orthogonal interleaved stacks.
struct SyntheticScanOptions {
  std::string scan_id = "synthetic";
  int stacks = 3;  ///< at most 3: axial, coronal, sagittal
  int slices_per_stack = 8;
  int columns = 48;
  int rows = 40;
  double pixel_mm = 2.;
  double thickness_mm = 4.;
  double tr_s = 1.2;
  double start_s = 100.;
  Eigen::Vector3d centre_mm = {12., -34., 56.};  ///< of the head in the scanner
  Eigen::Vector3d tilt_rad = {.1, -.2, .3};      ///< oblique prescription
};

/// Brightness of the head at a point relative to its centre, mm; 0 outside the brain.
inline double phantom_intensity(const Eigen::Vector3d& p) {
  const double r2 = p.cwiseQuotient(Eigen::Vector3d(26., 32., 24.)).squaredNorm();
  if (r2 > 1.) return 0.;
  // Smooth and without symmetry, so that a swapped axis or a flipped sign shows.
  return 600. + 150. * std::sin(.12 * p.x() + .5) + 120. * std::cos(.15 * p.y() - .07 * p.z()) + 3. * p.z() -
         1.5 * p.x();
}

inline Eigen::Matrix3d stack_rotation(const SyntheticScanOptions& options, int stack) {
  using Eigen::AngleAxisd;
  using Eigen::Vector3d;
  const double angle = options.tilt_rad.norm();
  const Eigen::Matrix3d tilt =
      angle > 0. ? AngleAxisd(angle, options.tilt_rad / angle).toRotationMatrix() : Eigen::Matrix3d::Identity();
  Eigen::Matrix3d axes = Eigen::Matrix3d::Identity();
  if (stack % 3 == 1) axes = AngleAxisd(M_PI / 2., Vector3d::UnitX()).toRotationMatrix();
  if (stack % 3 == 2) axes = AngleAxisd(M_PI / 2., Vector3d::UnitY()).toRotationMatrix();
  return tilt * axes;
}

/// One slice: sampled at the slice plane (no slice profile), masked by the phantom's own support.
inline svort::Slice synthetic_slice(const SyntheticScanOptions& options, int stack, int index, int order) {
  svort::Slice slice;
  svort::SliceInfo& info = slice.info;
  info.scan_id = options.scan_id;
  info.stack = stack;
  info.index = index;
  info.slices_in_stack = options.slices_per_stack;
  info.stamp_ns = std::llround((options.start_s + order * options.tr_s) * 1e9);
  info.pixel_spacing = {options.pixel_mm, options.pixel_mm};
  info.thickness = options.thickness_mm;
  info.columns = options.columns;
  info.rows = options.rows;
  info.T_scanner_slice.linear() = stack_rotation(options, stack);
  info.T_scanner_slice.translation() =
      options.centre_mm +
      info.T_scanner_slice.linear() *
          Eigen::Vector3d(0., 0., (index - .5 * (options.slices_per_stack - 1)) * options.thickness_mm);
  for (int y = 0; y < options.rows; ++y) {
    for (int x = 0; x < options.columns; ++x) {
      const Eigen::Vector3d in_slice((x - .5 * (options.columns - 1)) * options.pixel_mm,
                                     (y - .5 * (options.rows - 1)) * options.pixel_mm, 0.);
      const double value = phantom_intensity(info.T_scanner_slice * in_slice - options.centre_mm);
      slice.pixels.push_back(static_cast<float>(value));
      slice.mask.push_back(value > 0. ? 1 : 0);
    }
  }
  return slice;
}

/// The whole scan in acquisition order, interleaved by 2.
inline std::vector<svort::Slice> synthetic_scan(const SyntheticScanOptions& options = {}) {
  std::vector<svort::Slice> slices;
  for (int stack = 0; stack < options.stacks; ++stack)
    for (const int index : svort::interleaved_order(options.slices_per_stack, 2))
      slices.push_back(synthetic_slice(options, stack, index, static_cast<int>(slices.size())));
  return slices;
}

}  // namespace svort_test
