#include "svort_ros/network/attention.h"

#include <torch/nn/modules/container/modulelist.h>

#include <cmath>
#include <stdexcept>
#include <string>

namespace svort {
namespace {

torch::nn::LayerNorm layer_norm(std::int64_t features) {
  return torch::nn::LayerNorm(torch::nn::LayerNormOptions({features}).eps(1e-6));
}

}  // namespace

SelfAttentionImpl::SelfAttentionImpl(const TransformerOptions& options) : heads_(options.heads) {
  const std::int64_t features = options.features;
  queries_ = register_module("w_qs", torch::nn::Linear(features, features));
  keys_ = register_module("w_ks", torch::nn::Linear(features, features));
  values_ = register_module("w_vs", torch::nn::Linear(features, features));
  fc_ = register_module("fc", torch::nn::Linear(features, features));
  norm_ = register_module("layer_norm", layer_norm(features));
}

torch::Tensor SelfAttentionImpl::forward(const torch::Tensor& x, torch::Tensor* attention) {
  const std::int64_t n = x.size(0), features = x.size(1);
  const auto split = [&](torch::nn::Linear& linear) {  // heads x n x features / heads
    return linear(x).view({n, heads_, features / heads_}).transpose(0, 1);
  };
  const double scale = 1. / std::sqrt(static_cast<double>(features / heads_));
  const torch::Tensor weights =
      torch::softmax(torch::matmul(split(queries_) * scale, split(keys_).transpose(1, 2)), -1);
  if (attention != nullptr) *attention = weights;
  const torch::Tensor mixed = torch::matmul(weights, split(values_)).transpose(0, 1).reshape({n, features});
  return norm_(fc_(mixed) + x);
}

FeedForwardImpl::FeedForwardImpl(const TransformerOptions& options) : gelu_(options.gelu) {
  first_ = register_module("w_1", torch::nn::Linear(options.features, options.hidden));
  second_ = register_module("w_2", torch::nn::Linear(options.hidden, options.features));
  norm_ = register_module("layer_norm", layer_norm(options.features));
}

torch::Tensor FeedForwardImpl::forward(const torch::Tensor& x) {
  const torch::Tensor hidden = first_(x);
  return norm_(second_(gelu_ ? torch::gelu(hidden) : torch::relu(hidden)) + x);
}

EncoderLayerImpl::EncoderLayerImpl(const TransformerOptions& options) {
  self_attention = register_module("slf_attn", SelfAttention(options));
  feed_forward = register_module("pos_ffn", FeedForward(options));
}

torch::Tensor EncoderLayerImpl::forward(const torch::Tensor& x, torch::Tensor* attention) {
  return feed_forward(self_attention(x, attention));
}

TransformerEncoderImpl::TransformerEncoderImpl(const TransformerOptions& options) {
  const auto require = [](bool condition, const char* name, std::int64_t value, const char* range) {
    if (condition) return;
    throw std::invalid_argument(std::string("Transformer: ") + name + " is " + std::to_string(value) + "; it must be " +
                                range);
  };
  require(options.layers >= 1, "layers", options.layers, "positive");
  require(options.heads >= 1, "heads", options.heads, "positive");
  require(options.features >= 1 && options.features % options.heads == 0, "features", options.features,
          "a positive multiple of heads");
  require(options.hidden >= 1, "hidden", options.hidden, "positive");
  torch::nn::ModuleList stack;
  for (std::int64_t i = 0; i < options.layers; ++i) {
    layers.emplace_back(options);
    stack->push_back(layers.back());
  }
  register_module("layer_stack", stack);
  norm_ = register_module("layer_norm", layer_norm(options.features));
}

torch::Tensor TransformerEncoderImpl::embed(const torch::Tensor& features, const torch::Tensor& encoding) {
  return norm_(features + encoding);
}

torch::Tensor TransformerEncoderImpl::forward(const torch::Tensor& features, const torch::Tensor& encoding,
                                              torch::Tensor* attention) {
  torch::Tensor x = embed(features, encoding);
  for (std::size_t i = 0; i < layers.size(); ++i) x = layers[i](x, i + 1 == layers.size() ? attention : nullptr);
  return x;
}

}  // namespace svort
