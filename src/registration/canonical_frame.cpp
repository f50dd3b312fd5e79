#include "svort_ros/registration/canonical_frame.h"

#include <torch/types.h>

#include <cmath>

#include "svort_ros/registration/pose_refinement.h"

namespace svort {

std::optional<TemplateMatch> find_canonical_frame(const RegistrationInput& input, const std::vector<Pose>& poses,
                                                  const std::vector<double>& weights,
                                                  const std::vector<BrainTemplate>& templates, double size_mm,
                                                  const TemplateOptions& options) {
  if (templates.empty()) return std::nullopt;
  Volume rough;
  rough.grid.size.setConstant(static_cast<int>(std::lround(size_mm / options.voxel_mm)));
  rough.grid.spacing.setConstant(options.voxel_mm);
  const torch::Tensor volume = reconstruct_weighted(input, poses, weights, rough.grid.size.x(), options.voxel_mm);
  rough.values.assign(volume.data_ptr<float>(), volume.data_ptr<float>() + volume.numel());
  const double brain = brain_volume_mm3(rough);
  if (!(brain > 0.)) return std::nullopt;
  return match_template(rough, templates[nearest_templates(templates, brain, 1).front()], options);
}

}  // namespace svort
