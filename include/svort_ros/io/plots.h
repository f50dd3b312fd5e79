#pragma once

#include <filesystem>
#include <string>

#include "svort_ros/geometry/image_grid.h"
#include "svort_ros/live/journal.h"

namespace svort {

/// PNG with the three orthogonal planes through the centre of the volume, labelled with patient directions and a
/// scale bar in mm. @throws std::runtime_error naming the file
void plot_volume_views(const std::filesystem::path& path, const Volume& volume, const std::string& title);

/// PNG with latency (ms) per arrival: pose and volume, against the repetition time found in the stamps.
/// @throws std::runtime_error naming the file
void plot_latency(const std::filesystem::path& path, const Journal& journal);

}  // namespace svort
