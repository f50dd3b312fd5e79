#pragma once

#include <Eigen/Core>
#include <Eigen/Geometry>

#include "svort_ros/geometry/pose.h"

namespace svort {

/// NIfTI affines map voxel indices to RAS millimetres; this package works in the DICOM patient system LPS
/// (x left, y posterior, z superior). The change is a half turn about z and its own inverse.
Eigen::Affine3d lps_from_ras(const Eigen::Affine3d& affine_ras);
Eigen::Affine3d ras_from_lps(const Eigen::Affine3d& affine_lps);

/// Geometry of one slice of a stack, taken from the stack's affine.
struct SliceGeometry {
  Pose T_scanner_slice = Pose::Identity();   ///< origin at the slice centre, x along columns, y along rows, mm
  Eigen::Vector2d pixel_spacing = {1., 1.};  ///< x (between columns), y (between rows), mm
};

/// Pose and pixel spacing of slice `index` (third axis) of a stack of `columns` x `rows` pixels.
///
/// `affine_lps` maps (column, row, slice) indices to LPS mm and may be left-handed: z of the slice frame is always
/// x cross y, whichever way the slices are counted.
/// @throws std::invalid_argument if the in-plane axes are not finite, zero or not orthogonal (1e-3).
SliceGeometry slice_geometry_from_affine(const Eigen::Affine3d& affine_lps, int columns, int rows, int index);

}  // namespace svort
