#include "svort_ros/network/live_network.h"

#include <torch/nn/init.h>

#include <algorithm>
#include <cmath>
#include <limits>
#include <numeric>
#include <stdexcept>
#include <string>

#include "../registration/rotation_grid.h"
#include "svort_ros/acquisition/point_spread_function.h"
#include "svort_ros/geometry/anchor_points.h"
#include "svort_ros/geometry/rigid_fit.h"
#include "svort_ros/geometry/rigid_transform.h"
#include "svort_ros/reconstruction/volume_estimation.h"

namespace svort {
namespace {

namespace nn = torch::nn;

constexpr int kNormGroups = 8;
constexpr int kStages = 3;
constexpr int kCoordinates = 2;
constexpr int kStemKernel = 6;
constexpr std::int64_t kFrameCell = 4;  // pixels: voxels of the perceptron's input
constexpr float kFramePointMm = 25.F;   // from the middle, along each axis

void require(bool condition, const std::string& message) {
  if (!condition) throw std::invalid_argument("LiveNetwork: " + message);
}

// The padding is convolve()'s.
nn::Conv2d convolution(std::int64_t in, std::int64_t out, int kernel, int stride) {
  return nn::Conv2d(nn::Conv2dOptions(in, out, kernel).stride(stride).bias(false));
}

nn::GroupNorm group_norm(std::int64_t channels) { return nn::GroupNorm(nn::GroupNormOptions(kNormGroups, channels)); }

// The modules keep float32 parameters; in bfloat16 they are rounded on the fly, so gradients reach the float32 ones.
torch::Tensor convolve(const nn::Conv2d& module, const torch::Tensor& x) {
  // So that the output has size / stride pixels: half a kernel, less for the stem, whose stride is almost its kernel.
  const std::int64_t kernel = module->options.kernel_size()->at(0);
  const std::int64_t padding = kernel == kStemKernel ? 1 : kernel / 2;
  return torch::conv2d(x, module->weight.to(x.scalar_type()), {}, module->options.stride(), padding);
}

torch::Tensor normalise(const nn::GroupNorm& module, const torch::Tensor& x) {
  return torch::group_norm(x, kNormGroups, module->weight.to(x.scalar_type()), module->bias.to(x.scalar_type()));
}

// Wavelengths of the positional embedding, in the quantity's own unit, octaves.
struct Waves {
  double longest;
  int octaves;
};
constexpr Waves kPointWaves = {400., 6};  // mm
constexpr Waves kIndexWaves = {64., 6};   // slices
constexpr Waves kStackWaves = {16., 4};   // stacks
constexpr Waves kCountWaves = {128., 4};  // slices
constexpr Waves kTimeWaves = {1024., 8};  // s

// n x d -> n x 2 d octaves: sine and cosine of every value at every wavelength
torch::Tensor sinusoids(const torch::Tensor& values, const Waves& waves) {
  const torch::Tensor octave = torch::arange(waves.octaves, values.options());
  const torch::Tensor frequency = torch::pow(2., octave) * (2. * M_PI / waves.longest);
  const torch::Tensor phase = values.unsqueeze(-1) * frequency;
  return torch::cat({phase.sin(), phase.cos()}, -1).flatten(1);
}

// Weights of staying, and of each pull.
constexpr std::int64_t kGates = kLivePulls + 1;
// What a slice hears of its pulls: movements, correlations, and whether they are known.
constexpr std::int64_t kPullsLength = 9 * kLivePulls + (kLivePulls + 1) + 1;
constexpr double kLargestPull = 4.;  // kLiveUpdateUnitMm: further ones all look the same

constexpr int kPositionLength = 2 * (9 * kPointWaves.octaves + kIndexWaves.octaves + kStackWaves.octaves +
                                     kCountWaves.octaves + kTimeWaves.octaves) +
                                1;

}  // namespace

// ---------------------------------------------------------------------------------------------------------- encoder

LiveEncoderImpl::LiveEncoderImpl(const LiveNetworkOptions& options, int channels) {
  // A stem that leaves a quarter of the pixels along each side: 8 mm cells, the size of what tells slices apart.
  stem_ = register_module("stem", convolution(channels, options.width, kStemKernel, 4));
  stem_norm_ = register_module("stem_norm", group_norm(options.width));
  std::int64_t in = options.width;
  for (int stage = 0; stage < kStages; ++stage) {
    const std::int64_t out = std::int64_t{options.width} << stage;
    for (int index = 0; index < options.blocks; ++index) {
      const int stride = stage > 0 && index == 0 ? 2 : 1;
      const std::string name = "stage" + std::to_string(stage) + "_block" + std::to_string(index) + "_";
      Block block;
      block.first = register_module(name + "first", convolution(in, out, 3, stride));
      block.first_norm = register_module(name + "first_norm", group_norm(out));
      block.second = register_module(name + "second", convolution(out, out, 3, 1));
      block.second_norm = register_module(name + "second_norm", group_norm(out));
      nn::init::zeros_(block.second_norm->weight);  // every block starts as the identity
      if (stride != 1 || in != out)
        block.shortcut = register_module(name + "shortcut", convolution(in, out, 1, stride));
      blocks_.push_back(block);
      in = out;
    }
  }
  const std::int64_t cells = options.input_px >> (kStages + 1);
  out_ = register_module("out", nn::Linear(in * cells * cells, options.dim));
}

torch::Tensor LiveEncoderImpl::forward(const torch::Tensor& images, torch::ScalarType precision) {
  torch::Tensor x = torch::relu(normalise(stem_norm_, convolve(stem_, images.to(precision))));
  for (const Block& block : blocks_) {
    torch::Tensor y = torch::relu(normalise(block.first_norm, convolve(block.first, x)));
    y = normalise(block.second_norm, convolve(block.second, y));
    x = torch::relu(y + (block.shortcut ? convolve(block.shortcut, x) : x));
  }
  return out_(x.flatten(1).to(torch::kFloat32));
}

// ---------------------------------------------------------------------------------------------------- frame network

LiveFrameNetworkImpl::LiveFrameNetworkImpl(const LiveNetworkOptions& options) {
  const std::int64_t side = options.input_px / kFrameCell, width = options.frame_width;
  first_ = register_module("first", nn::Linear(kLiveFrameChannels * side * side * side, width));
  second_ = register_module("second", nn::Linear(width, width));
  out_ = register_module("out", nn::Linear(width, 3 * kLiveFramePoints));
  nn::init::zeros_(out_->weight);  // it starts by leaving the frame as it is
  nn::init::zeros_(out_->bias);
}

torch::Tensor LiveFrameNetworkImpl::forward(const torch::Tensor& views) {
  const torch::Tensor seen = torch::avg_pool3d(views, {2, 2, 2}).flatten(1);
  const torch::Tensor said = out_(torch::relu(second_(torch::relu(first_(seen)))));
  const torch::Tensor brain = views.select(1, 1).flatten(1).any(1, /*keepdim=*/true).to(torch::kFloat32);
  return (said * brain).view({-1, kLiveFramePoints, 3});
}

// ------------------------------------------------------------------------------------------------------ Transformer

LiveTransformerImpl::LiveTransformerImpl(const LiveNetworkOptions& options) : heads_(options.heads) {
  const std::int64_t dim = options.dim;
  for (int index = 0; index < options.layers; ++index) {
    const std::string name = "layer" + std::to_string(index) + "_";
    const auto norm = [&] { return nn::LayerNorm(nn::LayerNormOptions({dim})); };
    Layer layer;
    layer.attention_norm = register_module(name + "attention_norm", norm());
    layer.qkv = register_module(name + "qkv", nn::Linear(dim, 3 * dim));
    layer.attention_out = register_module(name + "attention_out", nn::Linear(dim, dim));
    layer.feed_forward_norm = register_module(name + "feed_forward_norm", norm());
    layer.hidden = register_module(name + "hidden", nn::Linear(dim, options.hidden));
    layer.out = register_module(name + "out", nn::Linear(options.hidden, dim));
    layers_.push_back(layer);
  }
  norm_ = register_module("norm", nn::LayerNorm(nn::LayerNormOptions({dim})));
}

torch::Tensor LiveTransformerImpl::forward(const torch::Tensor& tokens, const torch::Tensor& mask,
                                           std::vector<torch::Tensor>* attention) {
  const std::int64_t batch = tokens.size(0), length = tokens.size(1), dim = tokens.size(2);
  torch::Tensor closed;  // b x 1 x 1 x l, where attention must not look
  if (mask.defined()) closed = mask.logical_not().view({batch, 1, 1, length});
  torch::Tensor x = tokens;
  for (Layer& layer : layers_) {
    const auto qkv = layer.qkv(layer.attention_norm(x))
                         .view({batch, length, 3, heads_, dim / heads_})
                         .permute({2, 0, 3, 1, 4})
                         .unbind(0);
    torch::Tensor score = torch::matmul(qkv[0], qkv[1].transpose(-2, -1)) /
                          std::sqrt(static_cast<double>(dim) / static_cast<double>(heads_));
    if (closed.defined()) score = score.masked_fill(closed, -std::numeric_limits<float>::infinity());
    const torch::Tensor look = score.softmax(-1);
    if (attention != nullptr) attention->push_back(look.detach());
    x = x + layer.attention_out(torch::matmul(look, qkv[2]).transpose(1, 2).reshape({batch, length, dim}));
    x = x + layer.out(torch::gelu(layer.hidden(layer.feed_forward_norm(x))));
  }
  return norm_(x);
}

// ---------------------------------------------------------------------------------------------------------- network

LiveNetwork::LiveNetwork(const LiveNetworkOptions& options) : PoseNetwork("live"), options_(options) {
  const auto& o = options_;
  require(o.input_px >= 16 && o.input_px <= 256 && o.input_px % 16 == 0,
          "input_px is " + std::to_string(o.input_px) + "; it must be a multiple of 16 from 16 to 256");
  require(o.input_resolution_mm >= 0.25 && o.input_resolution_mm <= 16., "input_resolution_mm must be 0.25 to 16 mm");
  require(o.width >= kNormGroups && o.width % kNormGroups == 0 && o.width <= 512,
          "width is " + std::to_string(o.width) + "; it must be a multiple of 8 up to 512");
  require(o.blocks >= 1 && o.blocks <= 16, "blocks must be 1 to 16");
  require(o.heads >= 1 && o.dim >= o.heads && o.dim % o.heads == 0 && o.dim <= 4096,
          "dim is " + std::to_string(o.dim) + "; it must be a multiple of heads, which is " + std::to_string(o.heads));
  require(o.layers >= 1 && o.layers <= 48, "layers must be 1 to 48");
  require(o.hidden >= 1 && o.hidden <= 16384, "hidden must be 1 to 16384");
  require(o.frame_width >= 0 && o.frame_width <= 4096, "frame_width must be 0 to 4096");
  require(o.frame_steps >= 0 && o.frame_steps <= 100, "frame_steps must be 0 to 100");
  require(o.iterations >= 1 && o.iterations <= 100, "iterations must be 1 to 100");

  const int first_channels = 1 + kCoordinates;
  const int shared_channels = 1 + kLiveSimulatedChannels + kCoordinates;
  const int heads_of_first = 9 + 9 + 2, heads_of_shared = 9 + kGates + 2;
  first_encoder_ = register_module("first_encoder", LiveEncoder(o, first_channels));
  first_transformer_ = register_module("first_transformer", LiveTransformer(o));
  first_head_ = register_module("first_head", nn::Linear(o.dim, heads_of_first));
  shared_encoder_ = register_module("shared_encoder", LiveEncoder(o, shared_channels));
  shared_transformer_ = register_module("shared_transformer", LiveTransformer(o));
  shared_head_ = register_module("shared_head", nn::Linear(o.dim, heads_of_shared));
  if (o.positional_embedding) {
    first_position_ = register_module("first_position", nn::Linear(kPositionLength, o.dim));
    shared_position_ = register_module("shared_position", nn::Linear(kPositionLength, o.dim));
  }
  if (o.pulls) shared_pulls_ = register_module("shared_pulls", nn::Linear(kPullsLength, o.dim));
  if (o.frame_width > 0) frame_network_ = register_module("frame_network", LiveFrameNetwork(o));
  // The shared network starts by going where the last level of registration does, or, without pulls, by staying.
  nn::init::zeros_(shared_head_->weight);
  nn::init::zeros_(shared_head_->bias);
  const torch::NoGradGuard no_grad;
  constexpr float kAlmostAll = 4.F;
  shared_head_->bias[9 + kGates - 1].fill_(kAlmostAll);
}

torch::Tensor LiveNetwork::reduce(const torch::Tensor& slices, double resolution_mm) const {
  require(slices.defined() && slices.dim() == 4 && slices.size(1) == 1, "slices must be n x 1 x h x w");
  const auto factor = static_cast<std::int64_t>(std::lround(options_.input_resolution_mm / resolution_mm));
  const bool fits = factor >= 1 &&
                    std::abs(static_cast<double>(factor) * resolution_mm / options_.input_resolution_mm - 1.) < 1e-6 &&
                    slices.size(2) == factor * options_.input_px && slices.size(3) == factor * options_.input_px;
  require(fits, "slices of " + std::to_string(slices.size(3)) + " x " + std::to_string(slices.size(2)) + " pixels of " +
                    std::to_string(resolution_mm) + " mm cannot be averaged to " + std::to_string(options_.input_px) +
                    " x " + std::to_string(options_.input_px) + " of " + std::to_string(options_.input_resolution_mm) +
                    " mm");
  return factor == 1 ? slices : torch::avg_pool2d(slices, {factor, factor});
}

torch::Tensor LiveNetwork::with_coordinates(const torch::Tensor& images) const {
  const std::int64_t n = images.size(0), size = options_.input_px;
  const torch::Tensor axis = torch::linspace(-1., 1., size, images.options());
  const torch::Tensor x = axis.view({1, 1, 1, size}).expand({n, 1, size, size});
  const torch::Tensor y = axis.view({1, 1, size, 1}).expand({n, 1, size, size});
  return torch::cat({images, x, y}, 1);
}

namespace {

void require_features(const torch::Tensor& features, std::int64_t dim, const NetworkInput& input) {
  require(features.defined() && features.dim() == 2 && features.size(1) == dim &&
              features.size(0) == input.transforms.size(0),
          "features must be n x " + std::to_string(dim) + ", one row per slice");
}

// Mean intensity of the brain to 1, slice by slice, for the slice and whatever belongs to it; n x c x p x p, or, volume
// by volume, n x 1 x d x d x d.
torch::Tensor normalised(const torch::Tensor& images) {
  const torch::Tensor slice = images.slice(1, 0, 1);
  std::vector<std::int64_t> all(static_cast<std::size_t>(images.dim()) - 1);
  std::iota(all.begin(), all.end(), 1);
  const torch::Tensor count = (slice > 0).sum(all, /*keepdim=*/true).clamp_min(1);
  const torch::Tensor mean = slice.sum(all, /*keepdim=*/true) / count;
  return images / mean.clamp_min(1e-6);
}

}  // namespace

torch::Tensor LiveNetwork::encode(const torch::Tensor& slices, double resolution_mm) {
  return first_encoder_->forward(with_coordinates(normalised(reduce(slices, resolution_mm))), precision_);
}

torch::Tensor LiveNetwork::embed(const NetworkInput& input, bool first) const {
  const torch::Tensor points = anchor_points_from_matrix(input.transforms, live_anchor_frame(options_));
  const torch::Tensor counts = input.slice_counts.to(points.options()).unsqueeze(1);
  const torch::Tensor index = input.positions.slice(1, 0, 1).to(points.options());
  const torch::Tensor position = torch::cat(
      {sinusoids(points, kPointWaves), sinusoids(index, kIndexWaves),
       sinusoids(input.positions.slice(1, 1, 2).to(points.options()), kStackWaves), sinusoids(counts, kCountWaves),
       sinusoids(input.times.to(points.options()).unsqueeze(1), kTimeWaves), index / counts.clamp_min(1)},
      1);
  nn::Linear linear = first ? first_position_ : shared_position_;
  return linear(position);
}

torch::Tensor LiveNetwork::speak(LiveTransformer& transformer, nn::Linear& head, const torch::Tensor& tokens,
                                 const std::vector<std::int64_t>& lengths, std::vector<torch::Tensor>* attention) {
  const std::int64_t n = tokens.size(0), dim = tokens.size(1);
  if (lengths.size() <= 1) {
    require(lengths.empty() || lengths.front() == n, "lengths do not add up to the number of slices");
    return head(transformer->forward(tokens.unsqueeze(0), {}, attention)).squeeze(0);
  }
  const std::int64_t longest = *std::max_element(lengths.begin(), lengths.end());
  std::vector<std::int64_t> place;  // of each slice in the padded batch
  for (std::size_t scan = 0; scan < lengths.size(); ++scan) {
    for (std::int64_t i = 0; i < lengths[scan]; ++i) place.push_back(static_cast<std::int64_t>(scan) * longest + i);
  }
  require(static_cast<std::int64_t>(place.size()) == n, "lengths do not add up to the number of slices");
  const auto scans = static_cast<std::int64_t>(lengths.size());
  const torch::Tensor index = torch::tensor(place, torch::kInt64).to(tokens.device());
  const torch::Tensor padded = torch::zeros({scans * longest, dim}, tokens.options()).index_copy(0, index, tokens);
  const torch::Tensor mask =
      torch::zeros({scans * longest}, tokens.options().dtype(torch::kBool)).index_fill(0, index, true);
  const torch::Tensor result =
      transformer->forward(padded.view({scans, longest, dim}), mask.view({scans, longest}), attention);
  return head(result.reshape({scans * longest, dim}).index_select(0, index));
}

LiveOutput LiveNetwork::attend(const torch::Tensor& features, const NetworkInput& input,
                               const std::vector<std::int64_t>& lengths, std::vector<torch::Tensor>* attention) {
  require_features(features, options_.dim, input);
  const torch::Tensor tokens = options_.positional_embedding ? features + embed(input, true) : features;
  const torch::Tensor said = speak(first_transformer_, first_head_, tokens, lengths, attention);
  return {said.slice(1, 0, 9), said.slice(1, 9, 18), said.select(1, 18), said.select(1, 19)};
}

PoseVotes LiveNetwork::vote(const torch::Tensor& features, const NetworkInput& input,
                            std::vector<torch::Tensor>* attention) {
  const torch::NoGradGuard no_grad;
  require_features(features, options_.dim, input);
  const std::int64_t n = features.size(0);
  const int views = options_.consensus.views;
  require(views >= 1 && views <= 100, "consensus.views must be 1 to 100");
  const auto repeated = [views](const torch::Tensor& tensor) {
    return torch::cat(std::vector<torch::Tensor>(static_cast<std::size_t>(views), tensor));
  };
  NetworkInput shown = input;
  shown.slices = torch::Tensor();
  shown.positions = repeated(input.positions);
  shown.slice_counts = repeated(input.slice_counts);
  shown.times = repeated(input.times);
  std::vector<torch::Tensor> turned = {input.transforms};
  if (views > 1) {
    for (const Eigen::Quaterniond& rotation : spread_rotations(views - 1)) {
      const torch::Tensor turn = tensor_from_pose(Pose(rotation)).to(input.transforms.device());
      turned.push_back(compose_transforms(turn.expand({n, 3, 4}), input.transforms));
    }
  }
  shown.transforms = torch::cat(turned);
  std::vector<torch::Tensor> looks;
  const LiveOutput said =
      attend(repeated(features), shown, std::vector<std::int64_t>(static_cast<std::size_t>(views), n),
             attention != nullptr ? &looks : nullptr);
  for (const torch::Tensor& look : looks) attention->push_back(look.slice(0, 0, 1));
  PoseVotes votes = live_votes(said, shown, options_);
  votes.nominal = repeated(input.transforms.detach().cpu());  // as they lie, not as they were shown
  return votes;
}

torch::Tensor LiveNetwork::place(const torch::Tensor& features, const NetworkInput& input,
                                 std::vector<torch::Tensor>* attention) {
  const PoseVotes votes = vote(features, input, attention);
  const torch::Tensor still = pose_consensus(votes, options_.consensus).slice(0, 0, features.size(0));
  const torch::Tensor moving = trajectory_consensus(votes, still, options_.consensus);
  return compose_transforms(moving.to(input.transforms.device()), input.transforms);
}

torch::Tensor LiveNetwork::look_at_frames(const torch::Tensor& views) {
  if (!frame_network_) throw std::logic_error("LiveNetwork: it has no frame network (frame_width is 0)");
  const std::int64_t side = options_.input_px / 2;
  require(views.defined() && views.dim() == 5 && views.size(1) == kLiveFrameChannels && views.size(2) == side &&
              views.size(3) == side && views.size(4) == side,
          "views must be b x 2 x d x d x d with d = " + std::to_string(side));
  return frame_network_->forward(views);
}

LiveFrame LiveNetwork::find_frame(const torch::Tensor& features, const torch::Tensor& reduced,
                                  const NetworkInput& placed) {
  const torch::NoGradGuard no_grad;
  NetworkInput input = placed;
  input.common_frame = true;
  const PoseVotes votes = vote(features, input);
  const torch::Tensor motions = pose_consensus(votes, options_.consensus);
  LiveFrame frame = {motions.slice(0, 0, 1).clone(), vote_agreement(votes, motions, options_.consensus)};
  if (!frame_network_) return frame;
  const torch::Device device = placed.transforms.device();
  for (int step = 0; step < options_.frame_steps; ++step) {
    const torch::Tensor now =
        compose_transforms(frame.motion.to(device).expand_as(placed.transforms), placed.transforms);
    const torch::Tensor volume = live_volume(reduced, now, options_, placed.thickness_mm, AcquisitionFormulation::fast);
    const torch::Tensor view = live_frame_view(volume.unsqueeze(0).unsqueeze(0));
    frame.motion = compose_transforms(frame_motions(look_at_frames(view)), frame.motion);
  }
  return frame;
}

torch::Tensor LiveNetwork::encode_placed(const torch::Tensor& reduced, const torch::Tensor& simulated) {
  return shared_encoder_->forward(with_coordinates(normalised(torch::cat({reduced, simulated}, 1))), precision_);
}

LiveOutput LiveNetwork::attend_placed(const torch::Tensor& features, const LivePulls& pulls, const NetworkInput& input,
                                      const std::vector<std::int64_t>& lengths, std::vector<torch::Tensor>* attention) {
  require_features(features, options_.dim, input);
  torch::Tensor tokens = options_.positional_embedding ? features + embed(input, false) : features;
  const bool pulled = options_.pulls && pulls.points.defined();
  if (options_.pulls) {
    torch::Tensor heard = torch::zeros({features.size(0), kPullsLength}, features.options());
    if (pulled) {
      heard = torch::cat({pulls.points.flatten(1).clamp(-kLargestPull, kLargestPull), pulls.correlation,
                          torch::ones({features.size(0), 1}, features.options())},
                         1);
    }
    tokens = tokens + shared_pulls_(heard);
  }
  const torch::Tensor said = speak(shared_transformer_, shared_head_, tokens, lengths, attention);
  LiveOutput output;
  output.points = said.slice(1, 0, 9);
  if (pulled) {
    const torch::Tensor share = said.slice(1, 9, 9 + kGates).softmax(1).slice(1, 1, kGates);  // the first gate: stay
    output.points = output.points + (share.unsqueeze(2) * pulls.points).sum(1);
  }
  output.log_scale = said.select(1, 9 + kGates);
  output.quality = said.select(1, 9 + kGates + 1);
  return output;
}

LiveOutput LiveNetwork::update(const torch::Tensor& simulated, const LivePulls& pulls, const NetworkInput& input,
                               const std::vector<std::int64_t>& lengths, std::vector<torch::Tensor>* attention) {
  return attend_placed(encode_placed(reduce(input.slices, input.slice_resolution_mm), simulated), pulls, input, lengths,
                       attention);
}

std::vector<NetworkStep> LiveNetwork::run(const NetworkInput& input, const NetworkGrid& grid, const NetworkRun& run) {
  require(run.iterations >= 0, "iterations must not be negative");
  const torch::NoGradGuard no_grad;
  const int iterations = run.iterations > 0 ? run.iterations : options_.iterations;
  const AnchorFrame frame = {static_cast<int>(input.slices.size(3)), static_cast<int>(input.slices.size(2)),
                             input.slice_resolution_mm};
  const torch::Tensor reduced = reduce(input.slices, input.slice_resolution_mm);
  const torch::Tensor features = encode(input.slices, input.slice_resolution_mm);
  NetworkInput current = input;
  std::vector<NetworkStep> steps;
  for (int k = 0; k < iterations; ++k) {
    std::vector<torch::Tensor> attention;
    NetworkStep step;
    if (k == 0) {
      current.transforms = place(features, input, &attention);
      step.weights = torch::sigmoid(attend(features, input).quality);
    } else {
      // Ablation "w/o Vol": the later iterations see the slice alone.
      const torch::Tensor simulated =
          options_.volume_conditioned
              ? simulate_live_channels(reduced, current.transforms, options_, input.thickness_mm, run.formulation)
              : torch::zeros({reduced.size(0), kLiveSimulatedChannels, reduced.size(2), reduced.size(3)},
                             reduced.options());
      LivePulls pulls;
      if (options_.pulls && options_.volume_conditioned) pulls = pull_live_slices(reduced, current, options_);
      const LiveOutput said = update(simulated, pulls, current, {}, &attention);
      current.transforms = apply_live_update(current.transforms, said.points, options_);
      const torch::Tensor motion = find_frame(features, reduced, current).motion.to(current.transforms.device());
      current.transforms = compose_transforms(motion.expand_as(current.transforms), current.transforms);
      step.weights = torch::sigmoid(said.quality);
    }
    step.transforms = current.transforms;
    step.points = anchor_points_from_matrix(current.transforms, frame);
    step.attention = attention.back().squeeze(0);
    steps.push_back(step);
  }

  // Earlier volumes are only what the network looks at, on a grid of its own; the last one is the result.
  const double resolution = grid.resolution_mm;
  AcquisitionGeometry geometry;
  geometry.transforms = change_resolution(current.transforms, 1., resolution).cpu();
  geometry.psf = gaussian_psf({input.slice_resolution_mm / resolution, input.slice_resolution_mm / resolution,
                               input.thickness_mm / resolution});
  geometry.resolution_ratio = input.slice_resolution_mm / resolution;
  AcquisitionMasks masks;
  const torch::Tensor slices = input.slices.cpu().contiguous();
  masks.slices = slices > 0;
  const SliceAcquisition acquisition(geometry, frame.height, frame.width, grid.volume_shape, run.formulation, masks);
  ConjugateGradientOptions solver;
  steps.back().volume = solve_weighted_inverse(slices, acquisition, steps.back().weights.cpu(),
                                               reconstruct_psf(slices, acquisition), solver)
                            .to(input.slices.device());
  return steps;
}

// ---------------------------------------------------------------------------------------------------- free functions

AnchorFrame live_anchor_frame(const LiveNetworkOptions& options) {
  return {options.input_px, options.input_px, options.input_resolution_mm};
}

PoseVotes live_votes(const LiveOutput& output, const NetworkInput& input, const LiveNetworkOptions& options) {
  PoseVotes votes;
  votes.nominal = input.transforms.detach().cpu();
  votes.direct = output.points.detach().cpu() * kLiveUnitMm;
  votes.mirrored = output.mirrored.detach().cpu() * kLiveUnitMm;
  votes.scale = output.log_scale.detach().cpu().clamp(-5., 5.).exp() * kLiveUnitMm;
  votes.stack = input.positions.select(1, 1).detach().cpu().round().to(torch::kInt64);
  votes.frame = live_anchor_frame(options);
  votes.common_frame = input.common_frame;
  return votes;
}

namespace {

AcquisitionGeometry live_geometry(const torch::Tensor& transforms, const LiveNetworkOptions& options,
                                  double thickness_mm) {
  const double voxel = options.input_resolution_mm;
  AcquisitionGeometry geometry;
  geometry.psf = gaussian_psf({1., 1., thickness_mm / voxel});
  geometry.transforms = change_resolution(transforms.detach().cpu(), 1., voxel);
  return geometry;
}

/// The volume, made of the slices if there is none, seen from the slices' places.
torch::Tensor look(const torch::Tensor& reduced, const AcquisitionGeometry& geometry, const torch::Tensor& given,
                   std::int64_t size, double voxel_mm, AcquisitionFormulation formulation) {
  const torch::NoGradGuard no_grad;
  const torch::Tensor slices = reduced.cpu().contiguous();
  AcquisitionMasks masks;
  masks.slices = slices > 0;
  const auto acquisition_at = [&](double shift_mm) {
    // trans_first: the translation is along the slice's own axes
    AcquisitionGeometry shifted = geometry;
    shifted.transforms = geometry.transforms.clone();
    shifted.transforms.select(1, 2).select(1, 3) += shift_mm / voxel_mm;
    return SliceAcquisition(shifted, static_cast<int>(slices.size(2)), static_cast<int>(slices.size(3)),
                            {size, size, size}, formulation, masks);
  };
  const SliceAcquisition here = acquisition_at(0.);
  const torch::Tensor volume = given.defined() ? given : reconstruct_psf(slices, here);
  const torch::Tensor slope =
      acquisition_at(kLiveNormalStepMm).forward(volume) - acquisition_at(-kLiveNormalStepMm).forward(volume);
  return torch::cat({here.forward(volume), slope}, 1).to(reduced.device());
}

}  // namespace

torch::Tensor simulate_live_channels(const torch::Tensor& reduced, const torch::Tensor& transforms,
                                     const LiveNetworkOptions& options, double thickness_mm,
                                     AcquisitionFormulation formulation) {
  return look(reduced, live_geometry(transforms, options, thickness_mm), {}, options.input_px,
              options.input_resolution_mm, formulation);
}

torch::Tensor live_volume(const torch::Tensor& reduced, const torch::Tensor& transforms,
                          const LiveNetworkOptions& options, double thickness_mm, AcquisitionFormulation formulation) {
  const torch::NoGradGuard no_grad;
  const torch::Tensor slices = reduced.cpu().contiguous();
  AcquisitionMasks masks;
  masks.slices = slices > 0;
  const std::int64_t p = options.input_px;
  const SliceAcquisition acquisition(live_geometry(transforms, options, thickness_mm), static_cast<int>(p),
                                     static_cast<int>(p), {p, p, p}, formulation, masks);
  return reconstruct_psf(slices, acquisition).to(reduced.device());
}

torch::Tensor simulate_live_channels(const torch::Tensor& reduced, const AcquisitionGeometry& geometry,
                                     const torch::Tensor& volume, double voxel_mm, AcquisitionFormulation formulation) {
  require(volume.defined() && volume.dim() == 3, "the volume must be d x d x d");
  return look(reduced, geometry, volume, volume.size(0), voxel_mm, formulation);
}

torch::Tensor live_frame_points() {
  const torch::Tensor axis = torch::tensor({-kFramePointMm, kFramePointMm});
  return torch::cartesian_prod({axis, axis, axis});
}

torch::Tensor live_frame_view(const torch::Tensor& volumes) {
  const torch::Tensor brain = (volumes > 0).to(torch::kFloat32);
  return torch::avg_pool3d(torch::cat({normalised(volumes) - brain, brain}, 1), {2, 2, 2});
}

torch::Tensor frame_motions(const torch::Tensor& movement) {
  const torch::Tensor points = live_frame_points();
  const torch::Tensor targets = points + movement.detach().cpu() * kLiveUpdateUnitMm;
  const auto columns = [](const torch::Tensor& rows) {  // p x 3 -> 3 x p
    const torch::Tensor values = rows.to(torch::kFloat64).contiguous();
    return Eigen::Matrix3Xd(Eigen::Map<const Eigen::Matrix3Xd>(values.data_ptr<double>(), 3, values.size(0)));
  };
  std::vector<Pose> motions;
  for (std::int64_t i = 0; i < movement.size(0); ++i)
    motions.push_back(fit_points(columns(points), columns(targets[i])));
  return tensor_from_poses(motions);
}

LivePulls pull_live_slices(const torch::Tensor& reduced, const NetworkInput& input, const LiveNetworkOptions& options) {
  const torch::NoGradGuard no_grad;
  const torch::Device device = input.transforms.device();
  const auto n = static_cast<std::size_t>(input.transforms.size(0));
  require(reduced.dim() == 4 && reduced.size(0) == input.transforms.size(0), "there must be as many slices as poses");
  RegistrationInput scan;
  scan.slices = reduced.detach().cpu().contiguous();
  scan.masks = scan.slices > 0;
  scan.resolution_mm = options.input_resolution_mm;
  scan.thickness_mm.assign(n, input.thickness_mm);
  const torch::Tensor transforms = input.transforms.detach().cpu();
  const torch::Tensor stacks = input.positions.select(1, 1).cpu().round(), times = input.times.cpu();
  scan.T_world_slice = poses_from_tensor(transforms);
  for (std::size_t i = 0; i < n; ++i) {
    const auto row = static_cast<std::int64_t>(i);
    scan.stack.push_back(static_cast<int>(stacks[row].item<float>()));
    scan.time_s.push_back(times[row].item<float>());
  }
  RefinementOptions refinement;
  refinement.finest_mm = options.input_resolution_mm;
  const std::vector<std::vector<RefinedSlice>> path = refine_by_level(scan, scan.T_world_slice, refinement);

  const double half_field_mm = 0.5 * options.input_px * options.input_resolution_mm;
  const AnchorFrame frame = live_anchor_frame(options);
  const torch::Tensor here = inverse_transform(transforms);
  const torch::Tensor rest =
      anchor_points_from_matrix(torch::eye(4).slice(0, 0, 3).unsqueeze(0), frame) / kLiveUpdateUnitMm;
  std::vector<torch::Tensor> points, correlations;
  for (const std::vector<RefinedSlice>& level : path) {
    std::vector<float> correlation;
    std::vector<Pose> poses;
    for (const RefinedSlice& slice : level) {
      correlation.push_back(std::isfinite(slice.ncc) ? static_cast<float>(slice.ncc) : 0.F);
      poses.push_back(slice.T_brain_slice);
    }
    correlations.push_back(torch::tensor(correlation));
    if (correlations.size() == 1) continue;  // nothing has moved yet
    // Registration sees relative motion alone: what the whole has drifted by means nothing.
    const Pose held = fit_planes(poses, scan.T_world_slice, half_field_mm);
    for (Pose& pose : poses) pose = held * pose;
    const torch::Tensor moved = compose_transforms(here, tensor_from_poses(poses));
    points.push_back(anchor_points_from_matrix(moved, frame) / kLiveUpdateUnitMm - rest);
  }
  return {torch::stack(points, 1).to(device), torch::stack(correlations, 1).to(device)};
}

LivePulls concatenate(const std::vector<LivePulls>& pulls) {
  std::vector<torch::Tensor> points, correlations;
  for (const LivePulls& each : pulls) {
    if (!each.points.defined()) return {};
    points.push_back(each.points);
    correlations.push_back(each.correlation);
  }
  return {torch::cat(points), torch::cat(correlations)};
}

torch::Tensor apply_live_update(const torch::Tensor& transforms, const torch::Tensor& points,
                                const LiveNetworkOptions& options) {
  const torch::Tensor identity = torch::eye(4, transforms.options()).slice(0, 0, 3).unsqueeze(0);
  const torch::Tensor rest = anchor_points_from_matrix(identity, live_anchor_frame(options));
  const torch::Tensor target = (rest + kLiveUpdateUnitMm * points).view({-1, 3, 3});
  return matrix_from_anchor_points(transform_points(transforms, target).reshape({-1, 9}));
}

}  // namespace svort
