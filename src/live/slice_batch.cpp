#include "svort_ros/live/slice_batch.h"

#include <algorithm>
#include <map>
#include <stdexcept>
#include <string>

#include "svort_ros/acquisition/point_spread_function.h"
#include "svort_ros/geometry/rigid_transform.h"

namespace svort {

SliceBatch make_slice_batch(const SliceSequence& sequence, const std::vector<SliceEstimate>& poses,
                            const ImageGrid& grid) {
  const auto& slices = sequence.slices();
  if (poses.size() != slices.size() || slices.empty())
    throw std::invalid_argument("make_slice_batch: " + std::to_string(poses.size()) + " poses for " +
                                std::to_string(slices.size()) + " slices");
  const double voxel = grid.spacing.x();
  const double ratio = sequence.options().resolution_mm / voxel;
  const auto count = static_cast<std::int64_t>(slices.size());
  const std::int64_t size = sequence.options().size_px;
  const auto intensity = static_cast<float>(1. / sequence.intensity_scale());

  SliceBatch batch;
  batch.pixels = torch::empty({count, 1, size, size}, torch::kFloat32);
  batch.weights = torch::empty({count}, torch::kFloat32);
  batch.masks.slices = torch::empty({count, 1, size, size}, torch::kBool);
  batch.geometry.transforms = torch::empty({count, 3, 4}, torch::kFloat32);
  batch.geometry.psf_of_slice = torch::empty({count}, torch::kInt64);
  batch.geometry.resolution_ratio = ratio;

  std::map<double, std::int64_t> psf_of_thickness;
  std::vector<torch::Tensor> psfs;
  const Pose T_grid_brain = grid.T_frame_grid.inverse();
  const auto plane = static_cast<std::size_t>(size * size);
  for (std::size_t i = 0; i < slices.size(); ++i) {
    const PreparedSlice& slice = *slices[i];
    const auto row = static_cast<std::int64_t>(i);
    std::transform(slice.pixels.begin(), slice.pixels.end(), batch.pixels.data_ptr<float>() + i * plane,
                   [intensity](float value) { return value * intensity; });
    std::transform(slice.mask.begin(), slice.mask.end(), batch.masks.slices.data_ptr<bool>() + i * plane,
                   [](std::uint8_t value) { return value != 0; });
    batch.weights.data_ptr<float>()[i] = static_cast<float>(poses[i].weight);

    const auto [psf, is_new] =
        psf_of_thickness.try_emplace(slice.info.thickness, static_cast<std::int64_t>(psfs.size()));
    if (is_new) psfs.push_back(gaussian_psf({ratio, ratio, slice.info.thickness / voxel}));
    batch.geometry.psf_of_slice.data_ptr<std::int64_t>()[i] = psf->second;

    Pose T_grid_crop = T_grid_brain * poses[i].T_brain_slice * slice.T_slice_crop;
    T_grid_crop.translation() /= voxel;  // the forward model works in voxels
    batch.geometry.transforms[row].copy_(tensor_from_pose(T_grid_crop).squeeze(0));
  }
  batch.geometry.psf = stack_psfs(psfs);
  return batch;
}

}  // namespace svort
