#include "rotation_grid.h"

#include <cmath>

namespace svort {

std::vector<Eigen::Quaterniond> spread_rotations(int count) {
  constexpr double kPhi = 1.41421356237309504880, kPsi = 1.533751168755204288118041;
  std::vector<Eigen::Quaterniond> rotations;
  for (int i = 0; i < count; ++i) {
    const double s = i + 0.5, t = s / count;
    const double r = std::sqrt(t), big = std::sqrt(1. - t);
    const double alpha = 2. * M_PI * s / kPhi, beta = 2. * M_PI * s / kPsi;
    rotations.emplace_back(big * std::cos(beta), r * std::sin(alpha), r * std::cos(alpha), big * std::sin(beta));
  }
  return rotations;
}

}  // namespace svort
