#pragma once

#include <torch/nn/modules/linear.h>

#include <cstdint>

#include "svort_ros/network/attention.h"
#include "svort_ros/network/pose_network.h"
#include "svort_ros/network/positional_encoding.h"
#include "svort_ros/network/resnet.h"

namespace svort {

/// Shape of a slice-volume Transformer (SVT; paper, sec. 2.2).
struct SliceVolumeTransformerOptions {
  ResNetOptions encoder;           ///< `channels` and `features` follow from the rest and are ignored
  TransformerOptions transformer;  ///< `features` is the width of encoder and embedding too
  bool simulated = false;          ///< sees each slice as simulated from the volume, as a second channel
  bool coordinates = true;         ///< sees the pixels' coordinates, as two more channels
  std::int64_t positions = 11;     ///< numbers that say where a slice is
  std::int64_t outputs = 9;        ///< numbers that it answers for each slice
  bool score = false;              ///< answers the quality of each slice as well
};

/// Slices and where they are -> something about each of them.
class SliceVolumeTransformerImpl : public torch::nn::Module {
 public:
  struct Output {
    torch::Tensor values;     ///< n x outputs
    torch::Tensor score;      ///< n x 1; undefined without a score
    torch::Tensor attention;  ///< heads x n x n, of the last layer
  };

  /// @throws std::invalid_argument naming the option that is out of range
  explicit SliceVolumeTransformerImpl(const SliceVolumeTransformerOptions& options);

  /// The encoder's input: slice, simulated slice, y and x (pixel distance from the centre / 128), as far as the options
  /// have them. @return n x channels x h x w
  torch::Tensor image_channels(const torch::Tensor& slices, const torch::Tensor& simulated) const;

  /// @param slices     n x 1 x h x w
  /// @param simulated  likewise; undefined if the options have none
  /// @param positions  n x positions
  /// @param run        its clock takes the time of the stages "encoder" and "transformer"; its precision is the layers'
  Output forward(const torch::Tensor& slices, const torch::Tensor& simulated, const torch::Tensor& positions,
                 const NetworkRun& run = {});

  ImageEncoder image_encoder{nullptr};
  PositionalEncoding positional_encoding{nullptr};
  TransformerEncoder encoder{nullptr};

 private:
  SliceVolumeTransformerOptions options_;
  torch::nn::Linear fc_{nullptr}, fc_score_{nullptr};
};
TORCH_MODULE(SliceVolumeTransformer);

}  // namespace svort
