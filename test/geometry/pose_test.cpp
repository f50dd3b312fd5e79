#include "svort_ros/geometry/pose.h"

#include <gtest/gtest.h>

#include <cmath>
#include <limits>
#include <random>

namespace svort {
namespace {

Pose random_pose(std::mt19937* generator) {
  std::normal_distribution<double> normal;
  Eigen::Quaterniond rotation(normal(*generator), normal(*generator), normal(*generator), normal(*generator));
  Pose pose = Pose::Identity();
  pose.linear() = rotation.normalized().toRotationMatrix();
  pose.translation() = 50. * Eigen::Vector3d(normal(*generator), normal(*generator), normal(*generator));
  return pose;
}

TEST(Pose, TransFirstIsTheSameMap) {
  std::mt19937 generator(1);
  for (int i = 0; i < 50; ++i) {
    const Pose pose = random_pose(&generator);
    const TransFirst matrix = trans_first_from_pose(pose);
    const Eigen::Vector3d x(3., -20., 41.);
    EXPECT_LT((matrix.leftCols<3>() * (x + matrix.col(3)) - pose * x).norm(), 1e-11);
    EXPECT_TRUE(pose_from_trans_first(matrix).isApprox(pose, 1e-13));
  }
}

TEST(Pose, RotationAngle) {
  for (const double angle : {0., 1e-9, 1e-4, 0.3, 1.5, 3.0, M_PI - 1e-7, M_PI}) {
    const Pose pose(Eigen::AngleAxisd(angle, Eigen::Vector3d(1., -2., 0.5).normalized()));
    EXPECT_NEAR(rotation_angle(pose), angle, 1e-12 + 1e-9 * angle);
  }
}

TEST(Pose, RigidOrNot) {
  std::mt19937 generator(2);
  EXPECT_TRUE(is_rigid(random_pose(&generator)));
  Pose mirrored = Pose::Identity();
  mirrored.linear() = Eigen::Vector3d(1., 1., -1.).asDiagonal();
  EXPECT_FALSE(is_rigid(mirrored));
  Pose scaled = Pose::Identity();
  scaled.linear() *= 1.001;
  EXPECT_FALSE(is_rigid(scaled));
  EXPECT_TRUE(is_rigid(scaled, 0.01));
  Pose undefined = Pose::Identity();
  undefined.translation().x() = std::numeric_limits<double>::quiet_NaN();
  EXPECT_FALSE(is_rigid(undefined));
}

}  // namespace
}  // namespace svort
