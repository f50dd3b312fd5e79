#include "svort_ros/geometry/rigid_fit.h"

#include <Eigen/Geometry>
#include <algorithm>
#include <array>
#include <stdexcept>
#include <string>

namespace svort {
namespace {

std::array<Eigen::Vector3d, 3> points_of_plane(double half_field_mm) {
  return {Eigen::Vector3d(-half_field_mm, -half_field_mm, 0.), Eigen::Vector3d::Zero(),
          Eigen::Vector3d(half_field_mm, -half_field_mm, 0.)};
}

}  // namespace

Pose fit_planes(const std::vector<Pose>& from, const std::vector<Pose>& to, double half_field_mm) {
  if (from.empty() || from.size() != to.size())
    throw std::invalid_argument("fit_planes: " + std::to_string(from.size()) + " and " + std::to_string(to.size()) +
                                " planes; there must be as many of both, and one at least");
  const auto n = static_cast<Eigen::Index>(from.size());
  const std::array<Eigen::Vector3d, 3> corner = points_of_plane(half_field_mm);
  Eigen::Matrix3Xd a(3, 3 * n), b(3, 3 * n);
  for (Eigen::Index i = 0; i < n; ++i) {
    const auto k = static_cast<std::size_t>(i);
    for (Eigen::Index j = 0; j < 3; ++j) {
      a.col(3 * i + j) = from[k] * corner[static_cast<std::size_t>(j)];
      b.col(3 * i + j) = to[k] * corner[static_cast<std::size_t>(j)];
    }
  }
  return Pose(Eigen::umeyama(a, b, false));
}

double plane_distance(const Pose& a, const Pose& b, double half_field_mm) {
  double farthest = 0.;
  for (const Eigen::Vector3d& point : points_of_plane(half_field_mm))
    farthest = std::max(farthest, (a * point - b * point).norm());
  return farthest;
}

}  // namespace svort
