#pragma once

#include <torch/nn/modules/linear.h>
#include <torch/nn/modules/normalization.h>

#include <cstdint>
#include <vector>

namespace svort {

/// Shape of a stack of Transformer encoders.
struct TransformerOptions {
  std::int64_t layers = 4;
  std::int64_t heads = 8;
  std::int64_t features = 512;  ///< width of a token; a multiple of `heads`
  std::int64_t hidden = 1024;   ///< width inside the feed-forward part
  bool gelu = false;            ///< GELU inside the feed-forward part (version 2) instead of ReLU
};

/// Self-attention over all slices of a scan (Vaswani et al., NeurIPS 2017), with shortcut and normalisation after it.
class SelfAttentionImpl : public torch::nn::Module {
 public:
  explicit SelfAttentionImpl(const TransformerOptions& options);

  /// @param x         n x features
  /// @param attention if not null, receives the weights, heads x n x n, rows sum to 1
  /// @return n x features
  torch::Tensor forward(const torch::Tensor& x, torch::Tensor* attention = nullptr);

 private:
  std::int64_t heads_;
  torch::nn::Linear queries_{nullptr}, keys_{nullptr}, values_{nullptr}, fc_{nullptr};
  torch::nn::LayerNorm norm_{nullptr};
};
TORCH_MODULE(SelfAttention);

/// Two linear layers for each slice alone, with shortcut and normalisation after them.
class FeedForwardImpl : public torch::nn::Module {
 public:
  explicit FeedForwardImpl(const TransformerOptions& options);
  torch::Tensor forward(const torch::Tensor& x);

 private:
  bool gelu_;
  torch::nn::Linear first_{nullptr}, second_{nullptr};
  torch::nn::LayerNorm norm_{nullptr};
};
TORCH_MODULE(FeedForward);

class EncoderLayerImpl : public torch::nn::Module {
 public:
  explicit EncoderLayerImpl(const TransformerOptions& options);
  torch::Tensor forward(const torch::Tensor& x, torch::Tensor* attention = nullptr);

  SelfAttention self_attention{nullptr};
  FeedForward feed_forward{nullptr};
};
TORCH_MODULE(EncoderLayer);

/// Normalises the sum of features and positional encoding, then runs the layers over it. Names of the parameters are
/// those of the public checkpoints.
class TransformerEncoderImpl : public torch::nn::Module {
 public:
  /// @throws std::invalid_argument naming the option that is out of range
  explicit TransformerEncoderImpl(const TransformerOptions& options);

  /// What enters the first layer. @param features, encoding n x features
  torch::Tensor embed(const torch::Tensor& features, const torch::Tensor& encoding);
  /// @param attention if not null, receives the weights of the last layer, heads x n x n
  torch::Tensor forward(const torch::Tensor& features, const torch::Tensor& encoding,
                        torch::Tensor* attention = nullptr);

  std::vector<EncoderLayer> layers;

 private:
  torch::nn::LayerNorm norm_{nullptr};
};
TORCH_MODULE(TransformerEncoder);

}  // namespace svort
