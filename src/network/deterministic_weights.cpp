#include "svort_ros/network/deterministic_weights.h"

#include <array>
#include <cmath>
#include <cstring>
#include <regex>
#include <stdexcept>
#include <string>

namespace svort {
namespace {

class Crc32 {
 public:
  Crc32() {
    for (std::uint32_t i = 0; i < table_.size(); ++i) {
      std::uint32_t value = i;
      for (int bit = 0; bit < 8; ++bit) value = (value >> 1) ^ ((value & 1U) != 0U ? 0xedb88320U : 0U);
      table_[i] = value;
    }
  }
  void add(const void* data, std::size_t size) {
    const auto* bytes = static_cast<const unsigned char*>(data);
    for (std::size_t i = 0; i < size; ++i) state_ = (state_ >> 8) ^ table_[(state_ ^ bytes[i]) & 0xffU];
  }
  std::uint32_t value() const { return ~state_; }

 private:
  std::array<std::uint32_t, 256> table_{};
  std::uint32_t state_ = 0xffffffffU;
};

/// A multiple of 2^-23 in [-1, 1), from the seed of a parameter and the index of an element.
double unit_value(std::uint32_t seed, std::uint32_t index) {
  std::uint32_t h = index * 2654435761U + seed;
  h ^= h >> 16;
  h *= 0x7feb352dU;
  h ^= h >> 15;
  h *= 0x846ca68bU;
  h ^= h >> 16;
  return static_cast<double>(h >> 8) * 0x1p-23 - 1.;
}

/// How the values of one parameter follow from the unit values: offset + v * a * b, all in double.
struct Rule {
  double offset = 0.;
  std::array<double, 2> factors = {1., 1.};
};

Rule rule_of(const std::string& name, const torch::Tensor& parameter,
             const torch::OrderedDict<std::string, torch::Tensor>& all) {
  static const std::regex regressor(R"(svrnet(\d+|\.\d+)\.fc\.weight)");
  static const std::regex block_norm(R"((.*\.layer\d+\.\d+\.bn)([23])\.weight)");
  const auto ends_with = [&name](const std::string& end) {
    return name.size() >= end.size() && name.compare(name.size() - end.size(), end.size(), end) == 0;
  };
  if (ends_with(".weight") && parameter.dim() > 1) {
    const double fan_in = static_cast<double>(parameter.numel() / parameter.size(0));
    const double gain = parameter.dim() == 4 ? 2. : 1.;
    return {0., {std::sqrt(3.) * std::sqrt(gain / fan_in), std::regex_match(name, regressor) ? 6. : 1.}};
  }
  if (ends_with(".weight")) {
    std::smatch match;
    const bool last_of_block =
        std::regex_match(name, match, block_norm) && (match[2] == "3" || !all.contains(match[1].str() + "3.weight"));
    return {1., {0.1, last_of_block ? 0.25 : 1.}};
  }
  if (ends_with(".bias")) {
    const torch::Tensor* sibling = all.find(name.substr(0, name.size() - 4) + "weight");
    if (sibling != nullptr) return {0., {sibling->dim() == 1 ? 0.1 : 0.02, 1.}};
  }
  throw std::invalid_argument("fill_deterministically: no rule for the parameter " + name);
}

}  // namespace

void fill_deterministically(torch::nn::Module& network) {
  const torch::NoGradGuard no_grad;
  const auto parameters = network.named_parameters();
  for (const auto& entry : parameters) {
    const std::string& name = entry.key();
    const torch::Tensor& parameter = entry.value();
    // The frequencies of a positional encoding are the same for every network; its constructor has set them.
    if (name.size() >= 2 && name.compare(name.size() - 2, 2, ".w") == 0) continue;
    const Rule rule = rule_of(name, parameter, parameters);
    Crc32 seed;
    seed.add(name.data(), name.size());
    torch::Tensor values = torch::empty(parameter.sizes(), torch::kFloat32);
    auto* out = values.data_ptr<float>();
    for (std::int64_t i = 0; i < values.numel(); ++i) {
      const double v = unit_value(seed.value(), static_cast<std::uint32_t>(i));
      // A normalisation scales its whole value, 1 included; all others have no offset.
      const double value = rule.offset > 0. ? (rule.offset + rule.factors[0] * v) * rule.factors[1]
                                            : v * rule.factors[0] * rule.factors[1];
      out[i] = static_cast<float>(value);
    }
    parameter.copy_(values);
  }
}

std::uint32_t parameter_checksum(const torch::nn::Module& network) {
  Crc32 crc;
  for (const auto& entry : network.named_parameters()) {
    const torch::Tensor values = entry.value().detach().to(torch::kCPU, torch::kFloat32).contiguous();
    crc.add(values.data_ptr<float>(), static_cast<std::size_t>(values.numel()) * sizeof(float));
  }
  return crc.value();
}

}  // namespace svort
