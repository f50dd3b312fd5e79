#pragma once

#include <string>
#include <vector>

#include "svort_ros/geometry/image_grid.h"
#include "svort_ros/geometry/pose.h"

namespace svort {

struct TemplateOptions {
  double voxel_mm = 3.;            ///< both volumes are brought to this voxel size
  double blur_mm = 2.;             ///< and blurred by this standard deviation
  double wide_blur_mm = 8.;        ///< what is compared is brightness less this wider blur
  int rotations = 2000;            ///< tried all over SO(3)
  int refined = 16;                ///< of the best, refined over rotation, shift and size
  int samples = 1500;              ///< voxels that score a rotation
  double distinct_deg = 25.;       ///< two poses further apart than this are different answers
  double least_margin = 0.03;      ///< the answer is sure if its correlation is better than the runner-up's by this
  double least_correlation = 0.5;  ///< and at least this
  int seed = 1;                    ///< of the samples

  template <class Visitor>
  void visit(Visitor&& v) {
    v("voxel_mm", voxel_mm, "voxel size at which volume and template are compared, mm");
    v("blur_mm", blur_mm, "standard deviation of the blur of both, mm");
    v("wide_blur_mm", wide_blur_mm, "what is compared is brightness less a blur of this standard deviation, mm");
    v("rotations", rotations, "number of rotations tried all over SO(3)");
    v("refined", refined, "number of the best that are refined");
    v("samples", samples, "number of voxels that score a rotation");
    v("distinct_deg", distinct_deg, "two poses further apart than this are different answers, degrees");
    v("least_margin", least_margin, "the answer is sure if its correlation beats the runner-up's by this");
    v("least_correlation", least_correlation, "and is at least this");
    v("seed", seed, "of the random samples");
  }
};

/// A brain in canonical orientation: LPS axes, dark outside the brain.
struct BrainTemplate {
  std::string name;
  double gestational_age_weeks = 0.;  ///< 0: not known
  Volume volume;                      ///< cubic or not; its grid places it in the brain frame
};

struct TemplateMatch {
  Pose T_template_volume = Pose::Identity();  ///< from the volume's frame into the canonical frame, mm
  double scale = 1.;                          ///< the brain is this much smaller than the template (isotropic)
  double correlation = 0.;                    ///< of the structure, over the template's brain and a rim around it
  double runner_up = 0.;                      ///< correlation of the best answer further away than distinct_deg
  double mirrored = 0.;                       ///< correlation of the best answer to the template mirrored left to right
  bool sure = false;                          ///< correlation and margin over the runner-up are high enough
  bool handedness_sure = false;  ///< correlation beats the mirrored template's: left and right can be told apart
  std::string template_name;
};

/// @throws std::invalid_argument naming the option that is out of range
void validate(const TemplateOptions& options);

/// Brain volume (mm^3): the voxels above a quarter of the 0.99 quantile of the positive ones, holes included.
double brain_volume_mm3(const Volume& volume);

/// The templates closest in brain volume, at most `count`, best first.
std::vector<std::size_t> nearest_templates(const std::vector<BrainTemplate>& templates, double volume_mm3, int count);

/// Finds the pose of a rough volume of a brain in the canonical frame: centroids and sizes are matched, rotations all
/// over SO(3) are scored by the correlation of the brains' structure (brightness less a wide blur: brightness alone
/// knows little but an ellipsoid's outline), the best are refined over seven parameters.
///
/// Same input, options and seed: the same result, for any number of threads.
/// @throws std::invalid_argument naming an option that is out of range, or the volume that is empty or flat
TemplateMatch match_template(const Volume& volume, const BrainTemplate& target, const TemplateOptions& options = {});

}  // namespace svort
