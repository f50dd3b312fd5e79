#include "svort_ros/evaluation/accuracy.h"

#include <torch/types.h>

#include <algorithm>
#include <chrono>
#include <stdexcept>

#include "svort_ros/acquisition/geometry_of_poses.h"
#include "svort_ros/geometry/rigid_transform.h"
#include "svort_ros/live/sequence_tensors.h"
#include "svort_ros/metrics/image_similarity.h"
#include "svort_ros/metrics/pose_error.h"
#include "svort_ros/reconstruction/final_volume.h"
#include "svort_ros/registration/canonical_frame.h"

namespace svort {
namespace {

constexpr AnchorFrame kFrame{};  // 128 x 128 pixels of 1 mm, as the paper's planes

double seconds_since(std::chrono::steady_clock::time_point start) {
  return std::chrono::duration<double>(std::chrono::steady_clock::now() - start).count();
}

torch::Tensor tensor_of(const std::vector<Pose>& poses) {
  torch::Tensor tensor = torch::empty({static_cast<std::int64_t>(poses.size()), 3, 4}, torch::kFloat64);
  double* out = tensor.data_ptr<double>();
  for (const Pose& pose : poses) {
    const TransFirst matrix = trans_first_from_pose(pose);
    for (int i = 0; i < 3; ++i)
      for (int j = 0; j < 4; ++j) *out++ = matrix(i, j);
  }
  return tensor;
}

/// What a method says about the slices that the sequence kept, in its order.
struct Answer {
  std::vector<Pose> T_brain_slice;
  std::vector<double> weights;
  std::vector<Pose> truth;
  bool canonical = false;  ///< the frame is the canonical one without a template
};

std::vector<Pose> times(const std::vector<Pose>& poses, const std::vector<Pose>& right) {
  std::vector<Pose> result;
  for (std::size_t i = 0; i < poses.size(); ++i) result.push_back(poses[i] * right[i]);
  return result;
}

FrameScore score_frame(const Answer& answer, const Pose& T_canonical_brain, bool sure) {
  const torch::Tensor poses = transformed_poses(T_canonical_brain, tensor_of(answer.T_brain_slice));
  const torch::Tensor truth = tensor_of(answer.truth);
  const PoseErrors errors = pose_errors(poses, truth, kFrame);
  FrameScore score;
  const ErrorSummary ed = summarise(errors.ed);
  score.ed_mm = ed.mean;
  score.median_ed_mm = ed.median;
  score.gd_rad = summarise(errors.gd).mean;
  score.frame_rad = rotation_angle(global_alignment(poses, truth, kFrame));
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

}  // namespace

AccuracyRow measure_accuracy(const EvaluationScan& scan, const PoseMethod& method, const AccuracySetup& setup) {
  const torch::NoGradGuard no_grad;
  AccuracyRow row;
  row.brain = scan.brain;
  row.motion = scan.options.motion;
  row.masks = scan.options.damaged_masks ? "damaged" : "usual";
  row.number = scan.options.number;
  row.stacks = scan.options.stacks;
  row.method = method.name;

  PipelineOptions options = setup.pipeline;
  const bool live = method.source == PoseSource::live;
  options.estimator.method = "nominal";
  if (live) options.estimator.method = "registration";
  if (method.source == PoseSource::network) {
    options.estimator.method = "network";
    options.estimator.network.weights = method.weights;
  }
  LivePipeline pipeline(options);
  std::vector<std::pair<const SliceInfo*, Pose>> truth_of;
  std::vector<double> latency_ms;
  Answer answer;
  std::vector<Pose> published;
  std::vector<Pose> published_truth;
  const auto start = std::chrono::steady_clock::now();
  for (std::size_t i = 0; i < scan.slices.size(); ++i) {
    const auto arrived = std::chrono::steady_clock::now();
    if (!is_kept(pipeline.add(scan.slices[i]).status)) continue;
    answer.truth.push_back(scan.truth[i]);
    if (!live) continue;
    const double ms = 1e3 * seconds_since(arrived);
    const std::size_t count = pipeline.estimate().slices.size();
    if (count >= 80) latency_ms.push_back(ms);
    if (pipeline.newest()->info.stack >= 1) {
      published.push_back(pipeline.newest()->T_brain_slice);
      published_truth.push_back(scan.truth[i]);
    }
  }
  const SliceSequence& sequence = pipeline.sequence();
  row.slices = sequence.slices().size();
  const RegistrationInput input = registration_input(sequence);
  std::vector<Pose> T_slice_crop, T_crop_slice;
  for (const auto& slice : sequence.slices()) {
    T_slice_crop.push_back(slice->T_slice_crop);
    T_crop_slice.push_back(slice->T_slice_crop.inverse());
  }
  answer.weights.assign(row.slices, 1.);
  std::vector<Pose> crops = input.T_world_slice;
  const auto began = live ? start : std::chrono::steady_clock::now();
  if (method.source == PoseSource::network) {
    pipeline.finalise();
    answer.canonical = true;
    crops.clear();
    for (std::size_t i = 0; i < row.slices; ++i) {
      const SliceEstimate& slice = pipeline.estimate().slices[i];
      crops.push_back(slice.T_brain_slice * T_slice_crop[i]);
      answer.weights[i] = slice.weight;
    }
  }
  if (method.refined || method.source == PoseSource::stacks || method.source == PoseSource::registration) {
    RefinementOptions refinement = options.estimator.registration;
    if (method.source == PoseSource::stacks) refinement.trajectory_passes = 0;
    const Refinement refined = refine_poses(input, crops, refinement);
    crops.clear();
    for (std::size_t i = 0; i < row.slices; ++i) {
      crops.push_back(refined.slices[i].T_brain_slice);
      answer.weights[i] = refined.slices[i].weight;
    }
    row.converged = refined.report.converged;
  }
  row.seconds = seconds_since(began);
  answer.T_brain_slice = times(crops, T_crop_slice);
  if (live) {
    answer.T_brain_slice = published;
    answer.truth = published_truth;
    if (!latency_ms.empty()) {
      std::sort(latency_ms.begin(), latency_ms.end());
      row.p95_ms = latency_ms[static_cast<std::size_t>(0.95 * static_cast<double>(latency_ms.size() - 1) + 0.5)];
    }
  }
  if (answer.T_brain_slice.empty()) return row;

  const torch::Tensor poses = tensor_of(answer.T_brain_slice), truth = tensor_of(answer.truth);
  const PoseErrors relative = relative_pose_errors(poses, truth, kFrame);
  const ErrorSummary ed = summarise(relative.ed);
  row.relative_ed_mm = ed.mean;
  row.relative_median_ed_mm = ed.median;
  row.relative_gd_rad = summarise(relative.gd).mean;
  if (live) return row;

  if (answer.canonical) {
    row.atlas = score_frame(answer, Pose::Identity(), true);
  } else {
    const auto score = [&](const std::vector<BrainTemplate>& templates) {
      const auto match = find_canonical_frame(input, crops, answer.weights, templates, options.estimator.volume_size_mm,
                                              options.estimator.template_match);
      return match ? score_frame(answer, match->T_template_volume, match->sure) : FrameScore();
    };
    row.atlas = score(setup.atlas);
    row.shipped = score(setup.shipped);
  }
  if (method.with_volume) {
    // In the frame of the truth, so that only the shape of the volume counts, not where it is.
    const Pose T_truth_brain = global_alignment(poses, truth, kFrame);
    std::vector<Pose> T_truth_crop;
    for (const Pose& pose : crops) T_truth_crop.push_back(T_truth_brain * pose);
    const torch::Tensor psf =
        reconstruct_weighted(input, T_truth_crop, answer.weights, scan.volume.size(0), scan.voxel_mm);
    row.psf = score_volume(psf, scan.volume);
    const std::int64_t size = scan.volume.size(0);
    const SliceAcquisition acquisition(
        geometry_of_poses(T_truth_crop, input.thickness_mm, input.resolution_mm, scan.voxel_mm),
        static_cast<int>(input.slices.size(2)), static_cast<int>(input.slices.size(3)), {size, size, size},
        acquisition_formulation(options.estimator.formulation), {input.masks, {}});
    std::vector<float> weights(answer.weights.begin(), answer.weights.end());
    const FinalVolume final =
        reconstruct_final_volume(input.slices, acquisition, input.masks, torch::tensor(weights, torch::kFloat32),
                                 input.resolution_mm, options.estimator.final_volume);
    row.final = score_volume(final.volume, scan.volume);
  }
  return row;
}

}  // namespace svort
