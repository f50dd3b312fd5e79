#pragma once

#include <torch/nn/modules/batchnorm.h>
#include <torch/nn/modules/container/sequential.h>
#include <torch/nn/modules/conv.h>
#include <torch/nn/modules/linear.h>

#include <cstdint>

namespace svort {

/// Shape of a residual encoder.
struct ResNetOptions {
  int depth = 50;               ///< 18 or 34 (blocks of two convolutions), 50 (bottleneck blocks of three)
  std::int64_t channels = 3;    ///< channels of the input image
  std::int64_t features = 512;  ///< numbers that describe one image
  std::int64_t width = 64;      ///< channels after the stem; 64 in the literature, less for tests
};

/// Deep residual network (He et al., CVPR 2016) whose normalisations use the statistics of the batch, always.
///
/// As in the public SVoRT implementation there are no running statistics: the features of one image depend on all
/// others in the batch. Names of the parameters are those of torchvision.
class ResNetImpl : public torch::nn::Module {
 public:
  /// @throws std::invalid_argument naming the option that is out of range
  explicit ResNetImpl(const ResNetOptions& options);

  /// Convolution, normalisation, pooling. @param images n x channels x h x w @return n x width x h/4 x w/4
  torch::Tensor stem(const torch::Tensor& images);
  /// One of the four groups of blocks. @param group 0 to 3
  torch::Tensor group(std::size_t group, const torch::Tensor& x);
  /// Mean over the plane, then the linear layer. @return n x features
  torch::Tensor head(const torch::Tensor& x);
  /// All of it. @return n x features
  torch::Tensor forward(const torch::Tensor& images);

 private:
  torch::nn::Conv2d conv1_{nullptr};
  torch::nn::BatchNorm2d bn1_{nullptr};
  std::vector<torch::nn::Sequential> groups_;
  torch::nn::Linear fc_{nullptr};
};
TORCH_MODULE(ResNet);

/// A ResNet one level down, where the public checkpoints have it: "model".
class ImageEncoderImpl : public torch::nn::Module {
 public:
  explicit ImageEncoderImpl(const ResNetOptions& options);
  torch::Tensor forward(const torch::Tensor& images) { return model->forward(images); }

  ResNet model{nullptr};
};
TORCH_MODULE(ImageEncoder);

}  // namespace svort
