#include "svort_ros/live/slice_batch.h"

#include <algorithm>
#include <cstring>
#include <map>
#include <stdexcept>

#include "svort_ros/acquisition/point_spread_function.h"
#include "svort_ros/geometry/rigid_transform.h"

namespace svort {
namespace {

SliceBatch make_batch(const SliceSequence& sequence, const std::vector<SliceEstimate>& poses, const ImageGrid& grid,
                      std::vector<std::size_t> members, double thickness) {
  const double voxel = grid.spacing.x();
  const auto count = static_cast<std::int64_t>(members.size());
  const std::int64_t size = sequence.options().size_px;
  const double resolution = sequence.options().resolution_mm;
  const auto intensity = static_cast<float>(1. / sequence.intensity_scale());

  SliceBatch batch;
  SliceObservations& observed = batch.observations;
  observed.slices = torch::empty({count, 1, size, size}, torch::kFloat32);
  observed.weights = torch::empty({count}, torch::kFloat32);
  observed.masks.slices = torch::empty({count, 1, size, size}, torch::kBool);
  observed.geometry.transforms = torch::empty({count, 3, 4}, torch::kFloat32);
  observed.geometry.psf = gaussian_psf({resolution / voxel, resolution / voxel, thickness / voxel});
  observed.geometry.resolution_ratio = resolution / voxel;

  const Pose T_grid_brain = grid.T_frame_grid.inverse();
  const auto plane = static_cast<std::size_t>(size * size);
  for (std::size_t i = 0; i < members.size(); ++i) {
    const PreparedSlice& slice = *sequence.slices()[members[i]];
    const SliceEstimate& estimate = poses[members[i]];
    std::transform(slice.pixels.begin(), slice.pixels.end(), observed.slices.data_ptr<float>() + i * plane,
                   [intensity](float value) { return value * intensity; });
    std::transform(slice.mask.begin(), slice.mask.end(), observed.masks.slices.data_ptr<bool>() + i * plane,
                   [](std::uint8_t value) { return value != 0; });
    observed.weights.data_ptr<float>()[i] = static_cast<float>(estimate.weight);
    Pose T_grid_crop = T_grid_brain * estimate.T_brain_slice * slice.T_slice_crop;
    T_grid_crop.translation() /= voxel;  // the forward model works in voxels
    observed.geometry.transforms[static_cast<std::int64_t>(i)].copy_(tensor_from_pose(T_grid_crop).squeeze(0));
  }
  batch.members = std::move(members);
  return batch;
}

}  // namespace

std::vector<SliceBatch> make_slice_batches(const SliceSequence& sequence, const std::vector<SliceEstimate>& poses,
                                           const ImageGrid& grid) {
  if (poses.size() != sequence.slices().size())
    throw std::invalid_argument("make_slice_batches: " + std::to_string(poses.size()) + " poses for " +
                                std::to_string(sequence.slices().size()) + " slices");
  std::map<double, std::vector<std::size_t>> by_thickness;
  for (std::size_t i = 0; i < poses.size(); ++i) by_thickness[sequence.slices()[i]->info.thickness].push_back(i);
  std::vector<SliceBatch> batches;
  for (auto& [thickness, members] : by_thickness)
    batches.push_back(make_batch(sequence, poses, grid, std::move(members), thickness));
  return batches;
}

}  // namespace svort
