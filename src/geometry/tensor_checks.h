#pragma once

#include <torch/types.h>

#include <cstdint>
#include <sstream>
#include <stdexcept>
#include <string>
#include <vector>

namespace svort {

/// "4 x 3 x 4 Float", for messages.
inline std::string shape_text(const torch::Tensor& tensor) {
  if (!tensor.defined()) return "an undefined tensor";
  std::ostringstream text;
  for (std::int64_t axis = 0; axis < tensor.dim(); ++axis) text << (axis ? " x " : "") << tensor.size(axis);
  text << (tensor.dim() ? " " : "a single ") << c10::toString(tensor.scalar_type());
  return text.str();
}

/// @throws std::invalid_argument unless `tensor` is n x `item...`, float32 or float64.
inline void check_batch(const torch::Tensor& tensor, const std::vector<std::int64_t>& item, const char* function,
                        const char* name) {
  bool fits = tensor.defined() && tensor.dim() == static_cast<std::int64_t>(item.size()) + 1 &&
              (tensor.scalar_type() == torch::kFloat32 || tensor.scalar_type() == torch::kFloat64);
  for (std::size_t axis = 0; fits && axis < item.size(); ++axis) {
    fits = tensor.size(static_cast<std::int64_t>(axis) + 1) == item[axis];
  }
  if (fits) return;
  std::ostringstream message;
  message << function << ": " << name << " must be n";
  for (const std::int64_t size : item) message << " x " << size;
  message << ", float32 or float64, got " << shape_text(tensor);
  throw std::invalid_argument(message.str());
}

}  // namespace svort
