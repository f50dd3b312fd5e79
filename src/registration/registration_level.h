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
  torch::Tensor masks;   ///< n x 1 x s x s, bool; pixels that count
  std::vector<SlicePoints> points;
  double bright = 1.;           ///< 0.99 quantile of the brain's pixels
  double field_radius_mm = 0.;  ///< of the largest slice's brain pixels around its centre
};

/// What a slice shows at a level.
enum class SliceContent {
  inside,   ///< the brain alone: what lies outside the mask is unknown, not dark
  outline,  ///< the brain, dark around it, and a rim of that
};

/// @param blur_mm standard deviation of the blur in plane
RegistrationLevel make_level(const RegistrationInput& input, double pixel_mm, double blur_mm,
                             SliceContent content = SliceContent::inside);

}  // namespace svort
