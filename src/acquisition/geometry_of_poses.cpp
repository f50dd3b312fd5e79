#include "svort_ros/acquisition/geometry_of_poses.h"

#include <torch/types.h>

#include <cstdint>
#include <map>

#include "svort_ros/acquisition/point_spread_function.h"
#include "svort_ros/geometry/rigid_transform.h"

namespace svort {

AcquisitionGeometry geometry_of_poses(const std::vector<Pose>& T_grid_slice, const std::vector<double>& thickness_mm,
                                      double pixel_mm, double voxel_mm) {
  AcquisitionGeometry geometry;
  const auto n = static_cast<std::int64_t>(T_grid_slice.size());
  geometry.transforms = torch::empty({n, 3, 4}, torch::kFloat32);
  geometry.psf_of_slice = torch::empty({n}, torch::kInt64);
  geometry.resolution_ratio = pixel_mm / voxel_mm;
  std::map<double, std::int64_t> psf_of_thickness;
  std::vector<torch::Tensor> psfs;
  for (std::int64_t i = 0; i < n; ++i) {
    const double thickness = thickness_mm[static_cast<std::size_t>(i)];
    const auto [psf, is_new] = psf_of_thickness.try_emplace(thickness, static_cast<std::int64_t>(psfs.size()));
    if (is_new)
      psfs.push_back(gaussian_psf({geometry.resolution_ratio, geometry.resolution_ratio, thickness / voxel_mm}));
    geometry.psf_of_slice.data_ptr<std::int64_t>()[i] = psf->second;
    Pose pose = T_grid_slice[static_cast<std::size_t>(i)];
    pose.translation() /= voxel_mm;
    geometry.transforms[i].copy_(tensor_from_pose(pose).squeeze(0));
  }
  geometry.psf = stack_psfs(psfs);
  return geometry;
}

}  // namespace svort
