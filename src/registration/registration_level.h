#pragma once

#include <torch/types.h>

#include <vector>

#include "slice_terms.h"
#include "svort_ros/registration/registration_input.h"

namespace svort {

/// The slices at one level of resolution.
struct RegistrationLevel {
  double pixel_mm = 1.;  ///< of slices and voxels
  torch::Tensor slices;  ///< n x 1 x s x s, averaged to the pixel size and blurred
  torch::Tensor masks;   ///< n x 1 x s x s, bool
  std::vector<SlicePoints> points;
  double bright = 1.;           ///< 0.99 quantile of the brain's pixels
  double field_radius_mm = 0.;  ///< of the largest slice's brain pixels around its centre
};

/// @param blur_mm standard deviation of the blur in plane
RegistrationLevel make_level(const RegistrationInput& input, double pixel_mm, double blur_mm);

}  // namespace svort
