#include "svort_ros/registration/pose_refinement.h"

#include <torch/types.h>

#include <algorithm>
#include <array>
#include <cmath>
#include <limits>
#include <map>
#include <sstream>
#include <stdexcept>
#include <utility>

#include "../acquisition/parallel.h"
#include "registration_level.h"
#include "slice_weight.h"
#include "trajectory.h"
#include "weighted_volume.h"

namespace svort {
namespace {

constexpr double kFwhmPerSigma = 2.354820045;
constexpr double kInPlaneFwhm = 1.2;  // pixels (paper, sec. 2)

struct LevelPlan {
  double pixel_mm, blur_mm;
  int passes;
  bool per_stack;
  SliceContent content = SliceContent::inside;
};

/// One run of refine_poses().
class Refiner {
 public:
  Refiner(const RegistrationInput& input, const std::vector<Pose>& start, const RefinementOptions& options)
      : input_(input), options_(options), poses_(start), slices_(start.size()) {
    one_stack_ = input.stack.front() == input.stack.back() &&
                 std::count(input.stack.begin(), input.stack.end(), input.stack.front()) ==
                     static_cast<std::ptrdiff_t>(input.count());
    for (std::size_t i = 0; i + 1 < input.count(); ++i) {
      // Each slice's repetition time is taken for one step of the walk, whatever it is in seconds.
      const bool same_stack = input.stack[i] == input.stack[i + 1];
      const double spread = same_stack ? options.step_mm : options.step_mm * options.stack_gap_factor;
      spread_mm_.push_back(spread > 0. ? spread : std::numeric_limits<double>::infinity());
    }
  }

  Refinement run(RefinementEffort effort) {
    // Coarse to fine; the volume is blurred as the slices are. The coarsest level catches motions of centimetres.
    // Blurred that much, the inside of a brain alone looks alike everywhere, and poses drift; its outline holds them.
    // The finer levels do without, because masks are as wrong as segmentations are.
    const double middle = std::max(2., options_.finest_mm), coarse = 2. * middle;
    const int passes = options_.trajectory_passes;
    std::vector<LevelPlan> plan = {{coarse, 1.5 * coarse, options_.stack_passes, true, SliceContent::outline},
                                   {coarse, 1.5 * coarse, 2 * passes, false, SliceContent::outline},
                                   {middle, 2. * middle, options_.stack_passes, true, SliceContent::outline},
                                   {middle, 2. * middle, passes + 1, false, SliceContent::outline},
                                   {middle, middle, passes, false},
                                   {middle, 0.5 * middle, passes, false}};
    if (options_.finest_mm < middle) plan.push_back({options_.finest_mm, 0., passes, false});
    if (effort == RefinementEffort::warm)
      plan = {{middle, 2. * middle, 1, true, SliceContent::outline},
              {middle, middle, 1, false},
              {middle, 0.5 * middle, 1, false}};
    for (const LevelPlan& level : plan)
      if (level.passes > 0) run_level(level);

    Refinement result;
    result.slices = now();
    report_.converged = report_.passes > 0 && report_.last_motion_mm <= options_.convergence_mm;
    result.report = report_;
    return result;
  }

  std::vector<std::vector<RefinedSlice>> run_by_level() {
    const double middle = std::max(2., options_.finest_mm), coarse = 2. * middle;
    const std::array<LevelPlan, kRefinementLevels> plan = {{{coarse, 1.5 * coarse, 1, true, SliceContent::outline},
                                                            {coarse, 1.5 * coarse, 2, false, SliceContent::outline},
                                                            {middle, 2. * middle, 1, false, SliceContent::outline},
                                                            {middle, middle, 1, false}}};
    std::vector<std::vector<RefinedSlice>> path;
    load_level(plan.front());
    reconstruct();
    evaluate();
    path.push_back(now());
    for (const LevelPlan& level : plan) {
      run_level(level);
      path.push_back(now());
    }
    return path;
  }

 private:
  std::vector<RefinedSlice> now() const {
    std::vector<RefinedSlice> slices = slices_;
    for (std::size_t i = 0; i < slices.size(); ++i) slices[i].T_brain_slice = poses_[i];
    return slices;
  }

  void load_level(const LevelPlan& plan) {
    if (plan.pixel_mm == level_pixel_ && plan.blur_mm == level_blur_) return;
    level_ = make_level(input_, plan.pixel_mm, plan.blur_mm, plan.content);
    level_pixel_ = plan.pixel_mm;
    level_blur_ = plan.blur_mm;
  }

  void run_level(const LevelPlan& plan) {
    load_level(plan);
    for (int pass = 0; pass < plan.passes; ++pass) {
      reconstruct();
      constexpr int kStackSteps = 4, kTrajectorySteps = 3;
      const std::vector<Pose> before = poses_;
      for (int step = 0; step < (plan.per_stack ? kStackSteps : kTrajectorySteps); ++step) {
        evaluate();
        if (pass == 0 && step == 0) report_.first_cost = mean_cost();
        if (plan.per_stack)
          step_stacks();
        else
          step_trajectory();
      }
      return_strays();
      evaluate();
      weigh();
      report_.last_cost = mean_cost();
      report_.last_motion_mm = 0.;
      for (std::size_t i = 0; i < poses_.size(); ++i)
        report_.last_motion_mm += motion_size(twist_of(poses_[i] * before[i].inverse()), options_.lever_mm) /
                                  static_cast<double>(poses_.size());
      ++report_.passes;
      if (report_.last_motion_mm <= options_.convergence_mm) break;
    }
  }

  void reconstruct() {
    double radius = level_.field_radius_mm;
    for (const Pose& pose : poses_) radius = std::max(radius, std::min(pose.translation().norm(), 60.) + 0.5 * radius);
    const auto size = static_cast<std::int64_t>(std::ceil(2. * std::min(radius, 90.) / level_.pixel_mm)) + 6;
    std::vector<double> weights;
    for (const RefinedSlice& slice : slices_) weights.push_back(slice.weight);
    const SliceAcquisition acquisition =
        cube_acquisition(level_.masks, poses_, input_.thickness_mm, level_.pixel_mm, size, level_.pixel_mm);
    const WeightedVolume all = weighted_volume(level_.slices, acquisition, weights);
    const double sigma = kInPlaneFwhm / kFwhmPerSigma;
    volume_ = SampledVolume(blurred(values_of(all.mean()), static_cast<int>(size), sigma), static_cast<int>(size),
                            level_.pixel_mm);
    if (one_stack_) return;
    support_ = SampledVolume(values_of(all.support), static_cast<int>(size), level_.pixel_mm);

    // What a slice of weight 1 gives to the voxels of its own plane, alone.
    const auto largest = static_cast<std::int64_t>(
        std::max_element(level_.points.begin(), level_.points.end(),
                         [](const SlicePoints& x, const SlicePoints& y) { return x.value.size() < y.value.size(); }) -
        level_.points.begin());
    const auto index = static_cast<std::size_t>(largest);
    const torch::Tensor one = level_.slices.narrow(0, largest, 1), mask = level_.masks.narrow(0, largest, 1);
    const torch::Tensor alone = cube_acquisition(mask.contiguous(), {poses_[index]}, {input_.thickness_mm[index]},
                                                 level_.pixel_mm, size, level_.pixel_mm)
                                    .adjoint(torch::ones_like(one), false);
    const SampledVolume own(values_of(alone), static_cast<int>(size), level_.pixel_mm);
    own_support_ = mean_support(own, index);
  }

  double mean_support(const SampledVolume& support, std::size_t slice) const {
    const SlicePoints& points = level_.points[slice];
    if (points.value.empty()) return 0.;
    const Eigen::Affine3f pose = poses_[slice].cast<float>();
    double sum = 0.;
    for (const Eigen::Vector2f& p : points.position) sum += support.at(pose * Eigen::Vector3f(p.x(), p.y(), 0.F)).value;
    return sum / static_cast<double>(points.value.size());
  }

  /// A slice that has left the others fits itself perfectly, wherever it is. It goes where its neighbour in time says
  /// that the head was.
  void return_strays() {
    if (one_stack_) return;
    constexpr double kOwnShare = 0.8;
    std::vector<bool> stray(poses_.size());
    for (std::size_t i = 0; i < poses_.size(); ++i)
      stray[i] = slices_[i].weight > 0. && slices_[i].weight * own_support_ > kOwnShare * mean_support(support_, i);
    const std::vector<Pose> found = poses_;
    for (std::size_t i = 0; i < poses_.size(); ++i) {
      if (!stray[i]) continue;
      for (std::size_t distance = 1; distance < poses_.size(); ++distance) {
        const auto usable = [&](std::size_t j) { return input_.stack[j] == input_.stack[i] && !stray[j]; };
        std::size_t from = i;
        if (i >= distance && usable(i - distance))
          from = i - distance;
        else if (i + distance < poses_.size() && usable(i + distance))
          from = i + distance;
        if (from == i) continue;
        poses_[i] = found[from] * input_.T_world_slice[from].inverse() * input_.T_world_slice[i];
        break;
      }
    }
  }

  void evaluate() {
    terms_.resize(poses_.size());
    const double in_plane = kInPlaneFwhm * level_.pixel_mm / kFwhmPerSigma;
    parallel_tasks(static_cast<std::int64_t>(poses_.size()), [&](std::int64_t task) {
      const auto i = static_cast<std::size_t>(task);
      const double through = input_.thickness_mm[i] / kFwhmPerSigma;
      const ProfileTaps taps = profile_taps(std::sqrt(std::max(0., through * through - in_plane * in_plane)));
      SliceTermOptions options;
      options.image_scale = options_.image_scale * level_.bright;
      options.offset_spread = 0.1 * level_.bright;
      options.gain = slices_[i].gain;
      options.offset = slices_[i].offset;
      terms_[i] = slice_terms(level_.points[i], taps, volume_, poses_[i], options);
    });
    for (std::size_t i = 0; i < poses_.size(); ++i) {
      slices_[i].gain = terms_[i].gain;
      slices_[i].offset = terms_[i].offset;
      slices_[i].ncc = terms_[i].ncc;
    }
  }

  double mean_cost() const {
    double sum = 0., pixels = 0.;
    for (std::size_t i = 0; i < terms_.size(); ++i) {
      const auto count = static_cast<double>(level_.points[i].value.size());
      sum += terms_[i].cost * count;
      pixels += count;
    }
    return pixels > 0. ? sum / pixels : 0.;
  }

  void weigh() {
    for (RefinedSlice& slice : slices_) weigh_slice(options_.outlier_ncc, &slice);
    // All of them outliers: then none is, or there would be no volume to return to.
    if (std::all_of(slices_.begin(), slices_.end(), [](const RefinedSlice& s) { return s.weight == 0.; }))
      for (RefinedSlice& slice : slices_)
        if (std::isfinite(slice.ncc)) slice.weight = 1e-3;
  }

  Vector6d bounded(const Vector6d& step) const {
    const double size = motion_size(step, options_.lever_mm);
    return size > options_.largest_step_mm ? Vector6d(step * (options_.largest_step_mm / size)) : step;
  }

  void step_stacks() {
    std::map<int, std::pair<Matrix6d, Vector6d>> sums;
    for (std::size_t i = 0; i < poses_.size(); ++i) {
      auto [sum, is_new] = sums.try_emplace(input_.stack[i], Matrix6d::Zero(), Vector6d::Zero());
      sum->second.first += terms_[i].hessian;
      sum->second.second += terms_[i].gradient;
    }
    std::map<int, Pose> steps;
    for (auto& [stack, sum] : sums) {
      Matrix6d hessian = sum.first;
      hessian.diagonal() *= 1. + 1e-4;
      hessian.diagonal().array() += 1e-9;
      steps[stack] = motion(bounded(-hessian.ldlt().solve(sum.second)));
    }
    for (std::size_t i = 0; i < poses_.size(); ++i) poses_[i] = steps[input_.stack[i]] * poses_[i];
  }

  void step_trajectory() {
    // The image terms in units of their noise: the residuals' own scale, and far fewer independent pixels than pixels.
    const double noise = std::max(2. * mean_cost(), 1e-6 * level_.bright * level_.bright);
    const double area = level_.pixel_mm * level_.pixel_mm;
    const double trust = options_.image_trust * (one_stack_ ? options_.one_stack_trust : 1.) * area / noise;
    std::vector<SliceTerms> scaled = terms_;
    std::vector<Pose> motions;
    for (std::size_t i = 0; i < poses_.size(); ++i) {
      const double factor = trust * std::max(0.05, slices_[i].weight);
      scaled[i].hessian *= factor;
      scaled[i].gradient *= factor;
      motions.push_back(poses_[i] * input_.T_world_slice[i].inverse());
    }
    WalkOptions walk;
    walk.lever_mm = options_.lever_mm;
    walk.jump_mm = options_.jump_mm / options_.step_mm;
    const std::vector<Vector6d> steps = solve_trajectory(scaled, motions, spread_mm_, walk);
    for (std::size_t i = 0; i < poses_.size(); ++i) poses_[i] = motion(bounded(steps[i])) * poses_[i];
  }

  const RegistrationInput& input_;
  const RefinementOptions& options_;
  std::vector<Pose> poses_;
  std::vector<RefinedSlice> slices_;
  std::vector<double> spread_mm_;
  std::vector<SliceTerms> terms_;
  RegistrationLevel level_;
  bool one_stack_ = false;
  double level_pixel_ = 0., level_blur_ = 0.;
  SampledVolume volume_, support_;  ///< support: sum of the weights that each voxel received
  double own_support_ = 0.;
  RefinementReport report_;
};

}  // namespace

void validate(const RefinementOptions& options) {
  const auto require = [](bool condition, const char* name, double value, const char* range) {
    if (condition) return;
    std::ostringstream message;
    message << "registration." << name << " is " << value << "; it must be " << range;
    throw std::invalid_argument(message.str());
  };
  require(options.finest_mm >= 0.5 && options.finest_mm <= 4., "finest_mm", options.finest_mm, "from 0.5 to 4 mm");
  require(options.step_mm > 0. && options.step_mm <= 100., "step_mm", options.step_mm, "above 0, at most 100 mm");
  require(options.jump_mm > 0., "jump_mm", options.jump_mm, "positive");
  require(options.stack_gap_factor >= 0., "stack_gap_factor", options.stack_gap_factor, "zero or positive");
  require(options.lever_mm > 0., "lever_mm", options.lever_mm, "positive");
  require(options.image_scale > 0., "image_scale", options.image_scale, "positive");
  require(options.image_trust > 0. && options.image_trust <= 1., "image_trust", options.image_trust,
          "above 0, at most 1");
  require(options.one_stack_trust > 0. && options.one_stack_trust <= 1., "one_stack_trust", options.one_stack_trust,
          "above 0, at most 1");
  require(options.largest_step_mm > 0., "largest_step_mm", options.largest_step_mm, "positive");
  require(options.outlier_ncc >= -1. && options.outlier_ncc < 1., "outlier_ncc", options.outlier_ncc,
          "from -1 to below 1");
  require(options.stack_passes >= 0, "stack_passes", options.stack_passes, "zero or positive");
  require(options.trajectory_passes >= 0, "trajectory_passes", options.trajectory_passes, "zero or positive");
}

namespace {

void validate(const RegistrationInput& input, const std::vector<Pose>& start, const RefinementOptions& options) {
  validate(input);
  validate(options);
  if (start.size() != input.count())
    throw std::invalid_argument("registration: " + std::to_string(start.size()) + " start poses for " +
                                std::to_string(input.count()) + " slices");
}

}  // namespace

Refinement refine_poses(const RegistrationInput& input, const std::vector<Pose>& start,
                        const RefinementOptions& options, RefinementEffort effort) {
  validate(input, start, options);
  const torch::NoGradGuard no_grad;
  return Refiner(input, start, options).run(effort);
}

std::vector<std::vector<RefinedSlice>> refine_by_level(const RegistrationInput& input, const std::vector<Pose>& start,
                                                       const RefinementOptions& options) {
  validate(input, start, options);
  const torch::NoGradGuard no_grad;
  return Refiner(input, start, options).run_by_level();
}

torch::Tensor reconstruct_weighted(const RegistrationInput& input, const std::vector<Pose>& poses,
                                   const std::vector<double>& weights, std::int64_t size, double voxel_mm,
                                   bool fading) {
  validate(input);
  if (poses.size() != input.count() || weights.size() != input.count())
    throw std::invalid_argument("registration: poses and weights must have one entry per slice");
  const torch::NoGradGuard no_grad;
  const SliceAcquisition acquisition =
      cube_acquisition(input.masks, poses, input.thickness_mm, input.resolution_mm, size, voxel_mm);
  const WeightedVolume all = weighted_volume(input.slices * input.masks, acquisition, weights);
  if (!fading) return all.mean();
  // What few pixels have reached is mostly the tail of a PSF beyond the brain's edge, and would be as bright as the
  // edge. One stack without gaps gives each voxel this much.
  double thickness_mm = 0.;
  for (const double each : input.thickness_mm) thickness_mm += each / static_cast<double>(input.count());
  const double one_stack = voxel_mm * voxel_mm * voxel_mm / (input.resolution_mm * input.resolution_mm * thickness_mm);
  return all.sums / all.support.clamp_min(0.5 * one_stack);
}

}  // namespace svort
