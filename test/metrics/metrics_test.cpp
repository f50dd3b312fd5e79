#include <gtest/gtest.h>
#include <torch/types.h>

#include <cmath>

#include "svort_ros/geometry/rigid_transform.h"
#include "svort_ros/metrics/image_similarity.h"
#include "svort_ros/metrics/pose_error.h"

namespace svort {
namespace {

torch::Tensor some_poses(std::int64_t count, double size) {
  torch::manual_seed(7);
  torch::Tensor axisangle = torch::randn({count, 6}, torch::kFloat64);
  axisangle.slice(1, 3) *= size;
  return axisangle_to_matrix(axisangle);
}

TEST(PoseErrors, OfAKnownShiftAndTurn) {
  const torch::Tensor truth = some_poses(5, 20.);
  // 3 mm along x of the brain frame moves every anchor by 3 mm and turns nothing.
  Pose shift = Pose::Identity();
  shift.translation().x() = 3.;
  const PoseErrors shifted = pose_errors(transformed_poses(shift, truth), truth, {});
  EXPECT_LT((shifted.points - 3.).abs().max().item<double>(), 1e-9);
  EXPECT_LT(shifted.gd.max().item<double>(), 1e-9);
  Pose turn = Pose::Identity();
  turn.linear() = Eigen::AngleAxisd(0.25, Eigen::Vector3d(1., 2., -1.).normalized()).toRotationMatrix();
  EXPECT_LT((pose_errors(transformed_poses(turn, truth), truth, {}).gd - 0.25).abs().max().item<double>(), 1e-9);
}

TEST(PoseErrors, HalfTurnIsTheLargestAngle) {
  const torch::Tensor truth = some_poses(4, 10.);
  Pose turn = Pose::Identity();
  turn.linear() = Eigen::AngleAxisd(M_PI, Eigen::Vector3d(0.6, 0., 0.8)).toRotationMatrix();
  // asin is steep there: 1e-16 in its argument is 1e-8 rad.
  EXPECT_NEAR(pose_errors(transformed_poses(turn, truth), truth, {}).gd[2].item<double>(), M_PI, 1e-6);
}

TEST(PoseErrors, RelativeErrorForgetsOneRigidTransformAndNoMore) {
  const torch::Tensor truth = some_poses(12, 25.);
  Pose frame = Pose::Identity();
  frame.linear() = Eigen::AngleAxisd(2.1, Eigen::Vector3d(1., -2., 0.5).normalized()).toRotationMatrix();
  frame.translation() << 40., -10., 5.;
  const torch::Tensor elsewhere = transformed_poses(frame, truth);
  EXPECT_GT(summarise(pose_errors(elsewhere, truth, {}).ed).mean, 40.);
  EXPECT_LT(summarise(relative_pose_errors(elsewhere, truth, {}).ed).maximum, 1e-9);
  const Pose found = global_alignment(elsewhere, truth, {});
  EXPECT_TRUE(found.isApprox(frame.inverse(), 1e-9));

  // One slice moved: the others keep most of the fit, that one keeps most of its error.
  torch::Tensor one_off = elsewhere.clone();
  Pose shift = Pose::Identity();
  shift.translation().z() = 12.;
  one_off.narrow(0, 3, 1).copy_(transformed_poses(shift, one_off.narrow(0, 3, 1)));
  const torch::Tensor ed = relative_pose_errors(one_off, truth, {}).ed;
  EXPECT_GT(ed[3].item<double>(), 9.);
  EXPECT_LT(ed[0].item<double>(), 3.);

  // A mirrored estimate is not rigid: no transform brings it home.
  torch::Tensor mirrored = truth.clone();
  mirrored.select(1, 0) *= -1.;
  EXPECT_GT(summarise(relative_pose_errors(mirrored, truth, {}).ed).mean, 5.);
}

TEST(PoseErrors, RefusesWhatDoesNotFit) {
  EXPECT_THROW(pose_errors(some_poses(3, 1.), some_poses(4, 1.), {}), std::invalid_argument);
  EXPECT_THROW(pose_errors(torch::zeros({3, 4}), some_poses(3, 1.), {}), std::invalid_argument);
  EXPECT_THROW(global_alignment(some_poses(0, 1.), some_poses(0, 1.), {}), std::invalid_argument);
}

TEST(Summary, OfValues) {
  const double nan = std::nan("");
  const ErrorSummary summary = summarise(torch::tensor({4., 1., nan, 3., 2.}, torch::kFloat64));
  EXPECT_EQ(summary.count, 4);
  EXPECT_DOUBLE_EQ(summary.mean, 2.5);
  EXPECT_DOUBLE_EQ(summary.median, 2.5);
  EXPECT_DOUBLE_EQ(summary.maximum, 4.);
  EXPECT_NEAR(summary.deviation, std::sqrt(5. / 3.), 1e-12);
  EXPECT_TRUE(std::isnan(summarise(torch::tensor({nan}, torch::kFloat64)).mean));
}

TEST(ImageSimilarity, MaskAndLimits) {
  torch::manual_seed(1);
  const torch::Tensor reference = torch::rand({20, 22}, torch::kFloat64);
  torch::Tensor test = reference.clone();
  EXPECT_TRUE(std::isinf(peak_signal_to_noise(test, reference)));
  EXPECT_NEAR(structural_similarity(test, reference, SsimWindow::gaussian).mean, 1., 1e-12);
  test.slice(0, 0, 10) += 0.5;
  SimilarityOptions lower;
  lower.mask = torch::zeros({20, 22}, torch::kBool);
  lower.mask.slice(0, 10) = true;
  EXPECT_EQ(mean_squared_error(test, reference, lower), 0.);
  EXPECT_NEAR(mean_squared_error(test, reference), 0.125, 1e-12);
  EXPECT_LT(structural_similarity(test, reference, SsimWindow::uniform).mean,
            structural_similarity(test, reference, SsimWindow::uniform, lower).mean);
  EXPECT_THROW(mean_squared_error(test, reference.slice(0, 1)), std::invalid_argument);
  EXPECT_THROW(structural_similarity(test.slice(0, 0, 6), reference.slice(0, 0, 6), SsimWindow::uniform),
               std::invalid_argument);
  lower.mask.zero_();
  EXPECT_THROW(mean_squared_error(test, reference, lower), std::invalid_argument);
}

}  // namespace
}  // namespace svort
