#pragma once

#include <Eigen/Core>
#include <Eigen/Geometry>
#include <filesystem>
#include <vector>

#include "svort_ros/geometry/image_grid.h"

namespace svort {

/// A 3D NIfTI image; 2D files have size.z() == 1.
struct NiftiImage {
  Eigen::Vector3i size = Eigen::Vector3i::Zero();
  Eigen::Vector3d spacing = Eigen::Vector3d::Ones();         ///< mm
  Eigen::Affine3d affine_lps = Eigen::Affine3d::Identity();  ///< voxel indices (i, j, k) to LPS mm
  std::vector<float> values;                                 ///< [k][j][i], scl_slope and scl_inter applied
};

/// Reads .nii or .nii.gz of any real datatype; sform if its code is positive, else qform, else an error.
/// @throws std::runtime_error naming the file and what is wrong with it (missing, unreadable, truncated, complex or
///         RGB data, more than one volume, no geometry, units other than mm)
NiftiImage read_nifti(const std::filesystem::path& path);

/// Writes a volume as float32 with sform and qform (RAS, as NIfTI wants it), whole or not at all.
/// @throws std::runtime_error naming the file and the reason (no such folder, disk full)
void write_nifti(const std::filesystem::path& path, const Volume& volume);

}  // namespace svort
