#pragma once

#include <torch/types.h>

#include "svort_ros/geometry/rigid_transform.h"
#include "svort_ros/network/network_registry.h"

namespace svort {

/// Options that make version 1 or 2 run in milliseconds.
inline OptionValues small_svort_options() {
  return {
      {"encoder_depth", std::int64_t{18}}, {"encoder_width", std::int64_t{4}},   {"features", std::int64_t{64}},
      {"heads", std::int64_t{2}},          {"hidden", std::int64_t{32}},         {"layers", std::int64_t{1}},
      {"later_layers", std::int64_t{1}},   {"quality_depth", std::int64_t{18}},  {"quality_features", std::int64_t{64}},
      {"quality_heads", std::int64_t{2}},  {"quality_hidden", std::int64_t{32}}, {"quality_layers", std::int64_t{1}}};
}

/// One stack of n slices, 3 mm apart, with an ellipse of random texture on each.
inline NetworkInput small_scan(std::int64_t n, std::int64_t size = 32) {
  NetworkInput input;
  const torch::Tensor axis = torch::arange(size, torch::kFloat32) - static_cast<double>(size - 1) / 2.;
  const torch::Tensor inside =
      (axis.view({-1, 1}).square() + axis.view({1, -1}).square() < static_cast<double>(size * size) / 9.);
  input.slices = torch::rand({n, 1, size, size}) * inside;
  torch::Tensor axisangle = torch::zeros({n, 6});
  axisangle.select(1, 5).copy_((torch::arange(n, torch::kFloat32) - static_cast<double>(n - 1) / 2.) * 3.);
  input.transforms = axisangle_to_matrix(axisangle);
  input.positions =
      torch::stack({torch::arange(n, torch::kFloat32) - static_cast<double>(n / 2), torch::zeros({n})}, 1);
  input.slice_counts = torch::full({n}, n, torch::kInt64);
  input.times = torch::arange(n, torch::kFloat32);
  return input;
}

inline NetworkGrid small_grid() { return {{24, 24, 24}, 2.}; }

}  // namespace svort
