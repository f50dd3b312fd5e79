#include "scored_poses.h"

#include <algorithm>

#include "svort_ros/acquisition/geometry_of_poses.h"
#include "svort_ros/metrics/image_similarity.h"

namespace svort {

std::vector<Pose> moved(const Pose& left, const std::vector<Pose>& poses) {
  std::vector<Pose> result;
  for (const Pose& pose : poses) result.push_back(left * pose);
  return result;
}

std::vector<Pose> composed(const std::vector<Pose>& poses, const std::vector<Pose>& right) {
  std::vector<Pose> result;
  for (std::size_t i = 0; i < poses.size(); ++i) result.push_back(poses[i] * right[i]);
  return result;
}

std::vector<Pose> without_drift(const std::vector<Pose>& refined, const std::vector<Pose>& start) {
  return moved(global_alignment(poses_tensor(refined), poses_tensor(start), kEvaluationFrame), refined);
}

FrameScore score_frame(const std::vector<Pose>& T_brain_slice, const std::vector<Pose>& truth,
                       const Pose& T_canonical_brain, bool sure) {
  const torch::Tensor poses = poses_tensor(moved(T_canonical_brain, T_brain_slice)), known = poses_tensor(truth);
  const PoseErrors errors = pose_errors(poses, known, kEvaluationFrame);
  FrameScore score;
  const ErrorSummary ed = summarise(errors.ed);
  score.ed_mm = ed.mean;
  score.median_ed_mm = ed.median;
  score.gd_rad = summarise(errors.gd).mean;
  score.frame_rad = rotation_angle(global_alignment(poses, known, kEvaluationFrame));
  score.sure = sure;
  return score;
}

VolumeScore score_volume(const torch::Tensor& volume, const torch::Tensor& truth) {
  // Only the brain counts: a box around it, with room for the window of SSIM, gives the same numbers sooner.
  constexpr std::int64_t kRoom = 6;
  torch::Tensor test = volume, reference = truth;
  for (std::int64_t axis = 0; axis < 3; ++axis) {
    const torch::Tensor bright = torch::nonzero((reference > 0).transpose(0, axis).flatten(1).any(1)).flatten();
    if (bright.numel() == 0) break;
    const std::int64_t begin = std::max<std::int64_t>(0, bright[0].item<std::int64_t>() - kRoom);
    const std::int64_t end = std::min(reference.size(axis), bright[-1].item<std::int64_t>() + 1 + kRoom);
    test = test.slice(axis, begin, end);
    reference = reference.slice(axis, begin, end);
  }
  SimilarityOptions options;
  options.mask = reference > 0;
  options.data_range = (truth.max() - truth.min()).item<double>();
  const torch::Tensor a = test.masked_select(options.mask), b = reference.masked_select(options.mask);
  const double gain = ((a * b).sum() / (a * a).sum().clamp_min(1e-12)).item<double>();
  const torch::Tensor fitted = test * gain;
  return {peak_signal_to_noise(fitted, reference, options),
          structural_similarity(fitted, reference, SsimWindow::gaussian, options).mean};
}

SliceAcquisition acquisition_on_truth(const EvaluationScan& scan, const RegistrationInput& input,
                                      const std::vector<Pose>& T_truth_crop, const EstimatorOptions& options) {
  const std::int64_t size = scan.volume.size(0);
  return {geometry_of_poses(T_truth_crop, input.thickness_mm, input.resolution_mm, scan.voxel_mm),
          static_cast<int>(input.slices.size(2)),
          static_cast<int>(input.slices.size(3)),
          {size, size, size},
          acquisition_formulation(options.formulation),
          {input.masks, {}}};
}

}  // namespace svort
