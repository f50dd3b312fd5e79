#include "svort_ros/evaluation/method_table.h"

#include <torch/types.h>

#include <algorithm>
#include <cmath>
#include <optional>
#include <stdexcept>
#include <utility>

#include "scored_poses.h"
#include "svort_ros/geometry/rigid_transform.h"
#include "svort_ros/live/network_guide.h"
#include "svort_ros/live/network_input.h"
#include "svort_ros/live/sequence_tensors.h"
#include "svort_ros/metrics/image_similarity.h"
#include "svort_ros/reconstruction/final_volume.h"
#include "svort_ros/reconstruction/volume_estimation.h"
#include "svort_ros/registration/canonical_frame.h"
#include "svort_ros/registration/scan_registration.h"

namespace svort {
namespace {

/// Slices so far, and the truth.
struct PartOfScan {
  explicit PartOfScan(const SliceSequenceOptions& options) : sequence(options) {}

  bool add(const Slice& slice, const Pose& T_brain_slice) {
    if (!is_kept(sequence.add(slice).status)) return false;
    const Pose& T_slice_crop = sequence.newest_arrival()->T_slice_crop;
    truth.push_back(T_brain_slice);
    T_slice_crops.push_back(T_slice_crop);
    T_crop_slices.push_back(T_slice_crop.inverse());
    return true;
  }

  SliceSequence sequence;
  // In the sequence's order, as long as slices arrive as they were acquired.
  std::vector<Pose> truth, T_slice_crops, T_crop_slices;
};

/// What a method says about them.
struct Answer {
  std::vector<Pose> T_brain_crop;
  std::vector<double> weights;
  bool canonical = false;  ///< the frame is the canonical one without a template
  torch::Tensor attention;
};

Answer nominal_answer(const RegistrationInput& input) {
  return {input.T_world_slice, std::vector<double>(input.count(), 1.), false, {}};
}

Answer answer_of(const Refinement& refined, bool* converged) {
  Answer answer;
  for (const RefinedSlice& slice : refined.slices) {
    answer.T_brain_crop.push_back(slice.T_brain_slice);
    answer.weights.push_back(slice.weight);
  }
  *converged = refined.report.converged;
  return answer;
}

Answer refined_answer(const RegistrationInput& input, const Answer& start, const EstimatorOptions& options,
                      bool* converged) {
  Answer answer = answer_of(refine_poses(input, start.T_brain_crop, options.registration), converged);
  answer.canonical = start.canonical;
  answer.T_brain_crop = without_drift(answer.T_brain_crop, start.T_brain_crop);
  return answer;
}

/// The end of a scan, as the live system registers it.
Answer searched_answer(const PartOfScan& part, const RegistrationInput& input, const TableMethod& method,
                       const EstimatorOptions& options, bool* converged) {
  std::optional<NetworkGuide> guide;
  if (!method.guide.empty()) {
    NetworkEstimatorOptions network = options.network;
    network.weights = method.guide;
    guide.emplace(network);
  }
  const auto starts = registration_starts(input, guide ? &*guide : nullptr, part.sequence);
  Answer answer = answer_of(
      register_scan(input, starts, options.volume_size_mm, options.registration, options.template_match), converged);
  if (!guide) return answer;
  answer.T_brain_crop =
      moved(guide->find_frame(part.sequence, answer.T_brain_crop).T_canonical_brain, answer.T_brain_crop);
  answer.canonical = true;
  return answer;
}

Answer network_answer(const PartOfScan& part, const TableMethod& method, const EstimatorOptions& options) {
  const SequenceInput prepared = network_input(part.sequence, method.network->network().common_frame);
  NetworkRun run;
  run.iterations = method.iterations;
  run.formulation = acquisition_formulation(options.network.formulation);
  NetworkGrid grid;
  // Versions 1 and 2 look at this volume; for the live network it is only a result, which is not used here.
  grid.resolution_mm = method.network->network().name == "live" ? 2. : options.network.volume_resolution_mm;
  grid.volume_shape.fill(static_cast<std::int64_t>(std::lround(options.volume_size_mm / grid.resolution_mm)));
  const NetworkStep step = method.network->run(prepared.input, grid, run).back();
  // Weights count relative to each other, as in the live system.
  torch::Tensor weights = step.weights;
  if (weights.defined()) weights = weights / weights.max().clamp_min(1.);
  Answer answer;
  answer.canonical = true;
  answer.attention = step.attention;
  for (std::size_t i = 0; i < part.truth.size(); ++i) {
    const auto row = static_cast<std::int64_t>(i);
    const Pose T_brain_slice = pose_from_tensor(step.transforms[row]) * prepared.T_slice_window[i].inverse();
    answer.T_brain_crop.push_back(T_brain_slice * part.T_slice_crops[i]);
    answer.weights.push_back(weights.defined() ? weights[row].item<double>() : 1.);
  }
  return answer;
}

/// Compares slices of the true volume at any poses with those at the true ones.
class SliceComparison {
 public:
  SliceComparison(const EvaluationScan& scan, const RegistrationInput& input, const std::vector<Pose>& T_truth_crop,
                  const EstimatorOptions& options)
      : scan_(scan), input_(input), options_(options) {
    // No masks: what lies outside of the brain is dark in the volume.
    input_.masks = torch::ones_like(input.masks);
    reference_ = simulate(T_truth_crop);
    range_ = reference_.max().item<double>();
  }

  void score(const std::vector<Pose>& T_truth_crop, MethodScore* score) const {
    const torch::Tensor test = simulate(T_truth_crop);
    double psnr = 0., ssim = 0.;
    int count = 0;
    constexpr std::int64_t kRim = 5;  // of the window of SSIM
    for (std::int64_t i = 0; i < test.size(0); ++i) {
      const torch::Tensor a = test[i][0], b = reference_[i][0];
      SimilarityOptions options;
      options.data_range = range_;
      options.mask = (a > 0).logical_or(b > 0);
      const std::int64_t height = a.size(0) - 2 * kRim, width = a.size(1) - 2 * kRim;
      if (!options.mask.narrow(0, kRim, height).narrow(1, kRim, width).any().item<bool>()) continue;
      // Equal to rounding: float32 has 7 digits.
      constexpr double kMostPsnr = 140.;
      psnr += std::min(kMostPsnr, peak_signal_to_noise(a, b, options));
      ssim += structural_similarity(a, b, SsimWindow::gaussian, options).mean;
      ++count;
    }
    if (count == 0) return;
    score->slice_psnr_db = psnr / count;
    score->slice_ssim = ssim / count;
  }

 private:
  torch::Tensor simulate(const std::vector<Pose>& T_truth_crop) const {
    return acquisition_on_truth(scan_, input_, T_truth_crop, options_).forward(scan_.volume.contiguous());
  }

  const EvaluationScan& scan_;
  RegistrationInput input_;
  const EstimatorOptions& options_;
  torch::Tensor reference_;
  double range_ = 1.;
};

struct ScoredAnswer {
  MethodScore score;
  torch::Tensor ed, relative_ed;          ///< n; ed undefined without a canonical frame
  std::optional<Pose> T_canonical_brain;  ///< the frame, if there is one
  Pose T_truth_brain = Pose::Identity();  ///< that fits best
};

ScoredAnswer score_answer(const Answer& answer, const PartOfScan& part, const RegistrationInput& input,
                          const AccuracySetup& setup) {
  ScoredAnswer scored;
  const torch::Tensor poses = poses_tensor(composed(answer.T_brain_crop, part.T_crop_slices));
  const torch::Tensor truth = poses_tensor(part.truth);
  const PoseErrors relative = relative_pose_errors(poses, truth, kEvaluationFrame);
  scored.relative_ed = relative.ed;
  scored.score.relative_ed_mm = summarise(relative.ed).mean;
  scored.score.relative_gd_rad = summarise(relative.gd).mean;
  scored.T_truth_brain = global_alignment(poses, truth, kEvaluationFrame);
  if (answer.canonical) {
    scored.T_canonical_brain = Pose::Identity();
    scored.score.sure = true;
  } else if (!setup.atlas.empty()) {
    const EstimatorOptions& options = setup.pipeline.estimator;
    const auto match = find_canonical_frame(input, answer.T_brain_crop, answer.weights, setup.atlas,
                                            options.volume_size_mm, options.template_match);
    if (match) {
      scored.T_canonical_brain = match->T_template_volume;
      scored.score.sure = match->sure;
    }
  }
  if (!scored.T_canonical_brain) return scored;
  const PoseErrors absolute = pose_errors(transformed_poses(*scored.T_canonical_brain, poses), truth, kEvaluationFrame);
  scored.ed = absolute.ed;
  scored.score.ed_mm = summarise(absolute.ed).mean;
  scored.score.gd_rad = summarise(absolute.gd).mean;
  return scored;
}

/// Middle of what is bright, mm.
Eigen::Vector3d brain_centre(const EvaluationScan& scan) {
  const torch::Tensor voxels = torch::nonzero(scan.volume > 0).to(torch::kFloat64).mean(0);  // z, y, x
  Eigen::Vector3d centre;
  for (int axis = 0; axis < 3; ++axis) {
    const double middle = 0.5 * static_cast<double>(scan.volume.size(2 - axis) - 1);
    centre[axis] = (voxels[2 - axis].item<double>() - middle) * scan.voxel_mm;
  }
  return centre;
}

/// When the errors during the scan are measured.
bool is_measured(std::size_t seen) { return seen == 5 || (seen > 0 && seen % 10 == 0); }

TablePrefix score_prefix(const TableKey& key, const Answer& answer, const PartOfScan& part) {
  TablePrefix prefix;
  static_cast<TableKey&>(prefix) = key;
  prefix.seen = part.truth.size();
  const torch::Tensor poses = poses_tensor(composed(answer.T_brain_crop, part.T_crop_slices));
  const torch::Tensor truth = poses_tensor(part.truth);
  prefix.relative_ed_mm = summarise(relative_pose_errors(poses, truth, kEvaluationFrame).ed).mean;
  if (answer.canonical) prefix.ed_mm = summarise(pose_errors(poses, truth, kEvaluationFrame).ed).mean;
  return prefix;
}

std::vector<TablePrefix> measure_prefixes(const TableKey& key, const EvaluationScan& scan, const TableMethod& method,
                                          const AccuracySetup& setup) {
  std::vector<TablePrefix> prefixes;
  PartOfScan part(setup.pipeline.sequence);
  std::optional<LivePipeline> live;
  if (method.source == PoseSource::registration) {
    PipelineOptions options = setup.pipeline;
    options.estimator.method = "registration";
    options.estimator.network.guide = !method.guide.empty();
    options.estimator.network.weights = method.guide;
    live.emplace(options);
  }
  for (std::size_t i = 0; i < scan.slices.size(); ++i) {
    const bool kept = part.add(scan.slices[i], scan.truth[i]);
    if (live) live->add(scan.slices[i]);
    if (!kept || !is_measured(part.truth.size())) continue;
    Answer answer;
    if (live) {
      const auto& slices = live->estimate().slices;
      for (std::size_t k = 0; k < slices.size(); ++k)
        answer.T_brain_crop.push_back(slices[k].T_brain_slice * part.T_slice_crops[k]);
    } else if (method.source == PoseSource::network) {
      answer = network_answer(part, method, setup.pipeline.estimator);
    } else {
      answer = nominal_answer(registration_input(part.sequence));
    }
    prefixes.push_back(score_prefix(key, answer, part));
  }
  return prefixes;
}

}  // namespace

TableKey table_key(const TableMethod& method, const std::string& brain, const EvaluationScanOptions& scan) {
  constexpr std::size_t kDigits = 12;
  TableKey key;
  key.method = method.name;
  key.weights = method.weights_sha256.substr(0, kDigits);
  key.iterations = method.iterations;
  key.protocol = scan.protocol;
  key.brain = brain;
  key.motion = scan.motion;
  key.seed = scan.seed;
  key.number = scan.number;
  key.stacks = scan.stacks;
  return key;
}

TableResult measure_method(const EvaluationScan& scan, const TableMethod& method, const AccuracySetup& setup,
                           const TableExtent& extent) {
  const torch::NoGradGuard no_grad;
  const bool network = method.source == PoseSource::network, registration = method.source == PoseSource::registration;
  if (!network && !registration && method.source != PoseSource::nominal)
    throw std::invalid_argument("measure_method: '" + method.name + "' must be nominal, registration or network");
  if (!method.guide.empty() && !(registration && method.search))
    throw std::invalid_argument("measure_method: '" + method.name + "' has a guide, but does not search");
  if (network && !method.network) throw std::invalid_argument("measure_method: '" + method.name + "' has no network");
  const EstimatorOptions& options = setup.pipeline.estimator;
  TableResult result;
  TableScore& score = result.score;
  static_cast<TableKey&>(score) = table_key(method, scan.brain, scan.options);

  PartOfScan part(setup.pipeline.sequence);
  for (std::size_t i = 0; i < scan.slices.size(); ++i) part.add(scan.slices[i], scan.truth[i]);
  score.slices = part.truth.size();
  if (score.slices == 0) return result;
  const RegistrationInput input = registration_input(part.sequence);

  // Poses, and the same after registration.
  const Stopwatch own_time;
  Answer answer = network ? network_answer(part, method, options) : nominal_answer(input);
  if (registration) {
    answer = method.search ? searched_answer(part, input, method, options, &score.converged)
                           : refined_answer(input, answer, options, &score.converged);
  }
  score.seconds = own_time.seconds();
  const ScoredAnswer own = score_answer(answer, part, input, setup);
  score.own = own.score;
  std::optional<Answer> refined;
  std::optional<ScoredAnswer> after;
  if (registration) {
    refined = answer;
    after = own;
  } else if (network && extent.refined) {
    const Stopwatch refined_time;
    refined = refined_answer(input, answer, options, &score.converged);
    score.refined_seconds = refined_time.seconds();
    after = score_answer(*refined, part, input, setup);
  }
  if (after) score.refined = after->score;

  if (extent.volumes) {
    const SliceComparison comparison(scan, input, composed(part.truth, part.T_slice_crops), options);
    if (own.T_canonical_brain) comparison.score(moved(*own.T_canonical_brain, answer.T_brain_crop), &score.own);
    if (after && after->T_canonical_brain)
      comparison.score(moved(*after->T_canonical_brain, refined->T_brain_crop), &score.refined);

    const SliceAcquisition acquisition =
        acquisition_on_truth(scan, input, moved(own.T_truth_brain, answer.T_brain_crop), options);
    const std::vector<float> weights(answer.weights.begin(), answer.weights.end());
    TablePictures& pictures = result.pictures;
    pictures.truth = scan.volume;
    pictures.psf = reconstruct_psf(input.slices, acquisition);
    pictures.unweighted = solve_weighted_inverse(input.slices, acquisition, {}, pictures.psf, {});
    pictures.weighted =
        solve_weighted_inverse(input.slices, acquisition, torch::tensor(weights, torch::kFloat32), pictures.psf, {});
    pictures.attention = answer.attention;
    pictures.stacks = input.stack;
    score.psf = score_volume(pictures.psf, scan.volume);
    score.unweighted = score_volume(pictures.unweighted, scan.volume);
    score.weighted = score_volume(pictures.weighted, scan.volume);
    if (after) {
      const SliceAcquisition refined_acquisition =
          acquisition_on_truth(scan, input, moved(after->T_truth_brain, refined->T_brain_crop), options);
      const std::vector<float> refined_weights(refined->weights.begin(), refined->weights.end());
      score.refined_volume = score_volume(reconstruct_final_volume(input.slices, refined_acquisition, input.masks,
                                                                   torch::tensor(refined_weights, torch::kFloat32),
                                                                   input.resolution_mm, options.final_volume)
                                              .volume,
                                          scan.volume);
    }
  }

  const Eigen::Vector3d centre = brain_centre(scan);
  for (std::size_t i = 0; i < score.slices; ++i) {
    const auto row = static_cast<std::int64_t>(i);
    const SliceInfo& info = part.sequence.slices()[i]->info;
    TableSlice slice;
    static_cast<TableKey&>(slice) = score;
    slice.stack = info.stack;
    slice.slice = info.index;
    const Pose& truth = part.truth[i];
    slice.distance_mm = std::abs(truth.linear().col(2).dot(truth.translation() - centre));
    if (own.ed.defined()) slice.ed_mm = own.ed[row].item<double>();
    slice.relative_ed_mm = own.relative_ed[row].item<double>();
    if (after) slice.refined_relative_ed_mm = after->relative_ed[row].item<double>();
    result.slices.push_back(slice);
  }
  // While slices arrive the live classes search: a row of its own would be the same.
  if (extent.prefixes && !method.search) result.prefixes = measure_prefixes(score, scan, method, setup);
  return result;
}

}  // namespace svort
