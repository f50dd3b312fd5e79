#include "rough_volume.h"

#include <torch/types.h>

#include <cmath>

#include "svort_ros/registration/pose_refinement.h"

namespace svort {
namespace {

/// Mean position of the brain's pixels.
Eigen::Vector3d brain_centre(const RegistrationInput& input, const std::vector<Pose>& poses,
                             const std::vector<double>& weights) {
  const torch::Tensor masks = input.masks.to(torch::kFloat64).squeeze(1);
  const auto centred = [](std::int64_t size) {
    return torch::arange(size, torch::kFloat64) - 0.5 * static_cast<double>(size - 1);
  };
  const torch::Tensor count = masks.sum({1, 2}).contiguous();
  const torch::Tensor x = masks.sum(1).mv(centred(masks.size(2))), y = masks.sum(2).mv(centred(masks.size(1)));
  Eigen::Vector3d sum = Eigen::Vector3d::Zero();
  double total = 0.;
  for (std::size_t i = 0; i < poses.size(); ++i) {
    const double pixels = count.data_ptr<double>()[i];
    if (!(pixels * weights[i] > 0.)) continue;
    const Eigen::Vector3d in_slice(x.data_ptr<double>()[i] / pixels, y.data_ptr<double>()[i] / pixels, 0.);
    sum += weights[i] * pixels * (poses[i] * (input.resolution_mm * in_slice));
    total += weights[i] * pixels;
  }
  return total > 0. ? Eigen::Vector3d(sum / total) : Eigen::Vector3d::Zero();
}

}  // namespace

Volume rough_volume(const RegistrationInput& input, const std::vector<Pose>& poses, const std::vector<double>& weights,
                    double size_mm, double voxel_mm) {
  Volume rough;
  rough.grid.size.setConstant(static_cast<int>(std::lround(size_mm / voxel_mm)));
  rough.grid.spacing.setConstant(voxel_mm);
  // Registration leaves the brain wherever the scanner saw it: a cube around the origin might cut it.
  rough.grid.T_frame_grid.translation() = brain_centre(input, poses, weights);
  std::vector<Pose> centred;
  for (const Pose& pose : poses) centred.push_back(rough.grid.T_frame_grid.inverse() * pose);
  const torch::Tensor volume = reconstruct_weighted(input, centred, weights, rough.grid.size.x(), voxel_mm, true);
  rough.values.assign(volume.data_ptr<float>(), volume.data_ptr<float>() + volume.numel());
  return rough;
}

}  // namespace svort
