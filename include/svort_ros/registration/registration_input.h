#pragma once

#include <torch/types.h>

#include <vector>

#include "svort_ros/geometry/pose.h"

namespace svort {

/// The slices that registration works on: n of them, in acquisition order.
struct RegistrationInput {
  torch::Tensor slices;              ///< n x 1 x h x w, float32, CPU; bright tissue near 1, 0 off the brain
  torch::Tensor masks;               ///< n x 1 x h x w, bool, CPU; where the brain is
  std::vector<Pose> T_world_slice;   ///< n, nominal poses (slice centre as origin, mm), in a frame centred on the brain
  std::vector<int> stack;            ///< n, number of the stack that the slice belongs to
  std::vector<double> time_s;        ///< n, acquisition times, not decreasing, s
  std::vector<double> thickness_mm;  ///< n, slice thickness (FWHM)
  double resolution_mm = 1.;         ///< pixel size

  std::size_t count() const { return T_world_slice.size(); }
};

/// @throws std::invalid_argument naming the member whose shape, type or value does not fit the others
void validate(const RegistrationInput& input);

}  // namespace svort
