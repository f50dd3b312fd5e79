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
enum Purpose : std::uint64_t { kWhichNetwork = 101, kWhichIteration = 102, kWarmStart = 103, kPullsUnknown = 104 };

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
  return {"first_points",  "first_mirrored", "first_scale",    "first_quality",
          "shared_points", "shared_scale",   "shared_quality", "shared_start"};
}

StepLoss LiveRecipe::loss(const std::vector<SimulatedScan>& scans, std::uint64_t step) {
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
    const double walk_rotation = size * options_.perturb_deg * kRadians, walk_mm = size * options_.perturb_mm;
    torch::Tensor walk = random_motion(random, walk_rotation, walk_mm), motions = torch::empty({n, 6});
    constexpr double kMemory = 0.9, kOwn = 0.3;
    for (std::int64_t i = 0; i < n; ++i) {
      walk = kMemory * walk + std::sqrt(1. - kMemory * kMemory) * random_motion(random, walk_rotation, walk_mm);
      motions[i] = walk + kOwn * random_motion(random, walk_rotation, walk_mm);
    }
    start = compose_transforms(scan.truth.cpu(), axisangle_to_matrix(motions));
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
