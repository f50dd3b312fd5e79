#pragma once

#include <Eigen/Geometry>

namespace svort {

/// Rigid transform in double precision, translation in mm. `T_a_b` maps coordinates of frame b into frame a.
using Pose = Eigen::Isometry3d;

/// 3 x 4 matrix [R|t] in the *trans_first* reading of the public SVoRT implementation: y = R (x + t).
using TransFirst = Eigen::Matrix<double, 3, 4>;

/// The same rigid map, written as [R|t] with y = R (x + t); t in mm.
TransFirst trans_first_from_pose(const Pose& pose);

/// Inverse of trans_first_from_pose.
Pose pose_from_trans_first(const TransFirst& matrix);

/// True if every entry is finite and the linear part is a rotation (orthonormal, determinant +1) within `tolerance`.
bool is_rigid(const Pose& pose, double tolerance = 1e-4);

/// Rotation angle of `pose` in radians, in [0, pi].
double rotation_angle(const Pose& pose);

}  // namespace svort
