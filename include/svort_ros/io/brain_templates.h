#pragma once

#include <filesystem>
#include <vector>

#include "svort_ros/registration/template_registration.h"

namespace svort {

/// Reads the brains of a folder, sorted by name: every .nii or .nii.gz but those that end in _mask or parc. X_mask
/// beside X, of the same size, is its brain mask.
///
/// A template's axes are those of its file, in LPS; its origin is the centre of its array, wherever the file puts it,
/// as that of the canonical space is. A number from 15 to 45 in the name is taken for the gestational age in weeks.
///
/// @param folder an empty path: no templates
/// @throws std::runtime_error naming folder or file: missing, no volume in it, what read_nifti() throws for, a mask of
///         another size
std::vector<BrainTemplate> load_templates(const std::filesystem::path& folder);

}  // namespace svort
