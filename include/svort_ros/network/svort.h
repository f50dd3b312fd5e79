#pragma once

#include <torch/types.h>

#include <cstdint>
#include <memory>
#include <vector>

#include "svort_ros/network/pose_network.h"
#include "svort_ros/network/slice_volume_transformer.h"

namespace svort {

/// Shape of SVoRT. The defaults are those of the public checkpoints; others are for tests and experiments.
struct SvortOptions {
  std::int64_t iterations = 3;      ///< K; version 2 may run more or fewer than it was made for
  std::int64_t encoder_depth = 50;  ///< ResNet of the pose networks: 18, 34 or 50
  std::int64_t encoder_width = 64;  ///< channels after the stem of every ResNet
  std::int64_t features = 512;      ///< width of a slice's token
  std::int64_t heads = 8;           ///< attention heads
  std::int64_t hidden = 1024;       ///< width of the feed-forward layers
  std::int64_t layers = 4;          ///< Transformer encoders of a pose network
  std::int64_t later_layers = 4;    ///< the same, for the networks that see a volume
  bool gelu = false;                ///< feed-forward layers of the pose networks with GELU (version 2) instead of ReLU
  std::int64_t quality_depth = 34;  ///< ResNet of version 1's quality network
  std::int64_t quality_features = 256;  ///< width of its token
  std::int64_t quality_heads = 4;       ///< its attention heads
  std::int64_t quality_hidden = 512;    ///< width of its feed-forward layers
  std::int64_t quality_layers = 4;      ///< its Transformer encoders

  template <class Visitor>
  void visit(Visitor&& v) {
    v("iterations", iterations, "transformation updates per run");
    v("encoder_depth", encoder_depth, "ResNet of the pose networks: 18, 34 or 50");
    v("encoder_width", encoder_width, "channels after the stem of every ResNet");
    v("features", features, "width of a slice's token");
    v("heads", heads, "attention heads");
    v("hidden", hidden, "width of the feed-forward layers");
    v("layers", layers, "Transformer encoders of the first pose network");
    v("later_layers", later_layers, "Transformer encoders of the networks that see a volume");
    v("gelu", gelu, "feed-forward layers of the pose networks with GELU instead of ReLU");
    v("quality_depth", quality_depth, "ResNet of version 1's quality network: 18, 34 or 50");
    v("quality_features", quality_features, "width of a token of the quality network");
    v("quality_heads", quality_heads, "attention heads of the quality network");
    v("quality_hidden", quality_hidden, "width of the feed-forward layers of the quality network");
    v("quality_layers", quality_layers, "Transformer encoders of the quality network");
  }
};

/// Options of the public checkpoints of version 1 (the paper) and of version 2.
SvortOptions svort_v1_options();
SvortOptions svort_v2_options();

/// What both versions share (paper, sec. 2): the loop of transformation update and volume estimation.
///
/// Both follow the public implementation at inference: batch statistics, forward model in every tap, quality of the
/// slices as a softmax over them times their number, two conjugate-gradient steps from the PSF reconstruction. Nothing
/// flows back from one iteration to the one before it. The volume starts as nothing: the first network sees the slices
/// alone.
class Svort : public PoseNetwork {
 public:
  /// What a transformation update answers.
  struct PoseUpdate {
    torch::Tensor points;     ///< n x 9, mm
    torch::Tensor weights;    ///< n; undefined in version 1, whose quality network comes with the volume
    torch::Tensor attention;  ///< heads x n x n, of the last layer
  };
  /// What a volume estimation answers.
  struct VolumeUpdate {
    torch::Tensor reconstructed;  ///< D x H x W, PSF reconstruction
    torch::Tensor weights;        ///< n
    torch::Tensor volume;         ///< D x H x W
  };

  std::vector<NetworkStep> run(const NetworkInput& input, const NetworkGrid& grid, const NetworkRun& run) override;

  /// Whether the volume that run() and estimate_volume() answer carries a gradient with respect to the slices' weights,
  /// as the paper's loss of the volume needs. Off unless set: it costs memory.
  void set_volume_gradient(bool on) { volume_gradient_ = on; }

  /// Transformation update of iteration k (from 0) on its own.
  /// @param points n x 9, before it
  /// @param volume D x H x W, before it; ignored by iteration 0
  PoseUpdate update_poses(std::int64_t iteration, const torch::Tensor& points, const torch::Tensor& volume,
                          const NetworkInput& input, const NetworkGrid& grid, const NetworkRun& run);

  /// Volume estimation on its own.
  /// @param points  n x 9, after the transformation update
  /// @param weights n; version 1 ignores them, and finds its own
  virtual VolumeUpdate estimate_volume(const torch::Tensor& points, const torch::Tensor& weights,
                                       const NetworkInput& input, const NetworkGrid& grid, const NetworkRun& run) = 0;

  /// The network of iteration k. @throws std::invalid_argument if there is none
  virtual SliceVolumeTransformer& pose_network(std::int64_t iteration) = 0;

 protected:
  explicit Svort(const SvortOptions& options) : options_(options) {}
  const SvortOptions options_;
  bool volume_gradient_ = false;
};

/// Version 1, the paper's: a network of its own for every iteration, and a second kind that finds the slices' quality.
class SvortV1 : public Svort {
 public:
  /// @throws std::invalid_argument naming the option that is out of range
  explicit SvortV1(const SvortOptions& options = svort_v1_options());
  VolumeUpdate estimate_volume(const torch::Tensor& points, const torch::Tensor& weights, const NetworkInput& input,
                               const NetworkGrid& grid, const NetworkRun& run) override;
  SliceVolumeTransformer& pose_network(std::int64_t iteration) override;

  SliceVolumeTransformer quality_network{nullptr};

 private:
  std::vector<SliceVolumeTransformer> pose_networks_;
};

/// Version 2: one network without and one with a volume, which all later iterations share; both find the quality.
class SvortV2 : public Svort {
 public:
  /// @throws std::invalid_argument naming the option that is out of range
  explicit SvortV2(const SvortOptions& options = svort_v2_options());
  VolumeUpdate estimate_volume(const torch::Tensor& points, const torch::Tensor& weights, const NetworkInput& input,
                               const NetworkGrid& grid, const NetworkRun& run) override;
  SliceVolumeTransformer& pose_network(std::int64_t iteration) override;

 private:
  SliceVolumeTransformer first_{nullptr}, later_{nullptr};
};

}  // namespace svort
