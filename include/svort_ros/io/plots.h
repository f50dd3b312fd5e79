#pragma once

#include <filesystem>
#include <string>
#include <utility>
#include <vector>

#include "svort_ros/geometry/image_grid.h"
#include "svort_ros/live/journal.h"

namespace svort {

/// PNG with the three orthogonal planes through the centre of the volume, labelled with patient directions and a
/// scale bar in mm. @throws std::runtime_error naming the file
void plot_volume_views(const std::filesystem::path& path, const Volume& volume, const std::string& title);

/// PNG with latency (ms) per arrival: pose and volume, against the repetition time found in the stamps.
/// @throws std::runtime_error naming the file
void plot_latency(const std::filesystem::path& path, const Journal& journal);

/// One line of plot_curves(). Points that are not finite are left out.
struct Curve {
  std::string name;
  std::vector<std::pair<double, double>> points;  ///< x, y; x ascending for a line
  bool dots = false;                              ///< single dots, not a line
};

/// The bytes of what plot_curves() writes. @throws std::runtime_error if it cannot be encoded
std::string curves_png(const std::string& title, const std::string& x_label, const std::string& y_label,
                       const std::vector<Curve>& curves);

/// PNG with curves over a common x axis, both axes from 0; what lies above the 0.98 quantile of all y is cut off.
/// @throws std::runtime_error naming the file
void plot_curves(const std::filesystem::path& path, const std::string& title, const std::string& x_label,
                 const std::string& y_label, const std::vector<Curve>& curves);

}  // namespace svort
