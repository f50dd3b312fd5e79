#pragma once

#include <vector>

#include "svort_ros/geometry/pose.h"
#include "svort_ros/registration/pose_refinement.h"
#include "svort_ros/registration/registration_input.h"
#include "svort_ros/registration/template_registration.h"

namespace svort {

/// Poses in which the stacks lie over each other, however far the head moved between them: each stack is registered to
/// itself alone, and the stacks' volumes are matched to each other with match_template(), over all rotations. The best
/// matches hold them together.
///
/// A stack that matches no other (correlation below TemplateOptions::least_correlation, or fewer than 8 slices, which
/// form no volume) stays where it was relative to the stack before it.
///
/// @param start   poses to start from, one per slice
/// @param size_mm edge of the cubes that the stacks' volumes fill, around the centre of their masks
/// @return one pose per slice, in a frame of their own; `start` itself if there is one stack only
/// @throws std::invalid_argument naming what does not fit
std::vector<Pose> assemble_stacks(const RegistrationInput& input, const std::vector<Pose>& start, double size_mm,
                                  const RefinementOptions& options = {}, const TemplateOptions& match = {});

/// refine_poses() of a whole scan, from every start and from assemble_stacks() of the last.
///
/// With several stacks the answer is the one whose pieces, runs of about 8 slices, correlate best with the volume of
/// all others. If they do not correlate well, the head has jumped within a stack: pieces are then searched for, one
/// after another, over turns of up to 80 degrees, and everything is refined from there, also with images that count 4
/// and 16 times as much as RefinementOptions::image_trust. That takes several times as long. With one stack it is the
/// answer of lowest cost.
///
/// @param starts  at least one; each one pose per slice
/// @throws std::invalid_argument naming what does not fit
Refinement register_scan(const RegistrationInput& input, const std::vector<std::vector<Pose>>& starts, double size_mm,
                         const RefinementOptions& options = {}, const TemplateOptions& match = {});

}  // namespace svort
