#pragma once

#include <filesystem>
#include <string>
#include <vector>

#include "svort_ros/geometry/image_grid.h"
#include "svort_ros/simulation/brain_volume.h"

namespace svort {

/// Reads a volume to simulate scans of, in the canonical frame: axes reordered and reversed to LPS, origin at the
/// centre of the array. Volumes that are used together should be aligned with one another, as an atlas's ages are.
///
/// Labels of the CRL fetal brain atlas (37 to 125) become the classes of Tissue; other labels, 1 to 31, are taken as
/// classes as they are.
///
/// @param mask         brain mask; if empty, voxels above 0 are brain
/// @param parcellation tissue labels; may be empty
/// @throws std::runtime_error naming the file: what read_nifti() throws for, axes that are oblique by more than 1e-3 or
///         voxels that are not cubes (1e-3), a mask or parcellation of another size or place, a mask without brain,
///         labels that are no whole numbers or of neither kind
BrainVolume read_brain_volume(const std::filesystem::path& image, const std::filesystem::path& mask = {},
                              const std::filesystem::path& parcellation = {});

/// Reads several: NAME.nii or NAME.nii.gz with NAME_mask and NAME_parc or NAME_WMZparc beside it, as far as they are
/// there, or files of save_brain_volumes() (.pt). Names are the files'.
/// @throws std::runtime_error as read_brain_volume() and load_brain_volumes()
std::vector<BrainVolume> read_brain_volumes(const std::vector<std::string>& files);

/// The name of a volume's file, without folder and ending (.nii, .nii.gz).
std::string volume_name(const std::filesystem::path& file);

/// The volume as NIfTI would have it, for files.
Volume to_volume(const torch::Tensor& image, double resolution_mm);

}  // namespace svort
