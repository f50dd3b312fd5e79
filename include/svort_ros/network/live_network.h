#pragma once

#include <torch/nn/modules/conv.h>
#include <torch/nn/modules/linear.h>
#include <torch/nn/modules/normalization.h>

#include <array>
#include <cstdint>
#include <string>
#include <vector>

#include "svort_ros/network/pose_consensus.h"
#include "svort_ros/network/pose_network.h"
#include "svort_ros/registration/pose_refinement.h"

namespace svort {

/// Shape of the live network. A checkpoint holds these values beside the parameters.
struct LiveNetworkOptions {
  int input_px = 64;                ///< slices are brought to input_px x input_px pixels
  double input_resolution_mm = 2.;  ///< of this size, by averaging whole pixels
  int width = 32;                   ///< channels of the first stage; the second has twice, the third four times as many
  int blocks = 1;                   ///< residual blocks per stage
  int dim = 192;                    ///< length of a token
  int heads = 6;                    ///< attention heads
  int layers = 4;                   ///< Transformer layers
  int hidden = 512;                 ///< hidden units of a layer's feed-forward part
  int iterations = 3;               ///< K: the first network once, then the volume-conditioned network K - 1 times
  bool positional_embedding = true;  ///< false: ablation, tokens carry the image alone
  bool volume_conditioned = true;    ///< false: ablation "w/o Vol", later iterations see the slice alone
  bool pulls = true;    ///< the shared network is told where registration would take the slices, see LivePulls
  int frame_width = 0;  ///< units in each hidden layer of the frame network; 0: there is none, the frame is as voted
  int frame_steps = 1;  ///< times that the frame network corrects a frame; may be changed after training
  ConsensusOptions consensus;

  template <class Visitor>
  void visit(Visitor&& v) {
    v("input_px", input_px, "pixels along each side of the slice that the network sees");
    v("input_resolution_mm", input_resolution_mm, "size of such a pixel, mm");
    v("width", width, "channels of the encoder's first stage");
    v("blocks", blocks, "residual blocks per stage of the encoder");
    v("dim", dim, "length of a token");
    v("heads", heads, "attention heads");
    v("layers", layers, "Transformer layers");
    v("hidden", hidden, "hidden units in a Transformer layer");
    v("iterations", iterations, "transformation updates (K of the paper); may be changed after training");
    v("positional_embedding", positional_embedding, "false: without positional embedding (ablation)");
    v("volume_conditioned", volume_conditioned, "false: later updates do not see the volume (ablation)");
    v("pulls", pulls, "later updates are told where registration would take the slices");
    v("frame_width", frame_width, "units in a hidden layer of the frame network; 0: none, the frame is as voted");
    v("frame_steps", frame_steps, "times that the frame network corrects a frame; may be changed after training");
    v.section("consensus", consensus);
  }
};

/// Encoder of the live network: residual network with group norm, so that a slice's features depend on that slice
/// alone.
class LiveEncoderImpl : public torch::nn::Module {
 public:
  LiveEncoderImpl(const LiveNetworkOptions& options, int channels);
  /// n x channels x input_px x input_px -> n x dim; `precision` float32 or bfloat16 for the convolutions
  torch::Tensor forward(const torch::Tensor& images, torch::ScalarType precision);

 private:
  struct Block {
    torch::nn::Conv2d first{nullptr}, second{nullptr}, shortcut{nullptr};
    torch::nn::GroupNorm first_norm{nullptr}, second_norm{nullptr};
  };
  torch::nn::Conv2d stem_{nullptr};
  torch::nn::GroupNorm stem_norm_{nullptr};
  std::vector<Block> blocks_;
  torch::nn::Linear out_{nullptr};
};
TORCH_MODULE(LiveEncoder);

/// Pre-norm Transformer encoder over the slices of a scan. Scans of different lengths are padded and masked.
class LiveTransformerImpl : public torch::nn::Module {
 public:
  explicit LiveTransformerImpl(const LiveNetworkOptions& options);
  /// @param tokens    b x l x dim
  /// @param mask      b x l, bool, true where there is a slice; undefined means everywhere
  /// @param attention if not null, receives per layer b x heads x l x l
  /// @return b x l x dim, normalised
  torch::Tensor forward(const torch::Tensor& tokens, const torch::Tensor& mask, std::vector<torch::Tensor>* attention);

 private:
  struct Layer {
    torch::nn::LayerNorm attention_norm{nullptr}, feed_forward_norm{nullptr};
    torch::nn::Linear qkv{nullptr}, attention_out{nullptr}, hidden{nullptr}, out{nullptr};
  };
  std::int64_t heads_;
  std::vector<Layer> layers_;
  torch::nn::LayerNorm norm_{nullptr};
};
TORCH_MODULE(LiveTransformer);

/// Channels of a volume as the frame network sees it, see live_frame_view().
constexpr int kLiveFrameChannels = 2;
/// Points of the head whose movements say how the whole moves, see live_frame_points().
constexpr int kLiveFramePoints = 8;

/// How a whole brain, whose slices have been placed relative to each other, has to move to lie in the canonical frame:
/// a perceptron over the volume that the slices form. The brain lies near that frame already, so each of its weights
/// stands for a place in the head. Convolutions, which have to find out where they are first, learned to shift brains
/// but, from as many scans, not to turn them.
class LiveFrameNetworkImpl : public torch::nn::Module {
 public:
  explicit LiveFrameNetworkImpl(const LiveNetworkOptions& options);
  /// @param views b x kLiveFrameChannels x d/2 x d/2 x d/2, d = input_px
  /// @return b x kLiveFramePoints x 3: how each point has to move, x y z, units of kLiveUpdateUnitMm; 0 without brain
  torch::Tensor forward(const torch::Tensor& views);

 private:
  torch::nn::Linear first_{nullptr}, second_{nullptr}, out_{nullptr};
};
TORCH_MODULE(LiveFrameNetwork);

constexpr double kLiveUnitMm = 50.;        ///< unit of the first network's anchor points
constexpr double kLiveUpdateUnitMm = 10.;  ///< unit of the shared network's movements

/// What the Transformer says about each of n slices.
struct LiveOutput {
  torch::Tensor points;     ///< n x 9: first network: anchor points in the brain frame; shared network: how each anchor
                            ///< point has to move, in the axes of the slice as it lies now
  torch::Tensor mirrored;   ///< n x 9, first network only: the same points up to a reflection of x
  torch::Tensor log_scale;  ///< n: logarithm of the expected error of `points`, in their unit
  torch::Tensor quality;    ///< n: logit of the slice's weight
};

/// A frame that slices were placed in, seen from the canonical frame.
struct LiveFrame {
  torch::Tensor motion;   ///< 1 x 3 x 4, trans_first, mm
  double agreement = 0.;  ///< vote_agreement() on it
};

/// Levels of blur at which images pull slices.
constexpr std::int64_t kLivePulls = static_cast<std::int64_t>(kRefinementLevels);

/// Where registration to the volume that the slices form would take each of n slices (refine_by_level()). The shared
/// network weighs these against each other and against staying, slice by slice.
struct LivePulls {
  torch::Tensor points;       ///< n x kLivePulls x 9: how each anchor point would have moved after each level, in the
                              ///< axes of the slice as it lies now, units of kLiveUpdateUnitMm
  torch::Tensor correlation;  ///< n x (kLivePulls + 1): of slice and volume, before and after each level
};

/// The network for live use: every slice is encoded once, whatever comes after it.
///
/// The first network estimates the anchor points of each slice from the image and from where all slices were
/// prescribed; from these votes follow a head pose (pose_consensus()) and how the head has moved
/// (trajectory_consensus()). The second, shared by all later iterations, sees each slice beside the slice simulated
/// from the volume at its current place, hears where images pull it, and moves it: by a mean of the pulls with weights
/// that it chooses, and a correction of its own; the first network then says again where the whole lies (find_frame()),
/// and a third network, which sees the volume as a whole, corrects that. Both normalise each slice on its own (group
/// norm), so encode() of a slice never changes; attend() runs over all slices that are there, 1 to 450 of them, any
/// prefix of a scan.
class LiveNetwork : public PoseNetwork {
 public:
  /// @throws std::invalid_argument naming the option that is out of range
  explicit LiveNetwork(const LiveNetworkOptions& options = {});

  const LiveNetworkOptions& options() const { return options_; }
  /// Of the convolutions: float32 (default) or bfloat16. All else is float32.
  void set_precision(torch::ScalarType precision) { precision_ = precision; }

  /// Features of slices for the first network. Row i depends on slice i alone; keep it while the scan grows.
  /// @param slices        n x 1 x h x w
  /// @param resolution_mm pixel size
  /// @return n x dim
  /// @throws std::invalid_argument if the slices cannot be brought to the input size by averaging whole pixels
  torch::Tensor encode(const torch::Tensor& slices, double resolution_mm);

  /// First network: all slices together.
  /// @param features  n x dim, from encode()
  /// @param input     positions, transforms, counts and times of the same slices; `slices` is not used
  /// @param lengths   slices of each scan, if `input` holds several scans one after another; empty: it holds one
  /// @param attention if not null, receives per layer b x heads x l x l
  LiveOutput attend(const torch::Tensor& features, const NetworkInput& input,
                    const std::vector<std::int64_t>& lengths = {}, std::vector<torch::Tensor>* attention = nullptr);

  /// The first network asked several times, the prescription turned in between (ConsensusOptions::views): which way the
  /// scanner's axes lie must not matter, and votes from several sides are off less than those from one.
  /// @param attention if not null, receives that of the first view
  PoseVotes vote(const torch::Tensor& features, const NetworkInput& input,
                 std::vector<torch::Tensor>* attention = nullptr);
  /// Where the first network puts the slices, after vote(), pose_consensus() and trajectory_consensus().
  /// @return n x 3 x 4
  torch::Tensor place(const torch::Tensor& features, const NetworkInput& input,
                      std::vector<torch::Tensor>* attention = nullptr);
  /// Where slices whose places relative to each other are known, in one frame, lie in the brain's canonical frame: as
  /// the first network votes, then corrected by the frame network, if there is one.
  /// @param reduced n x 1 x input_px x input_px, reduce()
  LiveFrame find_frame(const torch::Tensor& features, const torch::Tensor& reduced, const NetworkInput& placed);

  bool has_frame_network() const { return static_cast<bool>(frame_network_); }
  /// Frame network: how brains that lie near the canonical frame have to move to lie in it, see frame_motions().
  /// @param views b x kLiveFrameChannels x d/2 x d/2 x d/2, d = input_px, see live_frame_view()
  /// @return b x kLiveFramePoints x 3, units of kLiveUpdateUnitMm
  /// @throws std::logic_error if the network has none
  torch::Tensor look_at_frames(const torch::Tensor& views);

  /// Shared network: one update. `input.transforms` are the current places in the brain frame.
  /// @param simulated n x kLiveSimulatedChannels x input_px x input_px, see simulate_live_channels()
  /// @param pulls     see pull_live_slices(); undefined: not known
  LiveOutput update(const torch::Tensor& simulated, const LivePulls& pulls, const NetworkInput& input,
                    const std::vector<std::int64_t>& lengths = {}, std::vector<torch::Tensor>* attention = nullptr);

  /// update() in two steps, so that features may be kept. Features of slices at their places, for the shared network;
  /// row i depends on slice i, its place and the volume alone.
  /// @param reduced   n x 1 x input_px x input_px, reduce()
  /// @param simulated as for update()
  /// @return n x dim
  torch::Tensor encode_placed(const torch::Tensor& reduced, const torch::Tensor& simulated);
  /// Shared network: all slices together. @param features n x dim, from encode_placed(); the rest as for update()
  LiveOutput attend_placed(const torch::Tensor& features, const LivePulls& pulls, const NetworkInput& input,
                           const std::vector<std::int64_t>& lengths = {},
                           std::vector<torch::Tensor>* attention = nullptr);

  /// Slices as the network sees them: n x 1 x input_px x input_px, averaged, not normalised.
  torch::Tensor reduce(const torch::Tensor& slices, double resolution_mm) const;

  std::vector<NetworkStep> run(const NetworkInput& input, const NetworkGrid& grid, const NetworkRun& run) override;

 private:
  torch::Tensor embed(const NetworkInput& input, bool first) const;
  torch::Tensor with_coordinates(const torch::Tensor& images) const;
  torch::Tensor speak(LiveTransformer& transformer, torch::nn::Linear& head, const torch::Tensor& tokens,
                      const std::vector<std::int64_t>& lengths, std::vector<torch::Tensor>* attention);

  LiveNetworkOptions options_;
  torch::ScalarType precision_ = torch::kFloat32;
  LiveEncoder first_encoder_{nullptr}, shared_encoder_{nullptr};
  LiveTransformer first_transformer_{nullptr}, shared_transformer_{nullptr};
  torch::nn::Linear first_position_{nullptr}, shared_position_{nullptr}, first_head_{nullptr}, shared_head_{nullptr};
  torch::nn::Linear shared_pulls_{nullptr};
  LiveFrameNetwork frame_network_{nullptr};
};

/// The points whose movements the frame network estimates, kLiveFramePoints x 3, x y z, mm: corners of a cube in the
/// head.
torch::Tensor live_frame_points();
/// Volumes as the frame network sees them, in voxels of twice their size: how much brighter than the mean of the brain,
/// times how much of the voxel is brain; and how much of it is.
/// @param volumes b x 1 x d x d x d, see live_volume(); 0 where there is no brain
/// @return b x kLiveFrameChannels x d/2 x d/2 x d/2
torch::Tensor live_frame_view(const torch::Tensor& volumes);
/// The rigid motions that fit what is said of the points best.
/// @param movement b x kLiveFramePoints x 3, LiveNetwork::look_at_frames()
/// @return b x 3 x 4, on the CPU
torch::Tensor frame_motions(const torch::Tensor& movement);

/// PSF reconstruction of the slices at `transforms` on a grid of the network's own resolution. No gradients.
/// @param reduced n x 1 x p x p, LiveNetwork::reduce()
/// @return p x p x p
torch::Tensor live_volume(const torch::Tensor& reduced, const torch::Tensor& transforms,
                          const LiveNetworkOptions& options, double thickness_mm, AcquisitionFormulation formulation);

/// Channels that the shared network gets beside the slice: the volume seen from the slice's place, and how that changes
/// along the slice's normal.
constexpr int kLiveSimulatedChannels = 2;

/// PSF reconstruction of the slices at `input.transforms` on a grid of the network's own resolution, and what each
/// slice would look like in it. No gradients.
/// @param reduced n x 1 x p x p, LiveNetwork::reduce()
/// @return n x kLiveSimulatedChannels x p x p: simulated slice, and the difference of the simulated slices
///         kLiveNormalStepMm before and behind it; 0 where the slice is 0
torch::Tensor simulate_live_channels(const torch::Tensor& reduced, const torch::Tensor& transforms,
                                     const LiveNetworkOptions& options, double thickness_mm,
                                     AcquisitionFormulation formulation);
constexpr double kLiveNormalStepMm = 3.;

/// The same in a volume that is there already.
/// @param geometry of the slices as `reduced` has them, in the volume's voxels; see geometry_of_poses()
/// @param volume   d x d x d, float32, CPU, in the slices' unit
/// @param voxel_mm its voxel size
torch::Tensor simulate_live_channels(const torch::Tensor& reduced, const AcquisitionGeometry& geometry,
                                     const torch::Tensor& volume, double voxel_mm, AcquisitionFormulation formulation);

/// Where images pull the slices of one scan from `input.transforms`. No gradients, on the CPU.
/// @param reduced n x 1 x p x p, LiveNetwork::reduce(), in acquisition order
/// @param input   transforms, positions, times, common_frame and thickness_mm are used
LivePulls pull_live_slices(const torch::Tensor& reduced, const NetworkInput& input, const LiveNetworkOptions& options);

/// Pulls of several scans, one after another. Undefined if one of them is.
LivePulls concatenate(const std::vector<LivePulls>& pulls);

/// Places after an update of the shared network.
/// @param transforms n x 3 x 4, current places; @param points n x 9, LiveOutput::points of update()
/// @return n x 3 x 4
torch::Tensor apply_live_update(const torch::Tensor& transforms, const torch::Tensor& points,
                                const LiveNetworkOptions& options);

/// The first network's votes for pose_consensus(), detached and on the CPU.
PoseVotes live_votes(const LiveOutput& output, const NetworkInput& input, const LiveNetworkOptions& options);

/// Anchor frame of the slices that the network sees (the same field of view as the slices it is given).
AnchorFrame live_anchor_frame(const LiveNetworkOptions& options);

}  // namespace svort
