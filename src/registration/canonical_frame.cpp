#include "svort_ros/registration/canonical_frame.h"

#include <stdexcept>

#include "rough_volume.h"

namespace svort {

std::optional<TemplateMatch> find_canonical_frame(const RegistrationInput& input, const std::vector<Pose>& poses,
                                                  const std::vector<double>& weights,
                                                  const std::vector<BrainTemplate>& templates, double size_mm,
                                                  const TemplateOptions& options) {
  if (templates.empty()) return std::nullopt;
  validate(input);
  if (poses.size() != input.count() || weights.size() != input.count())
    throw std::invalid_argument("find_canonical_frame: poses and weights must have one entry per slice");
  const Volume rough = rough_volume(input, poses, weights, size_mm, options.voxel_mm);
  const double brain = brain_volume_mm3(rough);
  if (!(brain > 0.)) return std::nullopt;
  return match_template(rough, templates[nearest_templates(templates, brain, 1).front()], options);
}

}  // namespace svort
