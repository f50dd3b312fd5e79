#include "svort_ros/sequence/brain_roi.h"

#include <gtest/gtest.h>

#include "sequence/slice_fixture.h"

namespace svort {
namespace {

/// Brain: |x - 5| < 10, |y + 2| < 8 mm (slice coordinates), made of 1 x 1 mm pixels.
Slice square(const Pose& T_scanner_slice) {
  Slice slice = make_slice(0, 0);
  slice.info.T_scanner_slice = T_scanner_slice;
  slice.info.columns = 60;
  slice.info.rows = 50;
  slice.info.pixel_spacing = {1., 1.};
  slice.info.thickness = 3.;
  paint(
      slice, [](double, double) { return 1.; },
      [](double x, double y) { return std::abs(x - 5.) < 10. && std::abs(y + 2.) < 8.; });
  return slice;
}

TEST(BrainRoi, BoxOfOneSlice) {
  BrainRoi roi;
  EXPECT_TRUE(roi.empty());
  EXPECT_EQ(roi.centre(), Eigen::Vector3d::Zero());
  EXPECT_EQ(roi.extent(), Eigen::Vector3d::Zero());
  roi.add(square(Pose(Eigen::Translation3d(10., 20., 30.))));
  EXPECT_FALSE(roi.empty());
  EXPECT_TRUE(roi.from_masks());
  EXPECT_TRUE(roi.centre().isApprox(Eigen::Vector3d(15., 18., 30.), 1e-12));
  EXPECT_TRUE(roi.extent().isApprox(Eigen::Vector3d(20., 16., 3.), 1e-12));
  roi.clear();
  EXPECT_TRUE(roi.empty());
}

TEST(BrainRoi, RotatedSlice) {
  // x of the slice along z of the scanner, y along -y: z = x cross y along x.
  Eigen::Matrix3d rotation;
  rotation << 0., 0., 1., 0., -1., 0., 1., 0., 0.;
  Pose pose = Pose::Identity();
  pose.linear() = rotation;
  pose.translation() << 10., 20., 30.;
  ASSERT_TRUE(is_rigid(pose));
  BrainRoi roi;
  roi.add(square(pose));
  EXPECT_TRUE(roi.centre().isApprox(Eigen::Vector3d(10., 22., 35.), 1e-12));
  EXPECT_TRUE(roi.extent().isApprox(Eigen::Vector3d(3., 16., 20.), 1e-12));
}

TEST(BrainRoi, ObliqueSliceHoldsEveryPixelsCorners) {
  const Pose pose =
      Eigen::Translation3d(1., 2., 3.) * Pose(Eigen::AngleAxisd(0.7, Eigen::Vector3d(1., 1., 2.).normalized()));
  BrainRoi roi;
  roi.add(square(pose));
  Eigen::Vector3d lower = Eigen::Vector3d::Constant(1e9), upper = -lower;
  for (const double x : {-5., 15.})
    for (const double y : {-10., 6.})
      for (const double z : {-1.5, 1.5}) {
        lower = lower.cwiseMin(pose * Eigen::Vector3d(x, y, z));
        upper = upper.cwiseMax(pose * Eigen::Vector3d(x, y, z));
      }
  EXPECT_LT((roi.centre() - 0.5 * (lower + upper)).norm(), 1e-9);
  EXPECT_LT((roi.extent() - (upper - lower)).norm(), 1e-9);
}

TEST(BrainRoi, OrderDoesNotMatter) {
  BrainRoi forward, backward;
  for (int i = 0; i < 10; ++i) forward.add(make_slice(i % 3, i));
  for (int i = 9; i >= 0; --i) backward.add(make_slice(i % 3, i));
  EXPECT_EQ(forward.centre(), backward.centre());
  EXPECT_EQ(forward.extent(), backward.extent());
}

TEST(BrainRoi, SlicesWithoutMaskGiveWayToMasks) {
  Slice unmasked = square(Pose(Eigen::Translation3d(10., 20., 30.)));
  unmasked.mask.clear();
  BrainRoi roi;
  roi.add(unmasked);
  EXPECT_FALSE(roi.empty());
  EXPECT_FALSE(roi.from_masks());
  EXPECT_TRUE(roi.centre().isApprox(Eigen::Vector3d(10., 20., 30.), 1e-12));
  EXPECT_TRUE(roi.extent().isApprox(Eigen::Vector3d(60., 50., 3.), 1e-12));
  roi.add(square(Pose(Eigen::Translation3d(10., 20., 33.))));
  EXPECT_TRUE(roi.centre().isApprox(Eigen::Vector3d(15., 18., 33.), 1e-12));
  roi.add(unmasked);
  EXPECT_TRUE(roi.centre().isApprox(Eigen::Vector3d(15., 18., 33.), 1e-12));
}

}  // namespace
}  // namespace svort
