#include "svort_ros/geometry/rigid_fit.h"

#include <gtest/gtest.h>

#include <cmath>
#include <random>
#include <stdexcept>

namespace svort {
namespace {

Pose random_pose(std::mt19937& random) {
  std::normal_distribution<double> normal;
  const auto vector = [&] { return Eigen::Vector3d(normal(random), normal(random), normal(random)); };
  Pose pose = Pose::Identity();
  pose.linear() = Eigen::AngleAxisd(2. * normal(random), vector().normalized()).toRotationMatrix();
  pose.translation() = 30. * vector();
  return pose;
}

TEST(FitPlanes, FindsTheMotionThatAllPlanesShare) {
  std::mt19937 random(1);
  const Pose motion = random_pose(random);
  std::vector<Pose> from, to;
  for (const std::size_t count : {1U, 2U, 20U}) {
    while (from.size() < count) {
      from.push_back(random_pose(random));
      to.push_back(motion * from.back());
    }
    // Rounding of coordinates of about 100 mm.
    EXPECT_LT((fit_planes(from, to, 50.).matrix() - motion.matrix()).cwiseAbs().maxCoeff(), 1e-10) << count;
  }
}

TEST(FitPlanes, ShiftsThatDisagreeAreAveraged) {
  // Two planes of the same axes, one off by 1 mm, the other by 3 mm, along their normal, side by side along it.
  Pose a = Pose::Identity(), b = Pose::Identity();
  a.translation().z() = -10.;
  b.translation().z() = 10.;
  Pose a_moved = a, b_moved = b;
  a_moved.translation().z() += 1.;
  b_moved.translation().z() += 3.;
  const Pose fit = fit_planes({a, b}, {a_moved, b_moved}, 50.);
  EXPECT_NEAR(fit.translation().z(), 2., 1e-10);
  EXPECT_LT(rotation_angle(fit), 1e-10);
}

TEST(FitPoints, FindsTheMotion) {
  std::mt19937 random(4);
  const Pose motion = random_pose(random);
  const Eigen::Matrix3Xd from = 40. * Eigen::Matrix3Xd::Random(3, 12);
  const Eigen::Matrix3Xd to = motion * from;
  EXPECT_LT((fit_points(from, to).matrix() - motion.matrix()).cwiseAbs().maxCoeff(), 1e-9);
  EXPECT_THROW(fit_points(from, to.leftCols(11)), std::invalid_argument);
  EXPECT_THROW(fit_points(from.leftCols(0), to.leftCols(0)), std::invalid_argument);
}

TEST(FitPoints, IsARotationAlsoWhereAReflectionComesCloser) {
  Eigen::Matrix3Xd from(3, 4);
  from << 1., 0., 0., -1., 0., 1., 0., -1., 0., 0., 1., -1.;
  Eigen::Matrix3Xd to = from;
  to.row(0) *= -1.;
  EXPECT_TRUE(is_rigid(fit_points(from, to)));
}

TEST(FitMostPlanes, IsNotMisledByPlanesThatWentElsewhere) {
  std::mt19937 random(2);
  std::normal_distribution<double> normal(0., 0.1);
  const Pose motion = random_pose(random);
  std::vector<Pose> from, to;
  for (int i = 0; i < 20; ++i) {
    from.push_back(random_pose(random));
    to.push_back(motion * from.back());
    to.back().translation() += Eigen::Vector3d(normal(random), normal(random), normal(random));
    if (i % 5 < 2) to.back() = random_pose(random) * to.back();
  }
  const auto error_mm = [&](const Pose& fit) { return plane_distance(fit, motion, 50.); };
  EXPECT_LT(error_mm(fit_most_planes(from, to, 50.)), 0.2);
  EXPECT_GT(error_mm(fit_planes(from, to, 50.)), 10.) << "which the mean of all is";
  EXPECT_LT(error_mm(fit_most_planes({from[2]}, {motion * from[2]}, 50.)), 1e-10);
}

TEST(PlaneDistance, IsTheLargestOfItsPoints) {
  Pose turned = Pose::Identity();
  turned.linear() = Eigen::AngleAxisd(M_PI / 2., Eigen::Vector3d::UnitX()).toRotationMatrix();
  EXPECT_EQ(plane_distance(turned, turned, 30.), 0.);
  // The corners (+-30, -30, 0) turn about x by 90 degrees: they end 30 sqrt(2) from where they were.
  EXPECT_NEAR(plane_distance(Pose::Identity(), turned, 30.), 30. * std::sqrt(2.), 1e-12);
  turned.translation().x() = 1.;
  EXPECT_NEAR(plane_distance(Pose::Identity(), turned, 0.), 1., 1e-12);
}

TEST(FitPlanes, NamesTheCountsThatDoNotFit) {
  EXPECT_THROW(fit_planes({}, {}, 50.), std::invalid_argument);
  EXPECT_THROW(fit_most_planes({}, {}, 50.), std::invalid_argument);
  EXPECT_THROW(fit_planes({Pose::Identity()}, {Pose::Identity(), Pose::Identity()}, 50.), std::invalid_argument);
}

}  // namespace
}  // namespace svort
