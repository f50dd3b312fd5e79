#pragma once

#include <cstring>

namespace svort {

/// Four floats in one register, in the vector notation that GCC and Clang share: no instruction set is named.
using Float4 = float __attribute__((vector_size(16)));

inline Float4 splat(float value) { return Float4{value, value, value, value}; }

inline Float4 load4(const float* source) {
  Float4 value;
  std::memcpy(&value, source, sizeof(value));
  return value;
}

inline void store4(const Float4& value, float* target) { std::memcpy(target, &value, sizeof(value)); }

/// {a[0], a[1], b[0], b[1]}, by two loads of eight bytes.
inline Float4 load_pairs(const float* a, const float* b) {
  using Double2 = double __attribute__((vector_size(16)));
  double first, second;
  std::memcpy(&first, a, sizeof(first));
  std::memcpy(&second, b, sizeof(second));
  const Double2 bits = {first, second};
  Float4 value;
  std::memcpy(&value, &bits, sizeof(value));
  return value;
}

inline void store_pairs(const Float4& value, float* a, float* b) {
  std::memcpy(a, &value, 2 * sizeof(float));
  std::memcpy(b, reinterpret_cast<const char*>(&value) + 2 * sizeof(float), 2 * sizeof(float));
}

}  // namespace svort
