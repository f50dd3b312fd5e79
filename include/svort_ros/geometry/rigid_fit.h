#pragma once

#include <vector>

#include "svort_ros/geometry/pose.h"

namespace svort {

/// The rigid motion that brings points closest to others (least squares): a rotation, also where a reflection would
/// come closer.
/// @param from, to one point per column
/// @throws std::invalid_argument if the counts differ or are zero
Pose fit_points(const Eigen::Matrix3Xd& from, const Eigen::Matrix3Xd& to);

/// The rigid motion that brings planes closest to others, by the three points of each plane that stand for it: its
/// centre, and two corners `half_field_mm` from it along both axes (least squares).
///
/// @param from, to one pose per plane
/// @throws std::invalid_argument if the counts differ or are zero
Pose fit_planes(const std::vector<Pose>& from, const std::vector<Pose>& to, double half_field_mm);

/// The same for planes some of which have gone elsewhere: by the half of them that agree best on one motion.
/// @throws std::invalid_argument if the counts differ or are zero
Pose fit_most_planes(const std::vector<Pose>& from, const std::vector<Pose>& to, double half_field_mm);

/// How far apart two planes are at the one of those points where they are furthest apart, mm.
double plane_distance(const Pose& a, const Pose& b, double half_field_mm);

}  // namespace svort
