#pragma once

#include <optional>
#include <vector>

#include "svort_ros/registration/registration_input.h"
#include "svort_ros/registration/template_registration.h"

namespace svort {

/// Where the brain that the slices form lies in the canonical frame: a rough volume is reconstructed from their current
/// poses and matched to the template closest in brain volume.
///
/// @param poses, weights one per slice
/// @param size_mm edge of the cube that the rough volume fills, around the centre of the masks
/// @return nothing if there is no template, or no brain in the volume; TemplateMatch::sure says whether to trust it
/// @throws std::invalid_argument naming what does not fit
std::optional<TemplateMatch> find_canonical_frame(const RegistrationInput& input, const std::vector<Pose>& poses,
                                                  const std::vector<double>& weights,
                                                  const std::vector<BrainTemplate>& templates, double size_mm,
                                                  const TemplateOptions& options = {});

}  // namespace svort
