#include "svort_ros/network/resnet.h"

#include <array>
#include <stdexcept>
#include <string>

namespace svort {
namespace {

torch::nn::Conv2d convolution(std::int64_t in, std::int64_t out, std::int64_t kernel, std::int64_t stride = 1) {
  return torch::nn::Conv2d(torch::nn::Conv2dOptions(in, out, kernel).stride(stride).padding(kernel / 2).bias(false));
}

torch::nn::BatchNorm2d batch_norm(std::int64_t channels) {
  return torch::nn::BatchNorm2d(torch::nn::BatchNorm2dOptions(channels).track_running_stats(false));
}

/// Two 3 x 3 convolutions, or 1 x 1, 3 x 3 and 1 x 1 (bottleneck), around a shortcut.
class ResidualBlockImpl : public torch::nn::Module {
 public:
  ResidualBlockImpl(std::int64_t in, std::int64_t middle, std::int64_t out, std::int64_t stride, bool bottleneck) {
    const auto add = [this](std::size_t i, const torch::nn::Conv2d& convolution, std::int64_t channels) {
      const std::string number = std::to_string(i + 1);
      convolutions_.push_back(register_module("conv" + number, convolution));
      norms_.push_back(register_module("bn" + number, batch_norm(channels)));
    };
    if (bottleneck) {
      add(0, convolution(in, middle, 1), middle);
      add(1, convolution(middle, middle, 3, stride), middle);
      add(2, convolution(middle, out, 1), out);
    } else {
      add(0, convolution(in, middle, 3, stride), middle);
      add(1, convolution(middle, out, 3), out);
    }
    if (stride != 1 || in != out) {
      shortcut_ =
          register_module("downsample", torch::nn::Sequential(convolution(in, out, 1, stride), batch_norm(out)));
    }
  }

  torch::Tensor forward(const torch::Tensor& x) {
    torch::Tensor y = x;
    for (std::size_t i = 0; i < convolutions_.size(); ++i) {
      y = norms_[i](convolutions_[i](y));
      if (i + 1 < convolutions_.size()) y.relu_();
    }
    y.add_(shortcut_.is_empty() ? x : shortcut_->forward(x));
    return y.relu_();
  }

 private:
  std::vector<torch::nn::Conv2d> convolutions_;
  std::vector<torch::nn::BatchNorm2d> norms_;
  torch::nn::Sequential shortcut_{nullptr};
};
TORCH_MODULE(ResidualBlock);

std::array<int, 4> blocks_per_group(int depth) {
  if (depth == 18) return {2, 2, 2, 2};
  if (depth == 34 || depth == 50) return {3, 4, 6, 3};
  throw std::invalid_argument("ResNet: depth is " + std::to_string(depth) + "; it must be 18, 34 or 50");
}

void require_positive(const char* name, std::int64_t value) {
  if (value < 1) {
    throw std::invalid_argument(std::string("ResNet: ") + name + " is " + std::to_string(value) +
                                "; it must be positive");
  }
}

}  // namespace

ResNetImpl::ResNetImpl(const ResNetOptions& options) {
  const std::array<int, 4> blocks = blocks_per_group(options.depth);
  require_positive("channels", options.channels);
  require_positive("features", options.features);
  require_positive("width", options.width);
  conv1_ = register_module("conv1", convolution(options.channels, options.width, 7, 2));
  bn1_ = register_module("bn1", batch_norm(options.width));
  const bool bottleneck = options.depth >= 50;
  std::int64_t in = options.width;
  for (std::size_t group = 0; group < blocks.size(); ++group) {
    const std::int64_t middle = options.width << group;
    const std::int64_t out = bottleneck ? 4 * middle : middle;
    torch::nn::Sequential layer;
    for (int block = 0; block < blocks[group]; ++block) {
      layer->push_back(ResidualBlock(in, middle, out, block == 0 && group > 0 ? 2 : 1, bottleneck));
      in = out;
    }
    groups_.push_back(register_module("layer" + std::to_string(group + 1), layer));
  }
  fc_ = register_module("fc", torch::nn::Linear(in, options.features));
}

torch::Tensor ResNetImpl::stem(const torch::Tensor& images) {
  // In this layout, not with the channels innermost: that would be 20 % faster on CPUs, but LibTorch 1.13 then computes
  // the statistics of a batch too coarsely for parity (features off by 2e-4).
  return torch::max_pool2d(bn1_(conv1_(images)).relu_(), /*kernel_size=*/3, /*stride=*/2, /*padding=*/1);
}

torch::Tensor ResNetImpl::group(std::size_t group, const torch::Tensor& x) { return groups_.at(group)->forward(x); }

torch::Tensor ResNetImpl::head(const torch::Tensor& x) { return fc_(x.mean({2, 3})); }

torch::Tensor ResNetImpl::forward(const torch::Tensor& images) {
  torch::Tensor x = stem(images);
  for (std::size_t i = 0; i < groups_.size(); ++i) x = group(i, x);
  return head(x);
}

ImageEncoderImpl::ImageEncoderImpl(const ResNetOptions& options) { model = register_module("model", ResNet(options)); }

}  // namespace svort
