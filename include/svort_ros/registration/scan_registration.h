#pragma once

#include <atomic>
#include <optional>
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
/// @param starts  at least one; each one pose per slice. The last one is also where stacks are put together from, and
///                pieces are searched for
/// @param stop    if not null, no further step (a refinement, the stacks' matching, a piece) is begun once this is set,
///                and the best until then is returned
/// @throws std::invalid_argument naming what does not fit
Refinement register_scan(const RegistrationInput& input, const std::vector<std::vector<Pose>>& starts, double size_mm,
                         const RefinementOptions& options = {}, const TemplateOptions& match = {},
                         const std::atomic<bool>* stop = nullptr);

/// What register_scan() searches for, for a scan that is still growing and whose poses have been followed: slices that
/// lie elsewhere because the head has jumped. Without the finest level (2 mm, or RefinementOptions::finest_mm if that
/// is coarser), and quick if the pieces agree where they are.
///
/// @param followed one pose per slice
/// @param guess    the same, from elsewhere, tried before anything is searched for; or empty
/// @param stop     if not null, the search gives up soon after this is set
/// @return nothing if no poses are clearly better than `followed`, or fewer than 8 slices lie across the first stack
///         (the pieces of one stack agree anywhere); else poses in a frame of their own
/// @throws std::invalid_argument naming what does not fit
std::optional<Refinement> search_scan(const RegistrationInput& input, const std::vector<Pose>& followed,
                                      const std::vector<Pose>& guess, double size_mm,
                                      const RefinementOptions& options = {}, const TemplateOptions& match = {},
                                      const std::atomic<bool>* stop = nullptr);

/// How well a scan's poses agree: its pieces, runs of about 8 slices, each correlated with the volume of all others,
/// blurred (4 mm pixels).
/// @param poses one per slice
/// @return in [-1, 1]; NaN if fewer than 8 slices lie across the first stack: the pieces of one stack agree anywhere
/// @throws std::invalid_argument naming what does not fit
double coarse_agreement(const RegistrationInput& input, const std::vector<Pose>& poses);

}  // namespace svort
