#include "svort_ros/live/slice_batch.h"

#include <stdexcept>
#include <string>

#include "svort_ros/acquisition/geometry_of_poses.h"
#include "svort_ros/live/sequence_tensors.h"

namespace svort {

SliceBatch make_slice_batch(const SliceSequence& sequence, const std::vector<SliceEstimate>& poses,
                            const ImageGrid& grid) {
  const auto& slices = sequence.slices();
  if (poses.size() != slices.size() || slices.empty())
    throw std::invalid_argument("make_slice_batch: " + std::to_string(poses.size()) + " poses for " +
                                std::to_string(slices.size()) + " slices");
  const SequenceTensors tensors = sequence_tensors(sequence);
  SliceBatch batch;
  batch.pixels = tensors.pixels;
  batch.masks.slices = tensors.masks;
  batch.weights = torch::empty({static_cast<std::int64_t>(slices.size())}, torch::kFloat32);

  std::vector<Pose> T_grid_crop;
  std::vector<double> thickness_mm;
  const Pose T_grid_brain = grid.T_frame_grid.inverse();
  for (std::size_t i = 0; i < slices.size(); ++i) {
    const PreparedSlice& slice = *slices[i];
    batch.weights.data_ptr<float>()[i] = static_cast<float>(poses[i].weight);
    thickness_mm.push_back(slice.info.thickness);
    T_grid_crop.push_back(T_grid_brain * poses[i].T_brain_slice * slice.T_slice_crop);
  }
  batch.geometry = geometry_of_poses(T_grid_crop, thickness_mm, sequence.options().resolution_mm, grid.spacing.x());
  return batch;
}

}  // namespace svort
