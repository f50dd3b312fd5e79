#pragma once

#include <Eigen/Core>
#include <Eigen/Geometry>
#include <array>
#include <cmath>
#include <cstdint>

namespace svort {

/// Random numbers for one purpose of one scan: the same for the same three numbers, whatever else was drawn before.
///
/// xoshiro256++ (Blackman and Vigna, 2019), seeded through splitmix64. Unlike the distributions of the standard
/// library, the numbers do not depend on the compiler.
class RandomStream {
 public:
  /// @param seed    of the run
  /// @param item    number of the scan, the anatomy, ...
  /// @param purpose what the numbers are for, so that a change in one part leaves the others as they were
  explicit RandomStream(std::uint64_t seed, std::uint64_t item = 0, std::uint64_t purpose = 0) {
    std::uint64_t key = mix(mix(mix(seed) ^ item) ^ purpose);
    for (std::uint64_t& word : state_) word = mix(key += 0x9E3779B97F4A7C15ULL);
  }

  std::uint64_t bits() {
    const std::uint64_t result = rotate(state_[0] + state_[3], 23) + state_[0];
    const std::uint64_t shifted = state_[1] << 17;
    state_[2] ^= state_[0];
    state_[3] ^= state_[1];
    state_[1] ^= state_[2];
    state_[0] ^= state_[3];
    state_[2] ^= shifted;
    state_[3] = rotate(state_[3], 45);
    return result;
  }

  /// In [0, 1).
  double uniform() { return static_cast<double>(bits() >> 11) * 0x1p-53; }
  double uniform(double low, double high) { return low + (high - low) * uniform(); }
  /// In low .. high, both included.
  int integer(int low, int high) {
    return low + static_cast<int>(std::floor(uniform() * static_cast<double>(high - low + 1)));
  }
  bool chance(double probability) { return uniform() < probability; }
  double normal(double deviation = 1.) {
    const double radius = std::sqrt(-2. * std::log(1. - uniform()));
    return deviation * radius * std::cos(2. * M_PI * uniform());
  }
  double exponential(double mean) { return -mean * std::log(1. - uniform()); }
  Eigen::Vector3d normal3(double deviation) {
    const double x = normal(deviation), y = normal(deviation), z = normal(deviation);
    return {x, y, z};
  }
  Eigen::Vector3d direction() {
    const double z = uniform(-1., 1.), angle = uniform(0., 2. * M_PI), radius = std::sqrt(1. - z * z);
    return {radius * std::cos(angle), radius * std::sin(angle), z};
  }
  /// Uniform on SO(3).
  Eigen::Matrix3d rotation() {
    // A normal vector in four dimensions points in a uniform direction: a uniform unit quaternion.
    const double w = normal(), x = normal(), y = normal(), z = normal();
    return Eigen::Quaterniond(w, x, y, z).normalized().toRotationMatrix();
  }

 private:
  static std::uint64_t rotate(std::uint64_t x, int k) { return (x << k) | (x >> (64 - k)); }
  static std::uint64_t mix(std::uint64_t x) {
    x += 0x9E3779B97F4A7C15ULL;
    x = (x ^ (x >> 30)) * 0xBF58476D1CE4E5B9ULL;
    x = (x ^ (x >> 27)) * 0x94D049BB133111EBULL;
    return x ^ (x >> 31);
  }

  std::array<std::uint64_t, 4> state_{};
};

}  // namespace svort
