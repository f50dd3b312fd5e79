#pragma once

#include <Eigen/Core>
#include <cstddef>
#include <cstdint>
#include <vector>

#include "svort_ros/geometry/pose.h"

namespace svort {

/// A regular grid of voxels whose centre is the origin of its own frame.
///
/// Voxel (i, j, k) lies at ((i - (nx-1)/2) sx, (j - (ny-1)/2) sy, (k - (nz-1)/2) sz) mm in grid coordinates, the
/// convention of the public SVoRT implementation. Arrays on the grid are indexed [z][y][x], x fastest.
struct ImageGrid {
  Eigen::Vector3i size = Eigen::Vector3i::Zero();     ///< number of voxels along x, y, z
  Eigen::Vector3d spacing = Eigen::Vector3d::Ones();  ///< voxel size along x, y, z, mm
  Pose T_frame_grid = Pose::Identity();               ///< grid coordinates (mm) into the frame the grid lives in (mm)

  std::size_t voxel_count() const {
    return static_cast<std::size_t>(size.x()) * static_cast<std::size_t>(size.y()) * static_cast<std::size_t>(size.z());
  }
  /// Offset of voxel (i, j, k) in an array on this grid.
  std::size_t offset(int i, int j, int k) const {
    return (static_cast<std::size_t>(k) * static_cast<std::size_t>(size.y()) + static_cast<std::size_t>(j)) *
               static_cast<std::size_t>(size.x()) +
           static_cast<std::size_t>(i);
  }
  /// Position of a (fractional) voxel index in the grid's frame, mm.
  Eigen::Vector3d position(const Eigen::Vector3d& index) const {
    return T_frame_grid * ((index - 0.5 * (size.cast<double>() - Eigen::Vector3d::Ones())).cwiseProduct(spacing));
  }
  /// Fractional voxel index of a position (mm) in the grid's frame; the inverse of position().
  Eigen::Vector3d index(const Eigen::Vector3d& position_mm) const {
    return (T_frame_grid.inverse() * position_mm).cwiseQuotient(spacing) +
           0.5 * (size.cast<double>() - Eigen::Vector3d::Ones());
  }
};

/// Scalar values on a grid; `values` holds grid.voxel_count() numbers, [z][y][x].
struct Volume {
  ImageGrid grid;
  std::vector<float> values;

  bool empty() const { return values.empty(); }
};

}  // namespace svort
