#include "svort_ros/training/recipe.h"

#include <algorithm>
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
  kFrameStart = 106,
  kFrameBatch = 107
};

constexpr double kRadians = M_PI / 180.;
constexpr std::uint64_t kVolumesPerScan = 2;  // of the frame network's bank
// The bank in the trainer's state.
constexpr const char* kBankViews = "bank_views";
constexpr const char* kBankFrames = "bank_frames";
constexpr const char* kBanked = "banked";

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

void TrainingRecipe::remember(const std::map<std::string, torch::Tensor>& memory) {
  if (!memory.empty())
    throw std::runtime_error("holds '" + memory.begin()->first + "', which this recipe does not know");
}

torch::Tensor moved_as_one(const torch::Tensor& volumes, const torch::Tensor& motions, double half_width) {
  const torch::Tensor back = trans_first_to_last(inverse_transform(motions));  // where what lies at a place comes from
  const torch::Tensor theta = torch::cat({back.slice(2, 0, 3), back.slice(2, 3, 4) / half_width}, 2);
  return torch::grid_sampler(volumes, torch::affine_grid_generator(theta, volumes.sizes(), /*align_corners=*/false),
                             /*interpolation_mode=*/0, /*padding_mode=*/0, /*align_corners=*/false);
}

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
  require(options.frame_bank >= 1 && options.frame_bank <= 1000000, "frame_bank", "1 to 1000000");
  require(options.frame_batch >= 1 && options.frame_batch <= 65536, "frame_batch", "1 to 65536");
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
  return {"first_points",   "first_mirrored", "first_scale",  "first_quality", "shared_points", "shared_scale",
          "shared_quality", "shared_start",   "frame_points", "frame_start",   "frame_left"};
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

std::int64_t LiveRecipe::bank_rows() const { return std::min<std::int64_t>(banked_, options_.frame_bank); }

void LiveRecipe::make_bank(const torch::Device& device) {
  const std::int64_t rows = options_.frame_bank, side = network_->options().input_px / 2;
  bank_views_ = torch::zeros({rows, kLiveFrameChannels, side, side, side}, torch::device(device).dtype(torch::kHalf));
  bank_frames_ = torch::zeros({rows, 3, 4});
}

void LiveRecipe::put_into_bank(const SimulatedScan& scan, std::uint64_t first) {
  const LiveNetworkOptions& shape = network_->options();
  const AnchorFrame frame = live_anchor_frame(shape);
  const torch::Tensor truth = scan.truth.cpu();
  const torch::Tensor reduced = network_->reduce(scan.input.slices, scan.input.slice_resolution_mm);
  if (!bank_views_.defined()) make_bank(reduced.device());
  for (std::uint64_t k = 0; k < kVolumesPerScan; ++k) {
    RandomStream random(seed_, first + k, kFrameStart);
    // Most disturbances are small: the frame is looked for when the slices have been registered.
    const double size = std::pow(random.uniform(), 2);
    const torch::Tensor placed =
        perturbed(truth, random, size * options_.perturb_deg * kRadians, size * options_.perturb_mm);
    const torch::Tensor volume =
        live_volume(reduced, placed, shape, scan.input.thickness_mm, AcquisitionFormulation::fast);
    // Where the best frame would leave it: what is wrong among the slices is none of the frame's business.
    const Pose best =
        fit_most_planes(poses_from_tensor(placed), poses_from_tensor(truth), 0.5 * frame.width * frame.resolution);
    const std::int64_t row = banked_ % options_.frame_bank;
    bank_views_[row] = live_frame_view(volume.unsqueeze(0).unsqueeze(0))[0];
    bank_frames_[row] = tensor_from_pose(best)[0];
    ++banked_;
  }
}

std::map<std::string, torch::Tensor> LiveRecipe::memory() const {
  if (banked_ == 0) return {};
  return {{kBankViews, bank_views_.slice(0, 0, bank_rows())},
          {kBankFrames, bank_frames_.slice(0, 0, bank_rows())},
          {kBanked, torch::tensor({banked_}, torch::kInt64)}};
}

void LiveRecipe::remember(const std::map<std::string, torch::Tensor>& memory) {
  if (memory.empty()) return;
  for (const char* name : {kBankViews, kBankFrames, kBanked})
    if (memory.count(name) == 0)
      throw std::runtime_error(std::string("holds a bank of volumes without '") + name + "'");
  const torch::Tensor views = memory.at(kBankViews), frames = memory.at(kBankFrames);
  banked_ = memory.at(kBanked).item<std::int64_t>();
  make_bank(views.device());
  torch::Tensor bank_views = bank_views_.slice(0, 0, bank_rows()), bank_frames = bank_frames_.slice(0, 0, bank_rows());
  if (views.sizes() != bank_views.sizes() || frames.sizes() != bank_frames.sizes())
    throw std::runtime_error("holds a bank of " + std::to_string(views.size(0)) +
                             " volumes that does not fit recipe.frame_bank " + std::to_string(options_.frame_bank) +
                             " and network.input_px " + std::to_string(network_->options().input_px));
  bank_views.copy_(views);
  bank_frames.copy_(frames);
}

StepLoss LiveRecipe::frame_loss(const std::vector<SimulatedScan>& scans, std::uint64_t step) {
  for (std::size_t i = 0; i < scans.size(); ++i) put_into_bank(scans[i], (step * 1024 + i) * kVolumesPerScan);
  const LiveNetworkOptions& shape = network_->options();
  RandomStream random(seed_, step, kFrameBatch);
  std::vector<std::int64_t> drawn;
  std::vector<torch::Tensor> moves;
  for (int k = 0; k < options_.frame_batch; ++k) {
    drawn.push_back(random.integer(0, static_cast<int>(bank_rows()) - 1));
    // Most are small: this is how frames are voted, and what is left of them after a step.
    const double off = std::pow(random.uniform(), 2);
    moves.push_back(random_motion(random, off * options_.frame_deg * kRadians, off * options_.frame_mm));
  }
  const torch::Tensor motions = axisangle_to_matrix(torch::stack(moves)), index = torch::tensor(drawn);
  const torch::Device device = bank_views_.device();
  const torch::Tensor seen = moved_as_one(bank_views_.index_select(0, index.to(device)).to(torch::kFloat32),
                                          motions.to(device), 0.5 * shape.input_px * shape.input_resolution_mm);
  const torch::Tensor points = live_frame_points().expand({options_.frame_batch, -1, -1});
  const torch::Tensor back = compose_transforms(bank_frames_.index_select(0, index), inverse_transform(motions));
  const torch::Tensor target = (transform_points(back, points) - points) / kLiveUpdateUnitMm;
  const torch::Tensor said = network_->look_at_frames(seen);
  const auto rows = [](const torch::Tensor& values) { return values.reshape({-1, 3}); };
  StepLoss loss =
      sum_of({{"frame_points", 1., smooth_l1_loss(rows(said), rows(target.to(seen.device())), options_.shared_beta)}});
  // Mean distance of the points from where they belong, in the same unit: as found, and after what they say together.
  const torch::Tensor moved = (transform_points(frame_motions(said), points) - points) / kLiveUpdateUnitMm;
  loss.parts["frame_start"] = target.norm(2, 2).mean().item<double>();
  loss.parts["frame_left"] = (target - moved).norm(2, 2).mean().item<double>();
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
