#include "svort_ros/live/slice_batch.h"

#include <algorithm>
#include <stdexcept>
#include <string>

#include "svort_ros/acquisition/geometry_of_poses.h"

namespace svort {

SliceBatch make_slice_batch(const SliceSequence& sequence, const std::vector<SliceEstimate>& poses,
                            const ImageGrid& grid) {
  const auto& slices = sequence.slices();
  if (poses.size() != slices.size() || slices.empty())
    throw std::invalid_argument("make_slice_batch: " + std::to_string(poses.size()) + " poses for " +
                                std::to_string(slices.size()) + " slices");
  const auto count = static_cast<std::int64_t>(slices.size());
  const std::int64_t size = sequence.options().size_px;
  const auto intensity = static_cast<float>(1. / sequence.intensity_scale());

  SliceBatch batch;
  batch.pixels = torch::empty({count, 1, size, size}, torch::kFloat32);
  batch.weights = torch::empty({count}, torch::kFloat32);
  batch.masks.slices = torch::empty({count, 1, size, size}, torch::kBool);

  std::vector<Pose> T_grid_crop;
  std::vector<double> thickness_mm;
  const Pose T_grid_brain = grid.T_frame_grid.inverse();
  const auto plane = static_cast<std::size_t>(size * size);
  for (std::size_t i = 0; i < slices.size(); ++i) {
    const PreparedSlice& slice = *slices[i];
    std::transform(slice.pixels.begin(), slice.pixels.end(), batch.pixels.data_ptr<float>() + i * plane,
                   [intensity](float value) { return value * intensity; });
    std::transform(slice.mask.begin(), slice.mask.end(), batch.masks.slices.data_ptr<bool>() + i * plane,
                   [](std::uint8_t value) { return value != 0; });
    batch.weights.data_ptr<float>()[i] = static_cast<float>(poses[i].weight);

    thickness_mm.push_back(slice.info.thickness);
    T_grid_crop.push_back(T_grid_brain * poses[i].T_brain_slice * slice.T_slice_crop);
  }
  batch.geometry = geometry_of_poses(T_grid_crop, thickness_mm, sequence.options().resolution_mm, grid.spacing.x());
  return batch;
}

}  // namespace svort
