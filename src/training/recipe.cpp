#include "svort_ros/training/recipe.h"

#include <cmath>
#include <stdexcept>

#include "svort_ros/geometry/anchor_points.h"
#include "svort_ros/geometry/rigid_fit.h"
#include "svort_ros/geometry/rigid_transform.h"
#include "svort_ros/simulation/random_stream.h"
#include "svort_ros/training/losses.h"

namespace svort {
namespace {

// What random numbers are drawn for, so that a change in one place leaves the others as they were.
enum Purpose : std::uint64_t {
  kWhichNetwork = 101,
  kWhichIteration = 102,
  kWarmStart = 103,
  kPullsUnknown = 104,
  kWhetherFrame = 105,
  kFrameStart = 106
};

constexpr double kRadians = M_PI / 180.;

void require(bool condition, const char* option, const char* range) {
  if (!condition) throw std::invalid_argument(std::string("recipe.") + option + " must be " + range);
}

torch::Tensor random_motion(RandomStream& random, double rotation, double translation) {
  torch::Tensor motion = torch::empty({6});
  for (int axis = 0; axis < 3; ++axis) motion[axis] = random.normal(rotation);
  for (int axis = 3; axis < 6; ++axis) motion[axis] = random.normal(translation);
  return motion;
}

// Scans of one step, one after another.
struct Batch {
  NetworkInput input;
  torch::Tensor truth;  // n x 3 x 4
  torch::Tensor good;   // n, 1 for a slice without void or much noise
  std::vector<std::int64_t> lengths;
};

Batch batch_of(const std::vector<SimulatedScan>& scans) {
  std::vector<const NetworkInput*> inputs;
  std::vector<torch::Tensor> truths, bad;
  Batch batch;
  for (const SimulatedScan& scan : scans) {
    inputs.push_back(&scan.input);
    batch.lengths.push_back(scan.truth.size(0));
    truths.push_back(scan.truth);
    bad.push_back(scan.voided.logical_or(scan.noisy));
  }
  batch.input = concatenate(inputs);
  batch.truth = torch::cat(truths);
  batch.good = torch::cat(bad).logical_not().to(torch::kFloat32);
  return batch;
}

/// Places off by a walk in acquisition order plus what each slice does on its own.
torch::Tensor perturbed(const torch::Tensor& truth, RandomStream& random, double rotation, double translation) {
  torch::Tensor walk = random_motion(random, rotation, translation), motions = torch::empty({truth.size(0), 6});
  constexpr double kMemory = 0.9, kOwn = 0.3;
  for (std::int64_t i = 0; i < truth.size(0); ++i) {
    walk = kMemory * walk + std::sqrt(1. - kMemory * kMemory) * random_motion(random, rotation, translation);
    motions[i] = walk + kOwn * random_motion(random, rotation, translation);
  }
  return compose_transforms(truth, axisangle_to_matrix(motions));
}

/// A scan's true poses, moved as one body to where most of its slices lie now: n x 3 x 4.
torch::Tensor truth_as_placed(const torch::Tensor& truth, const torch::Tensor& placed, const AnchorFrame& frame) {
  const Pose motion =
      fit_most_planes(poses_from_tensor(truth), poses_from_tensor(placed), 0.5 * frame.width * frame.resolution);
  return compose_transforms(tensor_from_pose(motion).to(truth.device()).expand_as(truth), truth);
}

StepLoss sum_of(const std::vector<std::tuple<const char*, double, torch::Tensor>>& terms) {
  StepLoss loss;
  for (const auto& [name, weight, value] : terms) {
    const torch::Tensor mean = value.mean();
    loss.parts[name] = mean.item<double>();
    loss.total = loss.total.defined() ? loss.total + weight * mean : weight * mean;
  }
  return loss;
}

}  // namespace

NetworkInput concatenate(const std::vector<const NetworkInput*>& inputs) {
  if (inputs.empty()) throw std::invalid_argument("concatenate: there is no input");
  const auto joined = [&inputs](torch::Tensor NetworkInput::*member) {
    std::vector<torch::Tensor> parts;
    for (const NetworkInput* input : inputs) parts.push_back(input->*member);
    return torch::cat(parts);
  };
  NetworkInput result = *inputs.front();
  for (const NetworkInput* input : inputs) {
    if (input->slice_resolution_mm != result.slice_resolution_mm)
      throw std::invalid_argument("concatenate: scans of different pixel size");
  }
  result.slices = joined(&NetworkInput::slices);
  result.transforms = joined(&NetworkInput::transforms);
  result.positions = joined(&NetworkInput::positions);
  result.slice_counts = joined(&NetworkInput::slice_counts);
  result.times = joined(&NetworkInput::times);
  return result;
}

LiveRecipe::LiveRecipe(std::shared_ptr<LiveNetwork> network, const LiveRecipeOptions& options, std::uint64_t seed)
    : network_(std::move(network)), options_(options), seed_(seed) {
  const auto share = [](double value) { return value >= 0. && value <= 1.; };
  const auto size = [](double value) { return value >= 0. && std::isfinite(value); };
  require(share(options.frame_share), "frame_share", "0 to 1");
  require(options.frame_share == 0. || network_->has_frame_network(), "frame_share",
          "0, because network.frame_width is 0: there is no frame network");
  require(size(options.frame_deg) && options.frame_deg <= 180., "frame_deg", "0 to 180 degrees");
  require(size(options.frame_mm), "frame_mm", "zero or positive");
  require(share(options.first_share), "first_share", "0 to 1");
  require(share(options.placed_share), "placed_share", "0 to 1");
  require(share(options.second_update_share), "second_update_share", "0 to 1");
  require(share(options.pulls_unknown_share), "pulls_unknown_share", "0 to 1");
  require(options.beta > 0. && std::isfinite(options.beta), "beta", "positive");
  require(options.shared_beta > 0. && std::isfinite(options.shared_beta), "shared_beta", "positive");
  require(size(options.mirror_weight), "mirror_weight", "zero or positive");
  require(size(options.scale_weight), "scale_weight", "zero or positive");
  require(size(options.quality_weight), "quality_weight", "zero or positive");
  require(size(options.perturb_deg) && options.perturb_deg <= 180., "perturb_deg", "0 to 180 degrees");
  require(size(options.perturb_mm), "perturb_mm", "zero or positive");
  require(size(options.global_deg) && options.global_deg <= 180., "global_deg", "0 to 180 degrees");
  require(size(options.global_mm), "global_mm", "zero or positive");
}

std::vector<std::string> LiveRecipe::parts() const {
  return {"first_points",   "first_mirrored", "first_scale", "first_quality", "shared_points", "shared_scale",
          "shared_quality", "shared_start",   "frame_cells", "frame_scale",   "frame_start",   "frame_left"};
}

StepLoss LiveRecipe::loss(const std::vector<SimulatedScan>& scans, std::uint64_t step) {
  if (RandomStream(seed_, step, kWhetherFrame).chance(options_.frame_share)) return frame_loss(scans, step);
  const Batch batch = batch_of(scans);
  if (RandomStream(seed_, step, kWhichNetwork).chance(options_.first_share)) {
    return first_loss(batch.input, batch.truth, batch.good, batch.lengths);
  }
  return shared_loss(scans, batch.input, batch.truth, batch.good, batch.lengths, step);
}

StepLoss LiveRecipe::first_loss(const NetworkInput& input, const torch::Tensor& truth, const torch::Tensor& good,
                                const std::vector<std::int64_t>& lengths) {
  const torch::Tensor target = anchor_points_from_matrix(truth, live_anchor_frame(network_->options())) / kLiveUnitMm;
  const LiveOutput said = network_->attend(network_->encode(input.slices, input.slice_resolution_mm), input, lengths);
  const torch::Tensor points = smooth_l1_loss(said.points, target, options_.beta);
  const torch::Tensor error = (said.points - target).detach().view({-1, 3, 3}).norm(2, 2).mean(1);
  return sum_of({{"first_points", 1., points},
                 {"first_mirrored", options_.mirror_weight, mirror_loss(said.mirrored, target, options_.beta)},
                 {"first_scale", options_.scale_weight, scale_loss(error, said.log_scale)},
                 {"first_quality", options_.quality_weight,
                  torch::binary_cross_entropy_with_logits(said.quality, good, {}, {}, torch::Reduction::None)}});
}

torch::Tensor LiveRecipe::warm_start(const SimulatedScan& scan, std::uint64_t step, std::uint64_t index) {
  const torch::NoGradGuard no_grad;
  RandomStream random(seed_, step * 64 + index, kWarmStart);
  const std::int64_t n = scan.truth.size(0);
  torch::Tensor start;
  if (random.chance(options_.placed_share)) {
    start = network_->place(network_->encode(scan.input.slices, scan.input.slice_resolution_mm), scan.input).cpu();
  } else {
    // A walk in acquisition order plus what each slice does on its own, both of a size drawn for the scan.
    const double size = random.uniform();
    start = perturbed(scan.truth.cpu(), random, size * options_.perturb_deg * kRadians, size * options_.perturb_mm);
  }
  const torch::Tensor global =
      axisangle_to_matrix(random_motion(random, options_.global_deg * kRadians, options_.global_mm).unsqueeze(0));
  return compose_transforms(global.expand({n, 3, 4}), start).to(scan.truth.device());
}

StepLoss LiveRecipe::shared_loss(const std::vector<SimulatedScan>& scans, NetworkInput input,
                                 const torch::Tensor& truth, const torch::Tensor& good,
                                 const std::vector<std::int64_t>& lengths, std::uint64_t step) {
  const LiveNetworkOptions& shape = network_->options();
  std::vector<torch::Tensor> starts;
  for (std::size_t i = 0; i < scans.size(); ++i) starts.push_back(warm_start(scans[i], step, i));
  input.transforms = torch::cat(starts);
  const bool pulled = shape.pulls && shape.volume_conditioned &&
                      !RandomStream(seed_, step, kPullsUnknown).chance(options_.pulls_unknown_share);
  const auto update = [&] {
    torch::Tensor simulated =
        torch::zeros({truth.size(0), kLiveSimulatedChannels, shape.input_px, shape.input_px}, truth.options());
    std::vector<LivePulls> pulls;
    std::int64_t begin = 0;
    for (const SimulatedScan& scan : scans) {
      const std::int64_t n = scan.truth.size(0);
      NetworkInput current = scan.input;
      current.transforms = input.transforms.narrow(0, begin, n);
      const torch::Tensor reduced = network_->reduce(scan.input.slices, scan.input.slice_resolution_mm);
      if (shape.volume_conditioned) {
        simulated.narrow(0, begin, n)
            .copy_(simulate_live_channels(reduced, current.transforms, shape, scan.input.thickness_mm,
                                          AcquisitionFormulation::fast));
      }
      pulls.push_back(pulled ? pull_live_slices(reduced, current, shape) : LivePulls());
      begin += n;
    }
    return network_->update(simulated, concatenate(pulls), input, lengths);
  };
  if (RandomStream(seed_, step, kWhichIteration).chance(options_.second_update_share)) {
    const torch::NoGradGuard no_grad;
    input.transforms = apply_live_update(input.transforms, update().points, shape);
  }
  const AnchorFrame frame = live_anchor_frame(shape);
  const torch::Tensor rest =
      anchor_points_from_matrix(torch::eye(4, truth.options()).slice(0, 0, 3).unsqueeze(0), frame);
  // Where the whole lies is for find_frame() to say: the update puts slices where they belong among the others.
  std::vector<torch::Tensor> wanted;
  std::int64_t begin = 0;
  for (const std::int64_t n : lengths) {
    wanted.push_back(truth_as_placed(truth.narrow(0, begin, n), input.transforms.narrow(0, begin, n), frame));
    begin += n;
  }
  const torch::Tensor target =
      (anchor_points_from_matrix(compose_transforms(inverse_transform(input.transforms), torch::cat(wanted)), frame) -
       rest) /
      kLiveUpdateUnitMm;
  const LiveOutput said = update();
  const torch::Tensor points = smooth_l1_loss(said.points, target, options_.shared_beta);
  const torch::Tensor error = (said.points - target).detach().view({-1, 3, 3}).norm(2, 2).mean(1);
  StepLoss loss =
      sum_of({{"shared_points", 1., points},
              {"shared_scale", options_.scale_weight, scale_loss(error, said.log_scale)},
              {"shared_quality", options_.quality_weight,
               torch::binary_cross_entropy_with_logits(said.quality, good, {}, {}, torch::Reduction::None)}});
  // What doing nothing would cost: the shared network has learnt something once it is below.
  loss.parts["shared_start"] =
      smooth_l1_loss(torch::zeros_like(target), target, options_.shared_beta).mean().item<double>();
  return loss;
}

StepLoss LiveRecipe::frame_loss(const std::vector<SimulatedScan>& scans, std::uint64_t step) {
  // A scan is costly to make and a second frame is not.
  constexpr std::uint64_t kFramesPerScan = 2;
  const LiveNetworkOptions& shape = network_->options();
  const AnchorFrame frame = live_anchor_frame(shape);
  const torch::Tensor cells = live_frame_cells(shape);
  std::vector<torch::Tensor> volumes, targets;
  for (std::size_t i = 0; i < scans.size(); ++i) {
    const torch::Tensor truth = scans[i].truth.cpu();
    const torch::Tensor reduced = network_->reduce(scans[i].input.slices, scans[i].input.slice_resolution_mm);
    for (std::uint64_t k = 0; k < kFramesPerScan; ++k) {
      RandomStream random(seed_, (step * 64 + i) * kFramesPerScan + k, kFrameStart);
      // Most are small: this is how frames are voted, and what is left of them after a step.
      const double size = std::pow(random.uniform(), 2), off = std::pow(random.uniform(), 2);
      const torch::Tensor placed =
          perturbed(truth, random, size * options_.perturb_deg * kRadians, size * options_.perturb_mm);
      const torch::Tensor motion = axisangle_to_matrix(
          random_motion(random, off * options_.frame_deg * kRadians, off * options_.frame_mm).unsqueeze(0));
      const torch::Tensor moved = compose_transforms(motion.expand_as(placed), placed);
      volumes.push_back(live_volume(reduced, moved, shape, scans[i].input.thickness_mm, AcquisitionFormulation::fast));
      // Where the best frame would leave it: what is wrong among the slices is none of the frame's business.
      const Pose best =
          fit_most_planes(poses_from_tensor(moved), poses_from_tensor(truth), 0.5 * frame.width * frame.resolution);
      targets.push_back(transform_points(tensor_from_pose(best), cells.unsqueeze(0)).squeeze(0) - cells);
    }
  }
  const torch::Tensor seen = torch::stack(volumes).unsqueeze(1).to(scans.front().truth.device());
  const LiveFrameOutput said = network_->look_at_frames(seen);
  const torch::Tensor target = (torch::stack(targets) / kLiveUpdateUnitMm).to(seen.device());
  const torch::Tensor brain = brain_in_frame_cells(seen);
  const torch::Tensor share = brain / brain.mean().clamp_min(1e-6);
  const auto rows = [](const torch::Tensor& points) { return points.reshape({-1, 3}); };
  const torch::Tensor points = smooth_l1_loss(rows(said.movement), rows(target), options_.shared_beta);
  const torch::Tensor error = (said.movement - target).detach().norm(2, 2);
  StepLoss loss = sum_of({{"frame_cells", 1., points * share.flatten()},
                          {"frame_scale", options_.scale_weight, scale_loss(error, said.log_scale) * share}});
  // Mean distance of brain from where it belongs, in the same unit: as found, and after what the cells say together.
  const torch::Tensor moved =
      (transform_points(frame_motions(said, seen, shape), cells.expand({seen.size(0), -1, 3})) - cells) /
      kLiveUpdateUnitMm;
  loss.parts["frame_start"] = (target.norm(2, 2) * share).mean().item<double>();
  loss.parts["frame_left"] = ((target - moved.to(seen.device())).norm(2, 2) * share).mean().item<double>();
  return loss;
}

StepLoss AnchorRecipe::loss(const std::vector<SimulatedScan>& scans, std::uint64_t /*step*/) {
  const Batch batch = batch_of(scans);
  const NetworkInput& input = batch.input;
  const AnchorFrame frame = {static_cast<int>(input.slices.size(3)), static_cast<int>(input.slices.size(2)),
                             input.slice_resolution_mm};
  // In units of 50 mm, so that the loss is of order 1.
  return sum_of({{"points", 1.,
                  anchor_loss(network_->regress(input, batch.lengths) / kLiveUnitMm,
                              anchor_points_from_matrix(batch.truth, frame) / kLiveUnitMm)}});
}

PaperRecipe::PaperRecipe(std::shared_ptr<SvortV1> network, const PaperRecipeOptions& options, const NetworkGrid& grid,
                         torch::ScalarType precision)
    : network_(std::move(network)), options_(options), grid_(grid), precision_(precision) {
  const auto usable = [](double value) { return value >= 0. && std::isfinite(value); };
  if (!usable(options.point_weight)) throw std::invalid_argument("paper.point_weight must be zero or positive");
  if (!usable(options.volume_weight)) throw std::invalid_argument("paper.volume_weight must be zero or positive");
  if (!(options.volume_beta > 0. && std::isfinite(options.volume_beta)))
    throw std::invalid_argument("paper.volume_beta must be positive");
  network_->set_volume_gradient(options.volume_weight > 0.);
}

StepLoss PaperRecipe::loss(const std::vector<SimulatedScan>& scans, std::uint64_t /*step*/) {
  NetworkRun run;
  run.formulation = AcquisitionFormulation::fast;
  run.precision = precision_;
  torch::Tensor points, volume;
  double last = 0., start = 0.;
  const auto add = [](torch::Tensor* sum, const torch::Tensor& term) { *sum = sum->defined() ? *sum + term : term; };
  for (const SimulatedScan& scan : scans) {
    const NetworkInput& input = scan.input;
    const AnchorFrame frame = {static_cast<int>(input.slices.size(3)), static_cast<int>(input.slices.size(2)),
                               input.slice_resolution_mm};
    const torch::Tensor truth = anchor_points_from_matrix(scan.truth, frame);
    const double share = 1. / static_cast<double>(scans.size());
    torch::Tensor error;
    for (const NetworkStep& step : network_->run(input, grid_, run)) {
      error = anchor_loss(step.points, truth).mean() * share;
      add(&points, error);
      const torch::Tensor difference =
          smooth_l1_loss(step.volume.flatten().unsqueeze(0), scan.volume.flatten().unsqueeze(0), options_.volume_beta);
      add(&volume, difference.mean() * share);
    }
    last += error.item<double>();
    start += anchor_loss(anchor_points_from_matrix(input.transforms, frame), truth).mean().item<double>() * share;
  }
  StepLoss loss;
  loss.total = options_.point_weight * points + options_.volume_weight * volume;
  loss.parts = {{"points", points.item<double>()},
                {"volume", volume.item<double>()},
                {"last_points", last},
                {"start_points", start}};
  return loss;
}

}  // namespace svort
