#include "weighted_volume.h"

#include <algorithm>

#include "svort_ros/acquisition/geometry_of_poses.h"

namespace svort {

torch::Tensor WeightedVolume::mean() const {
  const float least = 1e-3F * std::max(1e-12F, support.max().item<float>());
  return torch::where(support > least, sums / support.clamp_min(least), torch::zeros_like(sums));
}

std::vector<float> values_of(const torch::Tensor& volume) {
  return std::vector<float>(volume.data_ptr<float>(), volume.data_ptr<float>() + volume.numel());
}

WeightedVolume weighted_volume(const torch::Tensor& slices, const SliceAcquisition& acquisition,
                               const std::vector<double>& weights) {
  torch::Tensor w = torch::empty({static_cast<std::int64_t>(weights.size()), 1, 1, 1}, torch::kFloat32);
  std::transform(weights.begin(), weights.end(), w.data_ptr<float>(),
                 [](double weight) { return static_cast<float>(weight); });
  WeightedVolume volume;
  volume.support = acquisition.adjoint(w.expand_as(slices).contiguous(), false);
  volume.sums = acquisition.adjoint((slices * w).contiguous(), false);
  return volume;
}

SliceAcquisition cube_acquisition(const torch::Tensor& masks, const std::vector<Pose>& poses,
                                  const std::vector<double>& thickness_mm, double pixel_mm, std::int64_t size,
                                  double voxel_mm) {
  return SliceAcquisition(geometry_of_poses(poses, thickness_mm, pixel_mm, voxel_mm), static_cast<int>(masks.size(2)),
                          static_cast<int>(masks.size(3)), {size, size, size}, AcquisitionFormulation::fast,
                          {masks, {}});
}

}  // namespace svort
