#include "svort_ros/evaluation/accuracy.h"

#include <torch/types.h>

#include <algorithm>
#include <cmath>
#include <map>
#include <optional>
#include <stdexcept>
#include <utility>

#include "scored_poses.h"
#include "svort_ros/geometry/rigid_fit.h"
#include "svort_ros/live/network_guide.h"
#include "svort_ros/live/sequence_tensors.h"
#include "svort_ros/live/volume_update.h"
#include "svort_ros/reconstruction/final_volume.h"
#include "svort_ros/registration/canonical_frame.h"
#include "svort_ros/registration/scan_registration.h"

namespace svort {
namespace {

/// What a method says about the slices that the sequence kept, in its order.
struct Answer {
  std::vector<Pose> T_brain_slice;
  std::vector<double> weights;
  std::vector<Pose> truth;
  bool canonical = false;  ///< the frame is the canonical one without a template
};

/// How the brain frame moved between two estimates: the motion that all slices of the first share.
Pose frame_motion(const std::vector<SliceEstimate>& before, const std::vector<SliceEstimate>& after) {
  std::vector<Pose> old_poses, new_poses;
  for (const SliceEstimate& slice : before) {
    const auto same = std::find_if(after.begin(), after.end(), [&](const SliceEstimate& other) {
      return other.info.stack == slice.info.stack && other.info.index == slice.info.index;
    });
    if (same == after.end()) continue;
    old_poses.push_back(slice.T_brain_slice);
    new_poses.push_back(same->T_brain_slice);
  }
  return old_poses.empty() ? Pose::Identity()
                           : global_alignment(poses_tensor(old_poses), poses_tensor(new_poses), kEvaluationFrame);
}

/// Errors of causal poses, over their radii, and told by agreement; the other slices, where they were at that moment,
/// hold the frame.
class CausalErrors {
 public:
  void add(const LivePipeline& pipeline, const Pose& truth) {
    const SliceEstimate& newest = *pipeline.newest();
    const std::vector<SliceEstimate>& slices = pipeline.estimate().slices;
    truth_[key_of(newest.info)] = truth;
    if (slices.size() < 2) return;
    std::vector<Pose> here, there;
    for (const SliceEstimate& slice : slices) {
      if (key_of(slice.info) == key_of(newest.info)) continue;
      here.push_back(slice.T_brain_slice);
      there.push_back(truth_.at(key_of(slice.info)));
    }
    const double lever_mm = pipeline.options().estimator.registration.lever_mm;
    const Pose off = fit_planes(here, there, lever_mm) * newest.T_brain_slice * truth.inverse();
    const double error_mm = std::hypot(off.translation().norm(), lever_mm * rotation_angle(off));
    const bool one_stack = std::all_of(slices.begin(), slices.end(), [&](const SliceEstimate& slice) {
      return slice.info.stack == newest.info.stack;
    });
    const double agreement = agreement_of(pipeline.sequence(), slices);
    if (std::isfinite(agreement)) count(error_mm, agreement < kAgreement);
    if (newest.status != PoseStatus::registered || !std::isfinite(newest.radius_95_mm)) return;
    (one_stack ? one_stack_ : more_).push_back(error_mm / newest.radius_95_mm);
  }
  RadiusScore one_stack() const { return score(one_stack_); }
  RadiusScore more() const { return score(more_); }
  const AgreementScore& agreement() const { return agreement_; }

 private:
  static std::pair<int, int> key_of(const SliceInfo& info) { return {info.stack, info.index}; }
  void count(double error_mm, bool warned) {
    constexpr double kFarMm = 10., kNearMm = 3.;
    agreement_.far += error_mm > kFarMm;
    agreement_.far_warned += error_mm > kFarMm && warned;
    agreement_.near += error_mm < kNearMm;
    agreement_.near_warned += error_mm < kNearMm && warned;
  }
  static RadiusScore score(std::vector<double> ratios) {
    RadiusScore result;
    if (ratios.empty()) return result;
    std::sort(ratios.begin(), ratios.end());
    result.slices = ratios.size();
    result.within = static_cast<std::size_t>(std::upper_bound(ratios.begin(), ratios.end(), 1.) - ratios.begin());
    result.ratio_95 = ratios[static_cast<std::size_t>(0.95 * static_cast<double>(ratios.size() - 1) + 0.5)];
    return result;
  }

  std::map<std::pair<int, int>, Pose> truth_;
  std::vector<double> one_stack_, more_;
  AgreementScore agreement_;
};

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
  if (live) {
    options.estimator.method = "registration";
    options.estimator.network.guide = !method.weights.empty();
    options.estimator.network.weights = method.weights;
  }
  if (method.source == PoseSource::network) {
    options.estimator.method = "network";
    options.estimator.network.weights = method.weights;
  }
  LivePipeline pipeline(options);
  std::vector<std::pair<const SliceInfo*, Pose>> truth_of;
  std::vector<double> latency_ms;
  CausalErrors causal;
  Answer answer;
  std::vector<Pose> published;
  std::vector<Pose> published_truth;
  std::vector<SliceEstimate> before;
  std::uint64_t frame_revision = 0;
  const Stopwatch whole;
  for (std::size_t i = 0; i < scan.slices.size(); ++i) {
    const Stopwatch arrival;
    if (!is_kept(pipeline.add(scan.slices[i]).status)) continue;
    answer.truth.push_back(scan.truth[i]);
    if (!live) continue;
    const double ms = 1e3 * arrival.seconds();
    const std::size_t count = pipeline.estimate().slices.size();
    if (count >= 80) latency_ms.push_back(ms);
    causal.add(pipeline, scan.truth[i]);
    if (pipeline.newest()->start.rfind("network", 0) == 0) ++row.network_starts;
    // Where the brain frame was moved, and said so, what was published before moves with it.
    if (pipeline.estimate().frame_revision != frame_revision && !published.empty()) {
      const Pose T_new_old = frame_motion(before, pipeline.estimate().slices);
      for (Pose& pose : published) pose = T_new_old * pose;
    }
    frame_revision = pipeline.estimate().frame_revision;
    before = pipeline.estimate().slices;
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
  std::optional<NetworkGuide> guide;
  if (method.source == PoseSource::registration && !method.weights.empty()) {
    options.estimator.network.weights = method.weights;
    guide.emplace(options.estimator.network);
  }
  const Stopwatch after_arrivals;
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
    const std::vector<Pose> start = crops;
    // From the scanner's poses the stacks may be anywhere; from a network's or for the stack stage, these poses count.
    const Refinement refined =
        method.source == PoseSource::registration
            ? register_scan(input, registration_starts(input, guide ? &*guide : nullptr, sequence),
                            options.estimator.volume_size_mm, refinement, options.estimator.template_match)
            : refine_poses(input, start, refinement);
    crops.clear();
    for (std::size_t i = 0; i < row.slices; ++i) {
      crops.push_back(refined.slices[i].T_brain_slice);
      answer.weights[i] = refined.slices[i].weight;
    }
    if (answer.canonical) crops = without_drift(crops, start);
    row.converged = refined.report.converged;
  }
  row.seconds = (live ? whole : after_arrivals).seconds();
  answer.T_brain_slice = composed(crops, T_crop_slice);
  if (live) {
    std::vector<Pose> followed;
    for (const SliceEstimate& slice : pipeline.estimate().slices) {
      followed.push_back(slice.T_brain_slice);
      if (slice.start == "search") ++row.search_starts;
    }
    if (!followed.empty())
      row.followed_ed_mm =
          summarise(relative_pose_errors(poses_tensor(followed), poses_tensor(answer.truth), kEvaluationFrame).ed).mean;
    answer.T_brain_slice = published;
    answer.truth = published_truth;
    row.radius_one_stack = causal.one_stack();
    row.radius = causal.more();
    row.agreement = causal.agreement();
    if (!latency_ms.empty()) {
      std::sort(latency_ms.begin(), latency_ms.end());
      row.p95_ms = latency_ms[static_cast<std::size_t>(0.95 * static_cast<double>(latency_ms.size() - 1) + 0.5)];
    }
  }
  if (answer.T_brain_slice.empty()) return row;

  const torch::Tensor poses = poses_tensor(answer.T_brain_slice), truth = poses_tensor(answer.truth);
  const PoseErrors relative = relative_pose_errors(poses, truth, kEvaluationFrame);
  const ErrorSummary ed = summarise(relative.ed);
  row.relative_ed_mm = ed.mean;
  row.relative_median_ed_mm = ed.median;
  row.relative_gd_rad = summarise(relative.gd).mean;
  if (live) return row;

  if (answer.canonical) {
    row.atlas = score_frame(answer.T_brain_slice, answer.truth, Pose::Identity(), true);
  } else {
    const auto score = [&](const std::vector<BrainTemplate>& templates) {
      const auto match = find_canonical_frame(input, crops, answer.weights, templates, options.estimator.volume_size_mm,
                                              options.estimator.template_match);
      return match ? score_frame(answer.T_brain_slice, answer.truth, match->T_template_volume, match->sure)
                   : FrameScore();
    };
    row.atlas = score(setup.atlas);
    row.shipped = score(setup.shipped);
  }
  if (guide) {
    const NetworkGuide::Frame frame = guide->find_frame(sequence, crops);
    row.guide =
        score_frame(answer.T_brain_slice, answer.truth, frame.T_canonical_brain, frame.agreement >= kFrameAgreement);
  }
  if (method.with_volume) {
    // In the frame of the truth, so that only the shape of the volume counts, not where it is.
    const Pose T_truth_brain = global_alignment(poses, truth, kEvaluationFrame);
    const std::vector<Pose> T_truth_crop = moved(T_truth_brain, crops);
    const torch::Tensor psf =
        reconstruct_weighted(input, T_truth_crop, answer.weights, scan.volume.size(0), scan.voxel_mm);
    row.psf = score_volume(psf, scan.volume);
    const SliceAcquisition acquisition = acquisition_on_truth(scan, input, T_truth_crop, options.estimator);
    std::vector<float> weights(answer.weights.begin(), answer.weights.end());
    const FinalVolume final =
        reconstruct_final_volume(input.slices, acquisition, input.masks, torch::tensor(weights, torch::kFloat32),
                                 input.resolution_mm, options.estimator.final_volume);
    row.final = score_volume(final.volume, scan.volume);
  }
  return row;
}

}  // namespace svort
