#include "scored_poses.h"

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
  SimilarityOptions options;
  options.mask = truth > 0;
  const torch::Tensor a = volume.masked_select(options.mask), b = truth.masked_select(options.mask);
  const double gain = ((a * b).sum() / (a * a).sum().clamp_min(1e-12)).item<double>();
  const torch::Tensor fitted = volume * gain;
  return {peak_signal_to_noise(fitted, truth, options),
          structural_similarity(fitted, truth, SsimWindow::gaussian, options).mean};
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
