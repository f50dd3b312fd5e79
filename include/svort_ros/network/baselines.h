#pragma once

#include <torch/nn/modules/container/sequential.h>
#include <torch/nn/modules/linear.h>

#include <cstdint>
#include <string>
#include <vector>

#include "svort_ros/network/pose_network.h"

namespace svort {

/// Shape of the paper's baselines.
struct BaselineOptions {
  int input_px = 64;                ///< slices are brought to input_px x input_px pixels
  double input_resolution_mm = 2.;  ///< of this size, by averaging whole pixels
  int width = 16;                   ///< channels of the first convolution; 64 in VGG-16
  int dim = 256;                    ///< hidden units after the convolutions; 4096 in VGG-16

  template <class Visitor>
  void visit(Visitor&& v) {
    v("input_px", input_px, "pixels along each side of the slice that the network sees");
    v("input_resolution_mm", input_resolution_mm, "size of such a pixel, mm");
    v("width", width, "channels of the first convolution (VGG-16 has 64)");
    v("dim", dim, "hidden units after the convolutions (VGG-16 has 4096)");
  }
};

/// Convolutions of VGG-16 (Simonyan and Zisserman, 2014): thirteen of 3 x 3 in five groups, each followed by a maximum
/// over 2 x 2 pixels. Group norm after each convolution, which VGG lacks, lets it learn from scratch.
class VggEncoderImpl : public torch::nn::Module {
 public:
  explicit VggEncoderImpl(const BaselineOptions& options);
  /// n x 1 x input_px x input_px -> n x dim
  torch::Tensor forward(const torch::Tensor& images);

 private:
  std::vector<std::vector<torch::nn::Sequential>> groups_;
  torch::nn::Linear out_{nullptr};
};
TORCH_MODULE(VggEncoder);

/// A network that regresses the anchor points of each slice in one go, without nominal poses, volume or weights.
class AnchorRegressor : public PoseNetwork {
 public:
  /// @param lengths slices of each scan, if `input` holds several scans one after another; empty: it holds one
  /// @return n x 9, mm, anchor points in the brain frame, of slices as large as those in `input`
  /// @throws std::invalid_argument if the slices cannot be brought to the input size by averaging whole pixels
  virtual torch::Tensor regress(const NetworkInput& input, const std::vector<std::int64_t>& lengths = {}) = 0;

  /// One step, without weights and volume; `run.iterations` and the grid have no meaning here.
  std::vector<NetworkStep> run(const NetworkInput& input, const NetworkGrid& grid, const NetworkRun& run) override;

 protected:
  AnchorRegressor(const std::string& name, const BaselineOptions& options);
  torch::Tensor reduce(const NetworkInput& input) const;

  BaselineOptions options_;
};

/// SVRnet (Hou et al., 3-D reconstruction in canonical co-ordinate space from arbitrarily oriented 2-D images, 2018),
/// as the paper compares with it: VGG on each slice alone.
class SvrNet : public AnchorRegressor {
 public:
  /// @throws std::invalid_argument naming the option that is out of range
  explicit SvrNet(const BaselineOptions& options = {});
  torch::Tensor regress(const NetworkInput& input, const std::vector<std::int64_t>& lengths = {}) override;

 private:
  VggEncoder encoder_{nullptr};
  torch::nn::Linear head_{nullptr};
};

/// PlaneInVol (Yeung et al., Learning to map 2D ultrasound images into 3D space with minimal human annotation, 2021),
/// as the paper compares with it: a convolutional network whose slices attend to the other slices of the set. What a
/// slice takes from the set is a mean of their features, weighted by how much they resemble its own.
class PlaneInVol : public AnchorRegressor {
 public:
  /// @throws std::invalid_argument naming the option that is out of range
  explicit PlaneInVol(const BaselineOptions& options = {});
  torch::Tensor regress(const NetworkInput& input, const std::vector<std::int64_t>& lengths = {}) override;

 private:
  VggEncoder encoder_{nullptr};
  torch::nn::Linear query_{nullptr}, key_{nullptr}, value_{nullptr}, hidden_{nullptr}, head_{nullptr};
};

}  // namespace svort
