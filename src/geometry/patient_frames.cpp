#include "svort_ros/geometry/patient_frames.h"

#include <cmath>
#include <sstream>
#include <stdexcept>

namespace svort {
namespace {

// Relative tolerance on the right angle between the in-plane axes; what remains is absorbed by the pose.
constexpr double kOrthogonalityTolerance = 1e-3;

Eigen::Affine3d half_turn_about_z(const Eigen::Affine3d& affine) {
  return Eigen::Affine3d(Eigen::Scaling(-1., -1., 1.)) * affine;
}

}  // namespace

Eigen::Affine3d lps_from_ras(const Eigen::Affine3d& affine_ras) { return half_turn_about_z(affine_ras); }

Eigen::Affine3d ras_from_lps(const Eigen::Affine3d& affine_lps) { return half_turn_about_z(affine_lps); }

SliceGeometry slice_geometry_from_affine(const Eigen::Affine3d& affine_lps, int columns, int rows, int index) {
  if (columns <= 0 || rows <= 0) {
    std::ostringstream message;
    message << "slice_geometry_from_affine: a slice of " << columns << " x " << rows << " pixels is empty";
    throw std::invalid_argument(message.str());
  }
  if (!affine_lps.matrix().allFinite()) {
    throw std::invalid_argument("slice_geometry_from_affine: the affine holds values that are not finite");
  }
  const Eigen::Vector3d along_columns = affine_lps.linear().col(0);
  const Eigen::Vector3d along_rows = affine_lps.linear().col(1);
  SliceGeometry geometry;
  geometry.pixel_spacing = {along_columns.norm(), along_rows.norm()};
  if (!(geometry.pixel_spacing.minCoeff() > 0.)) {
    throw std::invalid_argument("slice_geometry_from_affine: an in-plane axis of the affine has zero length");
  }
  const Eigen::Vector3d x = along_columns / geometry.pixel_spacing.x();
  const Eigen::Vector3d y_raw = along_rows / geometry.pixel_spacing.y();
  if (std::abs(x.dot(y_raw)) > kOrthogonalityTolerance) {
    std::ostringstream message;
    message << "slice_geometry_from_affine: the in-plane axes are not orthogonal (cosine " << x.dot(y_raw)
            << ", at most " << kOrthogonalityTolerance << ")";
    throw std::invalid_argument(message.str());
  }
  const Eigen::Vector3d z = x.cross(y_raw).normalized();
  const Eigen::Vector3d y = z.cross(x);
  geometry.T_scanner_slice.linear() << x, y, z;
  geometry.T_scanner_slice.translation() = affine_lps * Eigen::Vector3d(0.5 * (columns - 1), 0.5 * (rows - 1), index);
  return geometry;
}

}  // namespace svort
