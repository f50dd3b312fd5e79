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

// A head that rests, jumps before slice 14 and rests again; in a frame that is known, if `start` is the truth's.
torch::Tensor jumping_head(std::int64_t n, const torch::Tensor& before, const torch::Tensor& after) {
  return torch::cat({before.expand({14, 3, 4}), after.expand({n - 14, 3, 4})}).contiguous();
}

// The same for a motion of every slice.
double trajectory_error_mm(const torch::Tensor& found, const torch::Tensor& truth, const PoseVotes& votes) {
  const torch::Tensor nominal = votes.nominal.slice(0, 0, truth.size(0));
  const auto points = [&](const torch::Tensor& motions) {
    return svort::anchor_points_from_matrix(svort::compose_transforms(motions, nominal), kFrame);
  };
  return (points(found) - points(truth)).view({-1, 3, 3}).norm(2, 2).mean().item<double>();
}

TEST(TrajectoryConsensus, FindsAJumpThatNoSingleVoteTells) {
  torch::manual_seed(5);
  PoseVotes votes = orthogonal_stacks(3, 12);
  const torch::Tensor before = motion(0.4, -0.2, 1.1, 3., 5., -2.), after = motion(1.1, -0.6, 0.9, 15., 0., 8.);
  const torch::Tensor truth = jumping_head(36, before, after);
  const torch::Tensor exact = svort::anchor_points_from_matrix(svort::compose_transforms(truth, votes.nominal), kFrame);
  constexpr double kNoise = 8.;  // per coordinate: 13 mm per point
  votes.direct = exact + kNoise * torch::randn_like(exact);
  const torch::Tensor flip = (torch::rand({36, 1}) < 0.5);
  votes.mirrored = torch::where(flip, reflected(exact), exact) + kNoise * torch::randn_like(exact);
  votes.scale = torch::full({36}, 13.);
  const torch::Tensor still = svort::pose_consensus(votes, {});
  const torch::Tensor found = svort::trajectory_consensus(votes, still, {});
  EXPECT_GT(trajectory_error_mm(still, truth, votes), 15.);
  EXPECT_LT(trajectory_error_mm(found, truth, votes), 6.);
  // Votes from two sides count as much together as those from one.
  PoseVotes twice = votes;
  for (auto member :
       {&PoseVotes::nominal, &PoseVotes::direct, &PoseVotes::mirrored, &PoseVotes::scale, &PoseVotes::stack})
    twice.*member = torch::cat({votes.*member, votes.*member});
  EXPECT_LT(trajectory_error_mm(svort::trajectory_consensus(twice, still, {}), found, votes), 0.1);
  EXPECT_GT(svort::vote_agreement(votes, found, {}), svort::vote_agreement(votes, still, {}));
}

TEST(TrajectoryConsensus, AHeadAtRestStaysSoMoreTheMoreItsMotionCosts) {
  torch::manual_seed(6);
  PoseVotes votes = orthogonal_stacks(3, 12);
  const torch::Tensor truth = motion(0.4, -0.2, 1.1, 3., 5., -2.).expand({36, 3, 4}).contiguous();
  votes.direct = points_after(truth[0].unsqueeze(0), votes) + 8. * torch::randn({36, 9});
  votes.scale = torch::full({36}, 13.);
  const torch::Tensor still = svort::pose_consensus(votes, {});
  ConsensusOptions options;
  double last = 1e9;
  for (const double cost : {0.02, 0.2, 2.}) {
    options.motion_cost = cost;
    const torch::Tensor found = svort::trajectory_consensus(votes, still, options);
    const double moved = trajectory_error_mm(found, found[0].unsqueeze(0).expand({36, 3, 4}).contiguous(), votes);
    EXPECT_LT(moved, last) << cost;
    last = moved;
  }
  EXPECT_LT(last, 0.5);
  EXPECT_EQ(svort::vote_agreement(votes, still, {}), 1.);
}

TEST(TrajectoryConsensus, StacksWithoutACommonFrameAreNotTied) {
  PoseVotes votes = orthogonal_stacks(2, 9);
  const torch::Tensor first = motion(1., 0., 0.5, 0., 10., 0.), second = motion(0., -2., 0.1, 4., 0., -20.);
  const torch::Tensor truth = torch::cat({first.expand({9, 3, 4}), second.expand({9, 3, 4})}).contiguous();
  votes.direct = svort::anchor_points_from_matrix(svort::compose_transforms(truth, votes.nominal), kFrame);
  votes.common_frame = false;
  ConsensusOptions options;
  options.motion_cost = 100.;
  EXPECT_LT(trajectory_error_mm(svort::trajectory_consensus(votes, truth, options), truth, votes), 1e-2);
}

TEST(TrajectoryConsensus, RejectsWhatDoesNotFit) {
  PoseVotes votes = orthogonal_stacks(1, 4);
  votes.direct = torch::zeros({4, 9});
  const torch::Tensor start = votes.nominal;
  EXPECT_NO_THROW(svort::trajectory_consensus(votes, start, {}));
  EXPECT_THROW(svort::trajectory_consensus(votes, start.slice(0, 0, 3), {}), std::invalid_argument);
  EXPECT_THROW(svort::vote_agreement(votes, start.slice(0, 0, 3), {}), std::invalid_argument);
  ConsensusOptions options;
  options.motion_cost = 0.;
  EXPECT_THROW(svort::trajectory_consensus(votes, start, options), std::invalid_argument);
  options = {};
  options.views = 0;
  EXPECT_THROW(svort::pose_consensus(votes, options), std::invalid_argument);
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
