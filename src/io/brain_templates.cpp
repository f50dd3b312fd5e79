#include "svort_ros/io/brain_templates.h"

#include <algorithm>
#include <cmath>
#include <regex>
#include <stdexcept>
#include <string>

#include "svort_ros/io/nifti.h"

namespace svort {
namespace {

bool ends_with(const std::string& text, const std::string& end) {
  return text.size() >= end.size() && text.compare(text.size() - end.size(), end.size(), end) == 0;
}

/// The name without .nii or .nii.gz; empty for other files.
std::string stem_of(const std::filesystem::path& path) {
  const std::string name = path.filename().string();
  for (const char* suffix : {".nii.gz", ".nii"})
    if (ends_with(name, suffix)) return name.substr(0, name.size() - std::string(suffix).size());
  return "";
}

double age_in(const std::string& name) {
  const std::regex number("[0-9]+(\\.[0-9]+)?");
  for (auto it = std::sregex_iterator(name.begin(), name.end(), number); it != std::sregex_iterator(); ++it) {
    const double weeks = std::stod(it->str());
    if (weeks >= 15. && weeks <= 45.) return weeks;
  }
  return 0.;
}

Volume centred_volume(NiftiImage image, const std::filesystem::path& path) {
  Eigen::Matrix3d axes = image.affine_lps.linear();
  for (int axis = 0; axis < 3; ++axis) axes.col(axis).normalize();
  if (axes.determinant() < 0.) {  // a pose has no mirror: turn the rows round instead
    axes.col(0) = -axes.col(0);
    const auto row = static_cast<std::ptrdiff_t>(image.size.x());
    for (auto begin = image.values.begin(); begin != image.values.end(); begin += row) std::reverse(begin, begin + row);
  }
  Volume volume;
  volume.grid.size = image.size;
  volume.grid.spacing = image.spacing;
  volume.grid.T_frame_grid.linear() = axes;
  if (!is_rigid(volume.grid.T_frame_grid, 1e-3))
    throw std::runtime_error(path.string() + ": its axes are not at right angles");
  volume.values = std::move(image.values);
  return volume;
}

}  // namespace

std::vector<BrainTemplate> load_templates(const std::filesystem::path& folder) {
  std::vector<BrainTemplate> templates;
  if (folder.empty()) return templates;
  if (!std::filesystem::is_directory(folder))
    throw std::runtime_error(folder.string() + ": no such folder of templates");
  std::vector<std::filesystem::path> files;
  for (const auto& entry : std::filesystem::directory_iterator(folder)) {
    const std::string stem = stem_of(entry.path());
    if (!stem.empty() && !ends_with(stem, "_mask") && !ends_with(stem, "parc")) files.push_back(entry.path());
  }
  std::sort(files.begin(), files.end());
  for (const auto& file : files) {
    const std::string stem = stem_of(file);
    NiftiImage image = read_nifti(file);
    for (const char* suffix : {"_mask.nii.gz", "_mask.nii"}) {
      const auto mask_file = folder / (stem + suffix);
      if (!std::filesystem::exists(mask_file)) continue;
      const NiftiImage mask = read_nifti(mask_file);
      if (mask.size != image.size)
        throw std::runtime_error(mask_file.string() + ": its size differs from the volume's");
      for (std::size_t i = 0; i < image.values.size(); ++i)
        if (!(mask.values[i] > 0.F)) image.values[i] = 0.F;
      break;
    }
    BrainTemplate brain;
    brain.name = stem;
    brain.gestational_age_weeks = age_in(stem);
    brain.volume = centred_volume(std::move(image), file);
    templates.push_back(std::move(brain));
  }
  if (templates.empty()) throw std::runtime_error(folder.string() + ": holds no NIfTI volume to use as a template");
  return templates;
}

}  // namespace svort
