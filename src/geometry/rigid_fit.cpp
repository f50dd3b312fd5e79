#include "svort_ros/geometry/rigid_fit.h"

#include <Eigen/Geometry>
#include <algorithm>
#include <array>
#include <stdexcept>
#include <string>
#include <utility>

namespace svort {
namespace {

std::array<Eigen::Vector3d, 3> points_of_plane(double half_field_mm) {
  return {Eigen::Vector3d(-half_field_mm, -half_field_mm, 0.), Eigen::Vector3d::Zero(),
          Eigen::Vector3d(half_field_mm, -half_field_mm, 0.)};
}

}  // namespace

Pose fit_points(const Eigen::Matrix3Xd& from, const Eigen::Matrix3Xd& to) {
  if (from.cols() == 0 || from.cols() != to.cols())
    throw std::invalid_argument("fit_points: " + std::to_string(from.cols()) + " and " + std::to_string(to.cols()) +
                                " points; there must be as many of both, and one at least");
  return Pose(Eigen::umeyama(from, to, false));
}

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
  return fit_points(a, b);
}

Pose fit_most_planes(const std::vector<Pose>& from, const std::vector<Pose>& to, double half_field_mm) {
  Pose fit = fit_planes(from, to, half_field_mm);
  const std::size_t half = (from.size() + 1) / 2;
  /// Planes from the closest to the farthest, and the distance of the one in the middle.
  const auto ranked = [&](const Pose& motion) {
    std::vector<std::pair<double, std::size_t>> planes;
    for (std::size_t i = 0; i < from.size(); ++i)
      planes.emplace_back(plane_distance(motion * from[i], to[i], half_field_mm), i);
    std::nth_element(planes.begin(), planes.begin() + static_cast<std::ptrdiff_t>(half - 1), planes.end());
    return planes;
  };
  // Each plane has its say: one of those that agree is close to what they agree on.
  double best = ranked(fit)[half - 1].first;
  for (std::size_t i = 0; i < from.size(); ++i) {
    const Pose own = to[i] * from[i].inverse();
    const double median = ranked(own)[half - 1].first;
    if (median >= best) continue;
    best = median;
    fit = own;
  }
  constexpr int kRounds = 5;
  for (int round = 0; round < kRounds; ++round) {
    const auto planes = ranked(fit);
    std::vector<Pose> close_from, close_to;
    for (std::size_t k = 0; k < half; ++k) {
      close_from.push_back(from[planes[k].second]);
      close_to.push_back(to[planes[k].second]);
    }
    fit = fit_planes(close_from, close_to, half_field_mm);
  }
  return fit;
}

double plane_distance(const Pose& a, const Pose& b, double half_field_mm) {
  double farthest = 0.;
  for (const Eigen::Vector3d& point : points_of_plane(half_field_mm))
    farthest = std::max(farthest, (a * point - b * point).norm());
  return farthest;
}

}  // namespace svort
