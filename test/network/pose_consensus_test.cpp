#include "svort_ros/network/pose_consensus.h"

#include <gtest/gtest.h>
#include <torch/types.h>

#include <cmath>
#include <limits>

#include "svort_ros/geometry/rigid_transform.h"

namespace {

using svort::ConsensusOptions;
using svort::PoseVotes;

const svort::AnchorFrame kFrame = {64, 64, 2.};

// `stacks` orthogonal stacks of `count` slices, 3 mm apart, in one frame.
PoseVotes orthogonal_stacks(int stacks, int count) {
  torch::Tensor axisangle = torch::zeros({stacks * count, 6});
  torch::Tensor stack = torch::zeros({stacks * count}, torch::kInt64);
  for (int s = 0; s < stacks; ++s) {
    for (int i = 0; i < count; ++i) {
      if (s > 0) axisangle[s * count + i][s - 1] = M_PI / 2.;
      axisangle[s * count + i][5] = 3. * (i - (count - 1) / 2.);
      stack[s * count + i] = s;
    }
  }
  PoseVotes votes;
  votes.nominal = svort::axisangle_to_matrix(axisangle);
  votes.stack = stack;
  votes.frame = kFrame;
  return votes;
}

torch::Tensor motion(double rx, double ry, double rz, double x, double y, double z) {
  return svort::axisangle_to_matrix(torch::tensor({rx, ry, rz, x, y, z}, torch::kFloat32).unsqueeze(0));
}

torch::Tensor points_after(const torch::Tensor& moved_by, const PoseVotes& votes) {
  const auto n = votes.nominal.size(0);
  return svort::anchor_points_from_matrix(
      svort::compose_transforms(moved_by.expand({n, 3, 4}).contiguous(), votes.nominal), kFrame);
}

torch::Tensor reflected(const torch::Tensor& points) {
  return points * torch::tensor({-1., 1., 1., -1., 1., 1., -1., 1., 1.}, torch::kFloat64).to(points.scalar_type());
}

// Mean distance of the anchor points under the found and the true motion, mm.
double error_mm(const torch::Tensor& found, const torch::Tensor& truth, const PoseVotes& votes) {
  const torch::Tensor here = svort::anchor_points_from_matrix(svort::compose_transforms(found, votes.nominal), kFrame);
  return (here - points_after(truth, votes)).view({-1, 3, 3}).norm(2, 2).mean().item<double>();
}

TEST(PoseConsensus, PerfectVotesGiveTheMotion) {
  PoseVotes votes = orthogonal_stacks(3, 8);
  const torch::Tensor truth = motion(1.9, -0.8, 0.4, 12., -7., 30.);
  votes.direct = points_after(truth, votes);
  EXPECT_LT(error_mm(svort::pose_consensus(votes, {}), truth, votes), 1e-3);  // rounding of float32 votes
}

TEST(PoseConsensus, VotesThatAreMirroredAtRandomAndNoisyStillAgree) {
  torch::manual_seed(3);
  PoseVotes votes = orthogonal_stacks(3, 12);
  const torch::Tensor truth = motion(-0.7, 2.0, 1.1, -5., 4., 9.);
  const torch::Tensor exact = points_after(truth, votes);
  const torch::Tensor flip = (torch::rand({exact.size(0), 1}) < 0.5);
  votes.mirrored = torch::where(flip, reflected(exact), exact) + 8. * torch::randn_like(exact);
  // As a plain regression answers when it cannot tell: the mean of both.
  votes.direct = 0.5 * (exact + reflected(exact)) + 8. * torch::randn_like(exact);
  // 36 slices of 9 coordinates with 8 mm of noise: about 1 mm is left of it.
  EXPECT_LT(error_mm(svort::pose_consensus(votes, {}), truth, votes), 4.);
}

TEST(PoseConsensus, AThirdOfWildVotesDoesNotMatter) {
  torch::manual_seed(4);
  PoseVotes votes = orthogonal_stacks(3, 10);
  const torch::Tensor truth = motion(0.3, 0.2, -2.5, 3., 3., 3.);
  votes.direct = points_after(truth, votes) + 3. * torch::randn({30, 9});
  for (int i = 0; i < 30; i += 3) votes.direct[i] = 100. * torch::randn({9});
  EXPECT_LT(error_mm(svort::pose_consensus(votes, {}), truth, votes), 2.5);
}

TEST(PoseConsensus, ConfidentVotesCountMore) {
  PoseVotes votes = orthogonal_stacks(2, 6);
  const torch::Tensor truth = motion(0., 0., 0., 5., 0., 0.), other = motion(0., 0., 0., -5., 0., 0.);
  votes.direct = torch::cat({points_after(truth, votes).slice(0, 0, 6), points_after(other, votes).slice(0, 6, 12)});
  votes.scale = torch::cat({torch::full({6}, 2.), torch::full({6}, 60.)});
  EXPECT_LT(error_mm(svort::pose_consensus(votes, {}), truth, votes), 1.);
}

TEST(PoseConsensus, StacksWithoutACommonFrameAreSolvedOnTheirOwn) {
  PoseVotes votes = orthogonal_stacks(2, 9);
  const torch::Tensor first = motion(1., 0., 0.5, 0., 10., 0.), second = motion(0., -2., 0.1, 4., 0., -20.);
  votes.direct = torch::cat({points_after(first, votes).slice(0, 0, 9), points_after(second, votes).slice(0, 9, 18)});
  votes.common_frame = false;
  const torch::Tensor found = svort::pose_consensus(votes, {});
  EXPECT_TRUE(torch::allclose(found.slice(0, 0, 9), first.expand({9, 3, 4}), 1e-4, 1e-3));
  EXPECT_TRUE(torch::allclose(found.slice(0, 9, 18), second.expand({9, 3, 4}), 1e-4, 1e-3));
}

TEST(PoseConsensus, AStackMayDeviateAsFarAsThePriorLetsIt) {
  PoseVotes votes = orthogonal_stacks(3, 8);
  const torch::Tensor common = motion(0., 0., 0., 0., 0., 0.), own = motion(0., 0., 0., 6., 0., 0.);
  votes.direct = torch::cat({points_after(common, votes).slice(0, 0, 16), points_after(own, votes).slice(0, 16, 24)});
  ConsensusOptions options;
  const auto x_of_third = [&](double prior) {
    options.stack_prior = prior;
    return svort::trans_first_to_last(svort::pose_consensus(votes, options))[20][0][3].item<double>();
  };
  const double together = x_of_third(-1.), loose = x_of_third(0.), held = x_of_third(8.);
  EXPECT_LT(together, 3.);
  EXPECT_NEAR(loose, 6., 0.01);
  EXPECT_GT(held, together + 0.5);
  EXPECT_LT(held, loose - 0.5);
}

TEST(PoseConsensus, OneSliceVotesForItself) {
  PoseVotes votes = orthogonal_stacks(1, 1);
  const torch::Tensor truth = motion(0.5, -0.5, 2., 1., 2., 3.);
  votes.direct = points_after(truth, votes);
  EXPECT_LT(error_mm(svort::pose_consensus(votes, {}), truth, votes), 1e-3);
}

TEST(PoseConsensus, PointsOnALineGiveARigidMotionAllTheSame) {
  PoseVotes votes = orthogonal_stacks(1, 3);
  votes.direct = torch::zeros({3, 9});
  const torch::Tensor found = svort::pose_consensus(votes, {});
  EXPECT_TRUE(svort::is_rigid(svort::pose_from_tensor(found[0])));
  EXPECT_TRUE(found.isfinite().all().item<bool>());
}

TEST(PoseConsensus, RejectsWhatDoesNotFit) {
  PoseVotes votes = orthogonal_stacks(1, 3);
  votes.direct = torch::zeros({3, 9});
  PoseVotes wrong = votes;
  wrong.direct = torch::zeros({3, 8});
  EXPECT_THROW(svort::pose_consensus(wrong, {}), std::invalid_argument);
  wrong = votes;
  wrong.direct = torch::full({3, 9}, std::numeric_limits<float>::quiet_NaN());
  EXPECT_THROW(svort::pose_consensus(wrong, {}), std::invalid_argument);
  wrong = votes;
  wrong.stack = torch::zeros({3});
  EXPECT_THROW(svort::pose_consensus(wrong, {}), std::invalid_argument);
  ConsensusOptions options;
  options.robust_mm = 0.;
  EXPECT_THROW(svort::pose_consensus(votes, options), std::invalid_argument);
}

}  // namespace
