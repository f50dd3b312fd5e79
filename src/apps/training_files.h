#pragma once

#include <filesystem>
#include <string>
#include <vector>

#include "svort_ros/simulation/brain_volume.h"

namespace svort {

// What svort_train reads and draws. Where the package is built with its files, training_files.cpp: NIfTI volumes, and
// curves as PNG. In a build of the core alone, training_files_core.cpp: packs of volumes (.pt), and no pictures.

/// @throws std::runtime_error naming the file and what is wrong with it
std::vector<BrainVolume> read_training_volumes(const std::vector<std::string>& files);

/// training.png and validation.png from training.csv and validation.csv in the folder.
/// @param parts columns of losses
void plot_training(const std::filesystem::path& folder, const std::vector<std::string>& parts);

}  // namespace svort
