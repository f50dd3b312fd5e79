#include "svort_ros/registration/template_registration.h"

#include <gtest/gtest.h>

#include <cmath>
#include <cstddef>
#include <limits>
#include <stdexcept>
#include <vector>

#include "registration_fixture.h"
#include "svort_ros/registration/canonical_frame.h"

namespace svort {
namespace {

Volume head(const Pose& T_volume_head, double scale = 1.) {
  constexpr std::int64_t kSize = 48;
  const torch::Tensor values = svort_test::brain_volume(kSize, 2. / scale, [&] {
    Pose pose = T_volume_head;
    pose.translation() /= scale;
    return pose;
  }());
  Volume volume;
  volume.grid.size.setConstant(static_cast<int>(kSize));
  volume.grid.spacing.setConstant(2.);
  volume.values.assign(values.data_ptr<float>(), values.data_ptr<float>() + values.numel());
  return volume;
}

Pose turned(double angle, const Eigen::Vector3d& axis, const Eigen::Vector3d& shift) {
  Pose pose = Pose::Identity();
  pose.linear() = Eigen::AngleAxisd(angle, axis.normalized()).toRotationMatrix();
  pose.translation() = shift;
  return pose;
}

TEST(MatchTemplate, FindsAnyOrientation) {
  const BrainTemplate target{"head", 30., head(Pose::Identity())};
  const Pose poses[] = {turned(0., Eigen::Vector3d::UnitX(), {0., 0., 0.}), turned(2.5, {1., -2., .5}, {4., -3., 6.}),
                        turned(M_PI, {0., .3, 1.}, {-5., 2., 0.}), turned(1.4, {-1., .2, .1}, {0., 7., -2.})};
  for (const Pose& T_volume_head : poses) {
    const TemplateMatch match = match_template(head(T_volume_head), target);
    const Pose error = match.T_template_volume * T_volume_head;
    // A third of a 3 mm voxel, and as much at the brain's edge 30 mm away.
    EXPECT_LT(rotation_angle(error), 0.04);
    EXPECT_LT(error.translation().norm(), 1.);
    EXPECT_TRUE(match.sure) << match.correlation << " " << match.runner_up;
    EXPECT_TRUE(match.handedness_sure) << match.correlation << " " << match.mirrored << ": the head has no symmetry";
    EXPECT_NEAR(match.scale, 1., 0.03);
  }
}

TEST(MatchTemplate, AllowsForAnotherSize) {
  const BrainTemplate target{"head", 30., head(Pose::Identity())};
  const Pose T_volume_head = turned(1.9, {1., 1., -.4}, {3., 0., -4.});
  const TemplateMatch match = match_template(head(T_volume_head, 0.85), target);
  EXPECT_NEAR(match.scale, 0.85, 0.03);
  EXPECT_LT(rotation_angle(match.T_template_volume * T_volume_head), 0.05);
}

TEST(MatchTemplate, IsNotSureOfABall) {
  Volume ball = head(Pose::Identity());
  std::size_t offset = 0;
  for (int z = 0; z < ball.grid.size.z(); ++z)
    for (int y = 0; y < ball.grid.size.y(); ++y)
      for (int x = 0; x < ball.grid.size.x(); ++x, ++offset)
        ball.values[offset] = ball.grid.position(Eigen::Vector3d(x, y, z)).norm() < 26. ? 1.F : 0.F;
  const TemplateMatch match = match_template(ball, {"ball", 0., ball});
  EXPECT_FALSE(match.sure) << match.correlation << " " << match.runner_up;
}

TEST(MatchTemplate, TellsThatAMirroredHeadIsNotThisOne) {
  const BrainTemplate target{"head", 30., head(Pose::Identity())};
  Volume mirrored = target.volume;
  const auto n = mirrored.grid.size.x();
  for (auto row = mirrored.values.begin(); row != mirrored.values.end(); row += n) std::reverse(row, row + n);
  const TemplateMatch match = match_template(mirrored, target);
  EXPECT_GT(match.mirrored, match.correlation);
  EXPECT_FALSE(match.handedness_sure);
}

TEST(MatchTemplate, IsNotMisledByShading) {
  const BrainTemplate target{"head", 30., head(Pose::Identity())};
  const Pose T_volume_head = turned(2.2, {.3, -1., .8}, {3., 2., -4.});
  Volume shaded = head(T_volume_head);
  std::size_t offset = 0;
  for (int z = 0; z < shaded.grid.size.z(); ++z)
    for (int y = 0; y < shaded.grid.size.y(); ++y)
      for (int x = 0; x < shaded.grid.size.x(); ++x, ++offset)
        // From 0.6 to 1.6 over the head.
        shaded.values[offset] *=
            static_cast<float>(std::exp(0.016 * shaded.grid.position(Eigen::Vector3d(x, y, z)).x()));
  const TemplateMatch match = match_template(shaded, target);
  EXPECT_LT(rotation_angle(match.T_template_volume * T_volume_head), 0.06);
  EXPECT_TRUE(match.sure) << match.correlation << " " << match.runner_up;
}

/// The slices of a head at rest, in a frame that is turned and whose origin is far from the head.
TEST(FindCanonicalFrame, OfAHeadAwayFromTheOrigin) {
  svort_test::SimulatedScanOptions still;
  still.walk_mm = still.between_mm = 0.;
  still.slices = 22;  // all of the head
  const svort_test::SimulatedScan scan = svort_test::simulated_scan(still);
  const Pose T_frame_head = turned(1.7, {1., .4, -.6}, {35., -28., 22.});
  std::vector<Pose> poses;
  for (const Pose& pose : scan.truth) poses.push_back(T_frame_head * pose);
  const std::vector<BrainTemplate> templates = {{"head", 30., head(Pose::Identity())}};
  const std::vector<double> weights(poses.size(), 1.);
  const auto match = find_canonical_frame(scan.input, poses, weights, templates, 96., {});
  ASSERT_TRUE(match);
  const Pose error = match->T_template_volume * T_frame_head;
  EXPECT_LT(rotation_angle(error), 0.06);
  EXPECT_LT((error.translation()).norm(), 1.5);  // half a voxel
  EXPECT_TRUE(match->sure);
  // Without the fading of what only the tails of PSFs reach, the head would be 9 % too large.
  EXPECT_NEAR(match->scale, 1., 0.07);
}

TEST(FindCanonicalFrame, NeedsATemplateAndOneWeightPerSlice) {
  svort_test::SimulatedScanOptions one_stack;
  one_stack.stacks = 1;
  const svort_test::SimulatedScan scan = svort_test::simulated_scan(one_stack);
  const std::vector<double> weights(scan.truth.size(), 1.);
  EXPECT_FALSE(find_canonical_frame(scan.input, scan.truth, weights, {}, 96., {}));
  const std::vector<BrainTemplate> templates = {{"head", 30., head(Pose::Identity())}};
  EXPECT_THROW(find_canonical_frame(scan.input, scan.truth, {1.}, templates, 96., {}), std::invalid_argument);
  // Without a slice of any weight there is no brain.
  EXPECT_FALSE(
      find_canonical_frame(scan.input, scan.truth, std::vector<double>(scan.truth.size(), 0.), templates, 96.));
}

TEST(MatchTemplate, NamesWhatIsWrong) {
  const BrainTemplate target{"head", 30., head(Pose::Identity())};
  Volume flat = target.volume;
  std::fill(flat.values.begin(), flat.values.end(), 0.F);
  EXPECT_THROW(match_template(flat, target), std::invalid_argument);
  EXPECT_THROW(match_template(Volume(), target), std::invalid_argument);
  Volume broken = target.volume;
  broken.values[5] = std::numeric_limits<float>::quiet_NaN();
  EXPECT_THROW(match_template(broken, target), std::invalid_argument);
  TemplateOptions options;
  options.rotations = 3;
  EXPECT_THROW(match_template(target.volume, target, options), std::invalid_argument);
  options = {};
  options.wide_blur_mm = options.blur_mm;
  EXPECT_THROW(match_template(target.volume, target, options), std::invalid_argument);
}

TEST(NearestTemplates, AreThoseOfTheSameSize) {
  const std::vector<BrainTemplate> templates = {{"small", 22., head(Pose::Identity(), 0.7)},
                                                {"large", 34., head(Pose::Identity())},
                                                {"middle", 28., head(Pose::Identity(), 0.85)}};
  const double volume = brain_volume_mm3(head(Pose::Identity(), 0.9));
  EXPECT_EQ(nearest_templates(templates, volume, 2), (std::vector<std::size_t>{2, 1}));
  EXPECT_TRUE(nearest_templates({}, volume, 2).empty());
}

}  // namespace
}  // namespace svort
