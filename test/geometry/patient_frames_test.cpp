#include "svort_ros/geometry/patient_frames.h"

#include <gtest/gtest.h>

#include <Eigen/LU>
#include <limits>
#include <stdexcept>

namespace svort {
namespace {

// An oblique stack in RAS: 1.2 x 0.9 mm pixels, 4 mm between slices; `handedness` -1 counts the slices backwards.
Eigen::Affine3d oblique_ras(double handedness) {
  Eigen::Affine3d affine = Eigen::Affine3d::Identity();
  affine.linear() = Eigen::AngleAxisd(0.7, Eigen::Vector3d(1., 2., -0.5).normalized()).toRotationMatrix() *
                    Eigen::Vector3d(1.2, 0.9, handedness * 4.).asDiagonal();
  affine.translation() = Eigen::Vector3d(-31., 12., 8.);
  return affine;
}

TEST(PatientFrames, LpsAndRasDifferByAHalfTurn) {
  const Eigen::Affine3d ras = oblique_ras(1.), lps = lps_from_ras(ras);
  const Eigen::Vector3d index(3., 7., 2.);
  const Eigen::Vector3d in_ras = ras * index;
  EXPECT_TRUE((lps * index).isApprox(Eigen::Vector3d(-in_ras.x(), -in_ras.y(), in_ras.z()), 1e-14));
  EXPECT_TRUE(ras_from_lps(lps).isApprox(ras, 1e-15));
}

TEST(PatientFrames, SlicePixelsLieWhereTheAffineSays) {
  const int columns = 20, rows = 31;
  for (const double handedness : {1., -1.}) {
    const Eigen::Affine3d ras = oblique_ras(handedness), lps = lps_from_ras(ras);
    ASSERT_EQ(lps.linear().determinant() > 0., handedness > 0.);
    for (const int index : {0, 5, 11}) {
      const SliceGeometry slice = slice_geometry_from_affine(lps, columns, rows, index);
      EXPECT_TRUE(is_rigid(slice.T_scanner_slice, 1e-12));
      EXPECT_NEAR(slice.pixel_spacing.x(), 1.2, 1e-12);
      EXPECT_NEAR(slice.pixel_spacing.y(), 0.9, 1e-12);
      for (const auto& [column, row] : {std::pair<int, int>{0, 0}, {columns - 1, 0}, {4, 30}}) {
        const Eigen::Vector3d in_slice((column - (columns - 1) / 2.) * slice.pixel_spacing.x(),
                                       (row - (rows - 1) / 2.) * slice.pixel_spacing.y(), 0.);
        const Eigen::Vector3d by_pose = slice.T_scanner_slice * in_slice;
        const Eigen::Vector3d in_ras = ras * Eigen::Vector3d(column, row, index);
        EXPECT_LT((by_pose - Eigen::Vector3d(-in_ras.x(), -in_ras.y(), in_ras.z())).norm(), 1e-11);
      }
      // z is x cross y, so it points along the slice count only in a right-handed stack.
      const Eigen::Matrix3d axes = slice.T_scanner_slice.linear();
      EXPECT_TRUE(axes.col(2).isApprox(axes.col(0).cross(axes.col(1)), 1e-12));
      EXPECT_EQ(axes.col(2).dot(lps.linear().col(2)) > 0., handedness > 0.);
    }
  }
}

TEST(PatientFrames, RejectsAffinesThatAreNoSlice) {
  Eigen::Affine3d affine = oblique_ras(1.);
  affine.linear().col(0).setZero();
  EXPECT_THROW(slice_geometry_from_affine(affine, 4, 4, 0), std::invalid_argument);
  affine = oblique_ras(1.);
  affine.linear().col(1) += 0.01 * affine.linear().col(0);
  EXPECT_THROW(slice_geometry_from_affine(affine, 4, 4, 0), std::invalid_argument);
  affine = oblique_ras(1.);
  affine.translation().y() = std::numeric_limits<double>::infinity();
  EXPECT_THROW(slice_geometry_from_affine(affine, 4, 4, 0), std::invalid_argument);
  EXPECT_THROW(slice_geometry_from_affine(oblique_ras(1.), 0, 4, 0), std::invalid_argument);
}

}  // namespace
}  // namespace svort
