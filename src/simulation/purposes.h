#pragma once

#include <cstdint>

/// What random numbers are drawn for; see RandomStream.
namespace svort::purpose {

constexpr std::uint64_t kScanner = 1;
constexpr std::uint64_t kMotion = 2;
constexpr std::uint64_t kArtifacts = 3;
constexpr std::uint64_t kNoise = 4;
constexpr std::uint64_t kAnatomy = 5;
constexpr std::uint64_t kMotionClass = 6;
constexpr std::uint64_t kRim = 7;

}  // namespace svort::purpose
