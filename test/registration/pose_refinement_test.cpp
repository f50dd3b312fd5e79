#include "svort_ros/registration/pose_refinement.h"

#include <ATen/Parallel.h>
#include <gtest/gtest.h>
#include <torch/types.h>

#include <algorithm>
#include <cstring>
#include <limits>
#include <numeric>

#include "../../src/registration/sampled_volume.h"
#include "../../src/registration/slice_terms.h"
#include "../../src/registration/trajectory.h"
#include "registration_fixture.h"

namespace svort {
namespace {

using svort_test::relative_error_mm;
using svort_test::simulated_scan;
using svort_test::SimulatedScan;
using svort_test::SimulatedScanOptions;

RefinementOptions quick_options() {
  RefinementOptions options;
  options.finest_mm = 2.;
  return options;
}

std::vector<Pose> poses_of(const Refinement& refinement) {
  std::vector<Pose> poses;
  for (const RefinedSlice& slice : refinement.slices) poses.push_back(slice.T_brain_slice);
  return poses;
}

/// The order of the slices within each stack, reversed in halves: neighbours in time are no neighbours any more.
SimulatedScan shuffled_in_time(const SimulatedScan& scan) {
  SimulatedScan other = scan;
  std::vector<std::int64_t> order(scan.truth.size());
  std::iota(order.begin(), order.end(), 0);
  std::mt19937 random(7);
  for (std::size_t begin = 0; begin < order.size();) {
    std::size_t end = begin;
    while (end < order.size() && scan.input.stack[end] == scan.input.stack[begin]) ++end;
    std::shuffle(order.begin() + static_cast<std::ptrdiff_t>(begin), order.begin() + static_cast<std::ptrdiff_t>(end),
                 random);
    begin = end;
  }
  const torch::Tensor index = torch::tensor(order);
  other.input.slices = scan.input.slices.index_select(0, index).contiguous();
  other.input.masks = scan.input.masks.index_select(0, index).contiguous();
  for (std::size_t i = 0; i < order.size(); ++i) {
    other.input.T_world_slice[i] = scan.input.T_world_slice[static_cast<std::size_t>(order[i])];
    other.truth[i] = scan.truth[static_cast<std::size_t>(order[i])];
  }
  return other;
}

TEST(SampledVolume, GradientIsTheDerivativeOfTheInterpolant) {
  const torch::Tensor values = svort_test::brain_volume(40, 2.);
  const SampledVolume volume(std::vector<float>(values.data_ptr<float>(), values.data_ptr<float>() + values.numel()),
                             40, 2.);
  // Inside one cell the interpolant is smooth; a step of 1/8 mm stays there, and float32 rounding stays below 1e-4 /
  // mm.
  const float h = 0.125F;
  for (const Eigen::Vector3f& at : {Eigen::Vector3f(3.5F, -6.4F, 8.45F), Eigen::Vector3f(-10.5F, 12.6F, 2.4F)}) {
    const SampledVolume::Sample sample = volume.at(at);
    for (int axis = 0; axis < 3; ++axis) {
      const Eigen::Vector3f step = h * Eigen::Vector3f::Unit(axis);
      const float difference = (volume.at(at + step).value - volume.at(at - step).value) / (2.F * h);
      EXPECT_NEAR(sample.gradient[axis], difference, 1e-4F) << "axis " << axis;
    }
  }
  EXPECT_EQ(volume.at({1000.F, 0.F, 0.F}).value, 0.F);
}

TEST(SliceTerms, GradientIsTheDerivativeOfTheCost) {
  // A smooth volume, finely sampled: the kinks of the interpolant are small.
  const torch::Tensor raw = svort_test::brain_volume(64, 1.);
  const SampledVolume volume(
      blurred(std::vector<float>(raw.data_ptr<float>(), raw.data_ptr<float>() + raw.numel()), 64, 3.), 64, 1.);
  SlicePoints points;
  for (int y = -8; y <= 8; ++y)
    for (int x = -8; x <= 8; ++x) {
      points.position.emplace_back(1.3F * static_cast<float>(x), 1.3F * static_cast<float>(y));
      points.value.push_back(0.3F + 0.01F * static_cast<float>(x * y % 7));
    }
  const ProfileTaps taps = profile_taps(1.2);
  Pose pose = Pose::Identity();
  pose.linear() = Eigen::AngleAxisd(.7, Eigen::Vector3d(1., -2., .5).normalized()).toRotationMatrix();
  pose.translation() = Eigen::Vector3d(1.3, -2.1, .7);
  SliceTermOptions options;
  // Gain and offset held by tight priors: then the eliminated gradient is the plain one.
  options.gain_spread = options.offset_spread = 1e-6;
  const auto total_cost = [&](const Pose& at) {
    return slice_terms(points, taps, volume, at, options).cost * static_cast<double>(points.value.size());
  };
  const SliceTerms terms = slice_terms(points, taps, volume, pose, options);
  for (int k = 0; k < 6; ++k) {
    const double h = k < 3 ? 2e-3 : 5e-2;
    Vector6d step = Vector6d::Zero();
    step(k) = h;
    const double difference = (total_cost(motion(step) * pose) - total_cost(motion(-step) * pose)) / (2. * h);
    // 2 %: the interpolant's slope changes from cell to cell within the step.
    EXPECT_NEAR(terms.gradient(k), difference,
                0.02 * terms.gradient.norm() / (k < 3 ? 1. : 10.) + 0.02 * std::abs(difference))
        << "component " << k;
  }
}

TEST(SliceTerms, FindsGainAndOffset) {
  const torch::Tensor raw = svort_test::brain_volume(48, 1.5);
  const SampledVolume volume(std::vector<float>(raw.data_ptr<float>(), raw.data_ptr<float>() + raw.numel()), 48, 1.5);
  SlicePoints points;
  const ProfileTaps one{{0.F}, {1.F}};
  for (int y = -10; y <= 10; ++y)
    for (int x = -10; x <= 10; ++x) {
      const Eigen::Vector2f at(1.5F * static_cast<float>(x), 1.5F * static_cast<float>(y));
      points.position.push_back(at);
      points.value.push_back(1.2F * volume.at({at.x(), at.y(), 0.F}).value - 0.03F);
    }
  SliceTermOptions options;
  for (int i = 0; i < 5; ++i) {
    const SliceTerms terms = slice_terms(points, one, volume, Pose::Identity(), options);
    options.gain = terms.gain;
    options.offset = terms.offset;
  }
  EXPECT_NEAR(options.gain, 1.2, 0.02);
  EXPECT_NEAR(options.offset, -0.03, 0.01);
}

TEST(Trajectory, SolvesTheBlockTridiagonalSystem) {
  std::mt19937 random(3);
  std::normal_distribution<double> normal(0., 1.);
  const auto draw = [&] {
    Matrix6d m;
    for (Eigen::Index i = 0; i < 36; ++i) m.data()[i] = normal(random);
    return m;
  };
  for (const std::size_t n : {std::size_t{1}, std::size_t{2}, std::size_t{7}}) {
    std::vector<Matrix6d> diagonal, upper;
    std::vector<Vector6d> right;
    const auto size = static_cast<Eigen::Index>(6 * n);
    Eigen::MatrixXd dense = Eigen::MatrixXd::Zero(size, size);
    Eigen::VectorXd b(size);
    for (std::size_t i = 0; i < n; ++i) {
      const Matrix6d m = draw();
      diagonal.push_back(m * m.transpose() + 12. * Matrix6d::Identity());
      right.push_back(draw().col(0));
      const auto at = static_cast<Eigen::Index>(6 * i);
      dense.block<6, 6>(at, at) = diagonal[i];
      b.segment<6>(at) = right[i];
      if (i + 1 < n) {
        upper.push_back(draw());
        dense.block<6, 6>(at, at + 6) = upper[i];
        dense.block<6, 6>(at + 6, at) = upper[i].transpose();
      }
    }
    const Eigen::VectorXd expected = dense.ldlt().solve(b);
    ASSERT_TRUE(solve_block_tridiagonal(diagonal, upper, &right));
    for (std::size_t i = 0; i < n; ++i)
      EXPECT_TRUE(right[i].isApprox(expected.segment<6>(static_cast<Eigen::Index>(6 * i)), 1e-9)) << "block " << i;
  }
  std::vector<Vector6d> right(1, Vector6d::Ones());
  EXPECT_FALSE(solve_block_tridiagonal({Matrix6d(-Matrix6d::Identity())}, {}, &right));
}

TEST(Trajectory, MotionAndTwistAreInverse) {
  Vector6d twist;
  twist << .3, -.2, .5, 4., -1., 2.;
  EXPECT_TRUE(twist_of(motion(twist)).isApprox(twist, 1e-12));
  EXPECT_TRUE(motion(Vector6d::Zero()).isApprox(Pose::Identity()));
}

TEST(RefinePoses, RecoversTheMotionOfThePhantom) {
  for (const unsigned seed : {1U, 2U}) {
    SimulatedScanOptions scan_options;
    scan_options.seed = seed;
    scan_options.between_mm = 5.;
    const SimulatedScan scan = simulated_scan(scan_options);
    const double nominal = relative_error_mm(scan.input.T_world_slice, scan.truth);
    const Refinement refined = refine_poses(scan.input, scan.input.T_world_slice, quick_options());
    const double error = relative_error_mm(poses_of(refined), scan.truth);
    EXPECT_GT(nominal, 2.) << "the scan must hold something to be found";
    // 2 mm pixels, 0.5 mm of motion between slices: half a pixel at corners 57 mm from the centre.
    EXPECT_LT(error, 1.2) << "nominal " << nominal << " mm";
    EXPECT_LT(error, 0.5 * nominal);
    EXPECT_LT(refined.report.last_cost, refined.report.first_cost * 1.001);
  }
}

TEST(RefinePoses, NeedsTheAcquisitionOrder) {
  // The head moves much from slice to slice: only the order of acquisition ties neighbours together.
  SimulatedScanOptions scan_options;
  scan_options.walk_mm = 1.;
  const SimulatedScan scan = simulated_scan(scan_options);
  const SimulatedScan shuffled = shuffled_in_time(scan);
  const double ordered =
      relative_error_mm(poses_of(refine_poses(scan.input, scan.input.T_world_slice, quick_options())), scan.truth);
  const double unordered = relative_error_mm(
      poses_of(refine_poses(shuffled.input, shuffled.input.T_world_slice, quick_options())), shuffled.truth);
  EXPECT_LT(1.25 * ordered, unordered);
}

TEST(RefinePoses, NeedsTheSignOfTheNormal) {
  // Mirrored slices (their x axis reversed, the pose not) do not belong to one head.
  const SimulatedScan scan = simulated_scan({});
  RegistrationInput mirrored = scan.input;
  mirrored.slices = scan.input.slices.flip({3}).contiguous();
  mirrored.masks = scan.input.masks.flip({3}).contiguous();
  const double right =
      relative_error_mm(poses_of(refine_poses(scan.input, scan.input.T_world_slice, quick_options())), scan.truth);
  const double wrong =
      relative_error_mm(poses_of(refine_poses(mirrored, mirrored.T_world_slice, quick_options())), scan.truth);
  EXPECT_LT(2. * right, wrong);
}

TEST(RefinePoses, IsTheSameForAnyNumberOfThreads) {
  SimulatedScanOptions scan_options;
  scan_options.slices = 8;
  const SimulatedScan scan = simulated_scan(scan_options);
  const int threads = at::get_num_threads();
  at::set_num_threads(1);
  const Refinement one = refine_poses(scan.input, scan.input.T_world_slice, quick_options());
  at::set_num_threads(3);
  const Refinement three = refine_poses(scan.input, scan.input.T_world_slice, quick_options());
  at::set_num_threads(threads);
  for (std::size_t i = 0; i < one.slices.size(); ++i)
    EXPECT_EQ(
        std::memcmp(one.slices[i].T_brain_slice.data(), three.slices[i].T_brain_slice.data(), 16 * sizeof(double)), 0)
        << "slice " << i;
}

TEST(RefinePoses, LeavesOutASliceThatFitsNowhereAndTakesItBack) {
  const SimulatedScan scan = simulated_scan({});
  const std::size_t spoilt = 20;
  RegistrationInput input = scan.input;
  input.slices = input.slices.clone();
  torch::manual_seed(5);
  auto slice = input.slices[static_cast<std::int64_t>(spoilt)];
  slice.copy_(torch::rand_like(slice) * input.masks[static_cast<std::int64_t>(spoilt)]);
  const Refinement refined = refine_poses(input, input.T_world_slice, quick_options());
  EXPECT_EQ(refined.slices[spoilt].weight, 0.);
  EXPECT_NE(refined.slices[spoilt].reason.find("correlation"), std::string::npos) << refined.slices[spoilt].reason;
  const auto left_out = std::count_if(refined.slices.begin(), refined.slices.end(),
                                      [](const RefinedSlice& each) { return each.weight == 0.; });
  EXPECT_LE(left_out, 4) << "the outermost slices of a stack may hold too little to be sure";
  // The same slice as it was acquired fits, wherever it was left.
  const Refinement again = refine_poses(scan.input, poses_of(refined), quick_options());
  EXPECT_GT(again.slices[spoilt].weight, 0.) << again.slices[spoilt].reason;
}

TEST(RefinePoses, WorksOnWhatThereIs) {
  // One slice, one stack, a slice without brain, a stack of two slices: poses stay finite and nothing throws.
  SimulatedScanOptions one_slice;
  one_slice.stacks = 1;
  one_slice.slices = 1;
  SimulatedScanOptions one_stack;
  one_stack.stacks = 1;
  SimulatedScanOptions few;
  few.slices = 2;
  for (const SimulatedScanOptions& scan_options : {one_slice, one_stack, few}) {
    SimulatedScan scan = simulated_scan(scan_options);
    if (scan.truth.size() > 4) scan.input.masks[3].zero_();
    const Refinement refined = refine_poses(scan.input, scan.input.T_world_slice, quick_options());
    for (const RefinedSlice& slice : refined.slices) EXPECT_TRUE(is_rigid(slice.T_brain_slice, 1e-9));
    if (scan.truth.size() > 4) {
      EXPECT_EQ(refined.slices[3].weight, 0.);
      EXPECT_FALSE(refined.slices[3].reason.empty());
    }
  }
}

TEST(RefinePoses, OneStackIsNotMadeWorse) {
  SimulatedScanOptions scan_options;
  scan_options.stacks = 1;
  const SimulatedScan scan = simulated_scan(scan_options);
  const double nominal = relative_error_mm(scan.input.T_world_slice, scan.truth);
  const Refinement refined = refine_poses(scan.input, scan.input.T_world_slice, quick_options());
  EXPECT_LT(relative_error_mm(poses_of(refined), scan.truth), 1.1 * nominal);
}

TEST(RefinePoses, NamesWhatDoesNotFit) {
  const SimulatedScan scan = simulated_scan({});
  const auto message_of = [](const RegistrationInput& input, const std::vector<Pose>& start,
                             const RefinementOptions& options) {
    try {
      refine_poses(input, start, options);
    } catch (const std::invalid_argument& error) {
      return std::string(error.what());
    }
    return std::string();
  };
  const auto expect = [](const std::string& message, const char* part) {
    EXPECT_NE(message.find(part), std::string::npos) << "'" << message << "' does not name " << part;
  };
  const std::vector<Pose>& start = scan.input.T_world_slice;
  expect(message_of(scan.input, {}, {}), "0 start poses");
  RegistrationInput input = scan.input;
  input.masks = input.masks.narrow(0, 0, 3);
  expect(message_of(input, start, {}), "masks");
  input = scan.input;
  input.slices = input.slices.clone();
  input.slices[0][0][3][3] = std::numeric_limits<float>::quiet_NaN();
  expect(message_of(input, start, {}), "NaN");
  input = scan.input;
  std::reverse(input.time_s.begin(), input.time_s.end());
  expect(message_of(input, start, {}), "acquired before");
  input = scan.input;
  input.T_world_slice[2].linear() *= 2.;
  expect(message_of(input, start, {}), "pose of slice 2");
  RefinementOptions options;
  options.step_mm = 0.;
  expect(message_of(scan.input, start, options), "step_mm");
  expect(message_of(RegistrationInput(), {}, {}), "no slices");
}

/// Blur along one axis after the other, tap by tap, zero outside.
std::vector<float> blurred_plainly(std::vector<float> values, int size, double sigma) {
  const int radius = static_cast<int>(std::ceil(3. * sigma));
  std::vector<double> kernel;
  double sum = 0.;
  for (int i = -radius; i <= radius; ++i) sum += kernel.emplace_back(std::exp(-0.5 * i * i / (sigma * sigma)));
  for (const int stride : {1, size, size * size}) {
    const std::vector<float> from = values;
    for (int i = 0; i < size * size * size; ++i) {
      const int at = i / stride % size;
      double total = 0.;
      for (int k = -radius; k <= radius; ++k)
        if (at + k >= 0 && at + k < size)
          total += kernel[static_cast<std::size_t>(k + radius)] / sum *
                   static_cast<double>(from[static_cast<std::size_t>(i + k * stride)]);
      values[static_cast<std::size_t>(i)] = static_cast<float>(total);
    }
  }
  return values;
}

TEST(Blurred, IsTheSameWhereverTheHeadLiesInItsCube) {
  constexpr int kSize = 21;
  struct Block {
    int first[3], end[3];
  };
  // In the middle, across a corner, on one face, everywhere, nowhere.
  for (const Block& block :
       {Block{{8, 9, 7}, {12, 11, 13}}, Block{{0, 0, 15}, {3, 4, kSize}}, Block{{5, 0, 5}, {6, 2, 9}},
        Block{{0, 0, 0}, {kSize, kSize, kSize}}, Block{{3, 3, 3}, {3, 3, 3}}}) {
    std::vector<float> values(kSize * kSize * kSize, 0.F);
    for (int z = block.first[2]; z < block.end[2]; ++z)
      for (int y = block.first[1]; y < block.end[1]; ++y)
        for (int x = block.first[0]; x < block.end[0]; ++x)
          values[static_cast<std::size_t>((z * kSize + y) * kSize + x)] =
              1.F + 0.1F * static_cast<float>((7 * x + 3 * y + z) % 11);
    for (const double sigma : {0.5, 1.3, 2.}) {
      const std::vector<float> found = blurred(values, kSize, sigma), expected = blurred_plainly(values, kSize, sigma);
      for (std::size_t i = 0; i < found.size(); ++i)
        ASSERT_NEAR(found[i], expected[i], 2e-6) << "voxel " << i << ", sigma " << sigma;  // float32 sums
    }
  }
}

TEST(RefineByLevel, EachLevelComesCloserAndTheFirstEntryIsTheStart) {
  const SimulatedScan scan = simulated_scan({});
  const std::vector<Pose>& start = scan.input.T_world_slice;
  const auto path = refine_by_level(scan.input, start, quick_options());
  ASSERT_EQ(path.size(), kRefinementLevels + 1);
  const auto error = [&](const std::vector<RefinedSlice>& slices) {
    return relative_error_mm(poses_of({slices, {}}), scan.truth);
  };
  std::size_t compared = 0;
  for (std::size_t i = 0; i < start.size(); ++i) {
    EXPECT_EQ(path[0][i].T_brain_slice.matrix(), start[i].matrix());
    compared += std::isfinite(path[0][i].ncc) ? 1 : 0;
  }
  EXPECT_GT(compared, start.size() * 3 / 4) << "the outermost slices have no pixel of 4 mm";
  EXPECT_LT(error(path[2]), error(path[0]));
  EXPECT_LT(error(path[4]), error(path[2]));
  EXPECT_LT(error(path[4]), 0.6 * error(path[0]));
  EXPECT_THROW(refine_by_level(scan.input, {}, quick_options()), std::invalid_argument);
}

}  // namespace
}  // namespace svort
