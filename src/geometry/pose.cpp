#include "svort_ros/geometry/pose.h"

#include <Eigen/LU>
#include <cmath>

namespace svort {

TransFirst trans_first_from_pose(const Pose& pose) {
  TransFirst matrix;
  matrix.leftCols<3>() = pose.linear();
  // R (x + t') = R x + t  =>  t' = R^T t
  matrix.col(3) = pose.linear().transpose() * pose.translation();
  return matrix;
}

Pose pose_from_trans_first(const TransFirst& matrix) {
  Pose pose = Pose::Identity();
  pose.linear() = matrix.leftCols<3>();
  pose.translation() = matrix.leftCols<3>() * matrix.col(3);
  return pose;
}

bool is_rigid(const Pose& pose, double tolerance) {
  const Eigen::Matrix3d linear = pose.linear();
  if (!linear.allFinite() || !pose.translation().allFinite()) return false;
  const Eigen::Matrix3d deviation = linear.transpose() * linear - Eigen::Matrix3d::Identity();
  return deviation.cwiseAbs().maxCoeff() <= tolerance && std::abs(linear.determinant() - 1.) <= tolerance;
}

double rotation_angle(const Pose& pose) {
  const Eigen::Matrix3d rotation = pose.linear();
  // atan2 of sine and cosine: arccos alone loses half the digits near 0 and pi.
  const Eigen::Vector3d twice_sine(rotation(2, 1) - rotation(1, 2), rotation(0, 2) - rotation(2, 0),
                                   rotation(1, 0) - rotation(0, 1));
  return std::atan2(twice_sine.norm(), rotation.trace() - 1.);
}

}  // namespace svort
