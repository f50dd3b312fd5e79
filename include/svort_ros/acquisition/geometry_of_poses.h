#pragma once

#include <vector>

#include "svort_ros/acquisition/slice_acquisition.h"
#include "svort_ros/geometry/pose.h"

namespace svort {

/// Geometry of slices at given poses, with one PSF for each thickness that occurs.
///
/// @param T_grid_slice slice coordinates into the grid's, mm; one per slice
/// @param thickness_mm one per slice
/// @param pixel_mm, voxel_mm edges of a pixel and of a (cubic) voxel
/// @throws std::invalid_argument if there is no slice, or a size is not positive
AcquisitionGeometry geometry_of_poses(const std::vector<Pose>& T_grid_slice, const std::vector<double>& thickness_mm,
                                      double pixel_mm, double voxel_mm);

}  // namespace svort
