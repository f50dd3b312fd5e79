#pragma once

#include <vector>

#include "svort_ros/geometry/image_grid.h"
#include "svort_ros/registration/registration_input.h"

namespace svort {

/// The brain that the slices form, as match_template() takes it: a cube around the centre of their masks, faded where
/// little was seen; its grid lies in the frame of the poses.
/// @param poses, weights one per slice
/// @throws std::invalid_argument naming what does not fit
Volume rough_volume(const RegistrationInput& input, const std::vector<Pose>& poses, const std::vector<double>& weights,
                    double size_mm, double voxel_mm);

}  // namespace svort
