#include "svort_ros/registration/incremental_refinement.h"

#include <ATen/Parallel.h>
#include <gtest/gtest.h>

#include <algorithm>
#include <cmath>
#include <limits>
#include <stdexcept>
#include <string>

#include "../../src/registration/trajectory.h"
#include "registration_fixture.h"
#include "svort_ros/geometry/rigid_fit.h"

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

constexpr double kFieldMm = 96., kBright = 0.9;

IncrementalSlice slice_of(const SimulatedScan& scan, std::size_t i) {
  IncrementalSlice slice;
  const auto row = static_cast<std::int64_t>(i);
  slice.pixels = scan.input.slices[row][0].contiguous();
  slice.mask = scan.input.masks[row][0].contiguous();
  slice.T_world_slice = scan.input.T_world_slice[i];
  slice.stack = scan.input.stack[i];
  slice.thickness_mm = scan.input.thickness_mm[i];
  return slice;
}

std::vector<Pose> poses_of(const IncrementalRefinement& refinement) {
  std::vector<Pose> poses;
  for (const RefinedSlice& slice : refinement.slices()) poses.push_back(slice.T_brain_slice);
  return poses;
}

/// Takes in slice i, predicted from the one before.
std::string feed(IncrementalRefinement& refinement, const SimulatedScan& scan, std::size_t i,
                 const std::vector<PoseCandidate>& more = {}) {
  Pose predicted = scan.input.T_world_slice[i];
  if (i > 0)
    predicted = refinement.slices()[i - 1].T_brain_slice * scan.input.T_world_slice[i - 1].inverse() * predicted;
  refinement.insert(i, slice_of(scan, i), predicted, kBright);
  std::vector<PoseCandidate> candidates = {{"prediction", predicted}};
  candidates.insert(candidates.end(), more.begin(), more.end());
  const std::string start = refinement.choose(i, candidates).name;
  refinement.refine_around(i);
  refinement.sweep();
  return start;
}

TEST(IncrementalRefinement, FollowsTheHeadSliceBySlice) {
  SimulatedScanOptions how;
  how.between_mm = 6.;
  const SimulatedScan scan = simulated_scan(how);
  IncrementalRefinement refinement(quick_options(), {}, scan.input.resolution_mm, kFieldMm);
  for (std::size_t i = 0; i < scan.truth.size(); ++i) feed(refinement, scan, i);
  const double nominal = relative_error_mm(scan.input.T_world_slice, scan.truth);
  const double error = relative_error_mm(poses_of(refinement), scan.truth);
  EXPECT_GT(nominal, 2.) << "the scan must hold something to be found";
  EXPECT_LT(error, 0.5 * nominal);
  // More sweeps without new slices bring it closer to what the whole scan says.
  for (std::size_t i = 0; i < 3 * refinement.windows(); ++i) refinement.sweep();
  const double swept = relative_error_mm(poses_of(refinement), scan.truth);
  EXPECT_LT(swept, 1.1 * error);
  EXPECT_LT(swept, 1.3);
}

TEST(IncrementalRefinement, LeavesAHeadAtRestWhereItIs) {
  SimulatedScanOptions how;
  how.walk_mm = how.between_mm = 0.;
  const SimulatedScan scan = simulated_scan(how);
  IncrementalRefinement refinement(quick_options(), {}, scan.input.resolution_mm, kFieldMm);
  double worst = 0.;
  for (std::size_t i = 0; i < scan.truth.size(); ++i) {
    feed(refinement, scan, i);
    worst =
        std::max(worst, relative_error_mm({refinement.slices()[0].T_brain_slice, refinement.slices()[i].T_brain_slice},
                                          {scan.truth[0], scan.truth[i]}));
  }
  // The phantom has few edges to hold slices by; a tenth of the slice distance times ten slices is what a walk makes.
  EXPECT_LT(worst, 3.);
  EXPECT_LT(relative_error_mm(poses_of(refinement), scan.truth), 1.);
}

TEST(IncrementalRefinement, TakesTheCandidateThatFits) {
  SimulatedScanOptions how;
  how.walk_mm = 0.2;
  const SimulatedScan scan = simulated_scan(how);
  IncrementalRefinement refinement(quick_options(), {}, scan.input.resolution_mm, kFieldMm);
  const std::size_t last = scan.truth.size() - 4;
  for (std::size_t i = 0; i < last; ++i) EXPECT_EQ(feed(refinement, scan, i), "prediction");
  // A head that is said to have turned away by 40 degrees has not: the other candidate is where it is.
  Pose away = Pose::Identity();
  away.linear() = Eigen::AngleAxisd(0.7, Eigen::Vector3d(1., 1., 0.).normalized()).toRotationMatrix();
  const Pose right = refinement.slices()[last - 1].T_brain_slice * scan.input.T_world_slice[last - 1].inverse() *
                     scan.input.T_world_slice[last];
  refinement.insert(last, slice_of(scan, last), away * right, kBright);
  EXPECT_EQ(refinement.choose(last, {{"prediction", away * right}, {"other", right}}).name, "other");
  EXPECT_LT(motion_size(twist_of(refinement.slices()[last].T_brain_slice * right.inverse()), 40.), 3.);
}

/// Where slice i is by the truth, in the frame that the slices before it hold.
Pose true_pose(const IncrementalRefinement& refinement, const SimulatedScan& scan, std::size_t i) {
  const std::vector<Pose> poses = poses_of(refinement);
  const std::vector<Pose> truth(scan.truth.begin(), scan.truth.begin() + static_cast<std::ptrdiff_t>(i));
  return fit_planes(truth, {poses.begin(), poses.begin() + static_cast<std::ptrdiff_t>(i)}, 40.) * scan.truth[i];
}

double distance_mm(const Pose& a, const Pose& b) { return motion_size(twist_of(a * b.inverse()), 40.); }

TEST(IncrementalRefinement, FindsAHeadThatTurnedFarAway) {
  SimulatedScanOptions how;
  how.slices = 22;
  how.walk_mm = 0.2;
  how.jump_at = 50;  // in the third stack
  how.jump.linear() = Eigen::AngleAxisd(0.6, Eigen::Vector3d(1., -1., 2.).normalized()).toRotationMatrix();
  how.jump.translation() = Eigen::Vector3d(6., -4., 5.);
  const SimulatedScan scan = simulated_scan(how);
  IncrementalRefinement refinement(quick_options(), {}, scan.input.resolution_mm, kFieldMm);
  for (std::size_t i = 0; i < how.jump_at; ++i) {
    feed(refinement, scan, i);
    EXPECT_EQ(refinement.find_lost(i), 0U) << "slice " << i << " was not lost";
  }
  // The head goes on; the slice that shows it, or one of the next, is found.
  std::size_t found = 0, at = how.jump_at;
  for (; found == 0 && at < how.jump_at + 6; ++at) {
    const Pose predicted = refinement.slices()[at - 1].T_brain_slice * scan.input.T_world_slice[at - 1].inverse() *
                           scan.input.T_world_slice[at];
    const Pose truth = true_pose(refinement, scan, at);
    if (at == how.jump_at) {
      ASSERT_GT(distance_mm(predicted, truth), 20.);
    }
    refinement.insert(at, slice_of(scan, at), predicted, kBright);
    refinement.choose(at, {{"prediction", predicted}});
    const double followed = distance_mm(refinement.slices()[at].T_brain_slice, truth);
    found = refinement.find_lost(at);
    if (found > 0) {
      EXPECT_LT(distance_mm(refinement.slices()[at].T_brain_slice, truth), std::min(8., 0.5 * followed));
    }
  }
  EXPECT_GT(found, 0U);
  // What the option switches off.
  IncrementalOptions off;
  off.find_lost = false;
  IncrementalRefinement blind(quick_options(), off, scan.input.resolution_mm, kFieldMm);
  for (std::size_t i = 0; i < at; ++i) blind.insert(i, slice_of(scan, i), Pose::Identity(), kBright);
  blind.set(refinement.slices());
  EXPECT_EQ(blind.find_lost(at - 1), 0U);
}

TEST(IncrementalRefinement, ASliceThatFitsNowhereShowsNothingToTheOthers) {
  SimulatedScanOptions how;
  how.slices = 22;
  how.walk_mm = 0.2;
  const SimulatedScan scan = simulated_scan(how);
  IncrementalRefinement refinement(quick_options(), {}, scan.input.resolution_mm, kFieldMm);
  for (std::size_t i = 0; i < 50; ++i) feed(refinement, scan, i);
  const torch::Tensor before = refinement.volume().clone();
  // Noise in the shape of the brain.
  IncrementalSlice noise = slice_of(scan, 50);
  torch::manual_seed(4);
  noise.pixels = (torch::rand_like(noise.pixels) * noise.mask).contiguous();
  const Pose predicted =
      refinement.slices()[49].T_brain_slice * scan.input.T_world_slice[49].inverse() * scan.input.T_world_slice[50];
  refinement.insert(50, noise, predicted, kBright);
  refinement.choose(50, {{"prediction", predicted}});
  EXPECT_EQ(refinement.find_lost(50), 0U);
  EXPECT_EQ(refinement.slices()[50].weight, 0.);
  EXPECT_NE(refinement.slices()[50].reason, "");
  EXPECT_TRUE(torch::equal(refinement.volume(), before));
}

TEST(IncrementalRefinement, ReplacesTheTermsOfSlicesThatMoved) {
  // The volume after many replacements is that of a rebuild: the next window finds the same poses, within rounding.
  const SimulatedScan scan = simulated_scan({});
  IncrementalRefinement refinement(quick_options(), {}, scan.input.resolution_mm, kFieldMm);
  for (std::size_t i = 0; i < 32; ++i) feed(refinement, scan, i);
  EXPECT_GT(refinement.take_replaced(), 32U);
  EXPECT_EQ(refinement.take_replaced(), 0U);
  IncrementalRefinement rebuilt(quick_options(), {}, scan.input.resolution_mm, kFieldMm);
  for (std::size_t i = 0; i < 32; ++i) rebuilt.insert(i, slice_of(scan, i), Pose::Identity(), kBright);
  rebuilt.set(refinement.slices());
  // Slices that moved less than moved_mm (0.02 mm) have kept their terms; Gauss-Newton does not enlarge that.
  refinement.refine_around(31);
  rebuilt.refine_around(31);
  for (std::size_t i = 0; i < 32; ++i)
    EXPECT_LT(
        motion_size(twist_of(refinement.slices()[i].T_brain_slice * rebuilt.slices()[i].T_brain_slice.inverse()), 40.),
        0.05)
        << "slice " << i;
}

TEST(IncrementalRefinement, HoldsTheSlicesOutsideTheWindow) {
  const SimulatedScan scan = simulated_scan({});
  IncrementalOptions options;
  options.window = 6;
  options.sweeps = 0;
  IncrementalRefinement refinement(quick_options(), options, scan.input.resolution_mm, kFieldMm);
  for (std::size_t i = 0; i < 30; ++i) feed(refinement, scan, i);
  const std::vector<Pose> before = poses_of(refinement);
  refinement.refine_around(29);
  const std::vector<Pose> after = poses_of(refinement);
  for (std::size_t i = 0; i < 24; ++i) EXPECT_EQ(before[i].matrix(), after[i].matrix()) << "slice " << i;
  EXPECT_NE(before[29].matrix(), after[29].matrix());
}

TEST(IncrementalRefinement, SameBytesForAnyNumberOfThreads) {
  const SimulatedScan scan = simulated_scan({});
  std::vector<std::vector<Pose>> found;
  for (const int threads : {1, 2, 3}) {
    at::set_num_threads(threads);
    IncrementalRefinement refinement(quick_options(), {}, scan.input.resolution_mm, kFieldMm);
    for (std::size_t i = 0; i < 20; ++i) feed(refinement, scan, i);
    found.push_back(poses_of(refinement));
  }
  for (std::size_t i = 0; i < 20; ++i) {
    EXPECT_EQ(found[0][i].matrix(), found[1][i].matrix());
    EXPECT_EQ(found[0][i].matrix(), found[2][i].matrix());
  }
}

TEST(IncrementalRefinement, SaysHowUncertainItIs) {
  const SimulatedScan scan = simulated_scan({});
  IncrementalRefinement refinement(quick_options(), {}, scan.input.resolution_mm, kFieldMm);
  for (std::size_t i = 0; i < scan.truth.size(); ++i) {
    feed(refinement, scan, i);
    const double sigma = refinement.slices()[i].sigma_mm;
    if (i < 3) continue;
    EXPECT_TRUE(std::isfinite(sigma) && sigma > 0. && sigma < 20.) << "slice " << i << ": " << sigma;
  }
  const std::vector<Pose> before = poses_of(refinement);
  refinement.measure_uncertainty();
  for (std::size_t i = 0; i < before.size(); ++i)
    EXPECT_EQ(before[i].matrix(), refinement.slices()[i].T_brain_slice.matrix()) << "measuring moves nothing";
}

TEST(BlockTridiagonal, InverseIsThatOfTheWholeMatrix) {
  constexpr int kBlocks = 5;
  std::mt19937 random(3);
  std::normal_distribution<double> normal;
  Eigen::MatrixXd root(6 * kBlocks, 6 * kBlocks);
  for (Eigen::Index i = 0; i < root.size(); ++i) root.data()[i] = normal(random);
  Eigen::MatrixXd whole = Eigen::MatrixXd::Zero(6 * kBlocks, 6 * kBlocks);
  std::vector<Matrix6d> diagonal, upper;
  for (int i = 0; i < kBlocks; ++i) {
    const Matrix6d block = root.block<6, 6>(6 * i, 6 * i);
    diagonal.push_back(block * block.transpose() + 20. * Matrix6d::Identity());
    whole.block<6, 6>(6 * i, 6 * i) = diagonal.back();
    if (i + 1 == kBlocks) break;
    upper.push_back(root.block<6, 6>(6 * i, 6 * (i + 1)));
    whole.block<6, 6>(6 * i, 6 * (i + 1)) = upper.back();
    whole.block<6, 6>(6 * (i + 1), 6 * i) = upper.back().transpose();
  }
  const Eigen::MatrixXd inverse = whole.inverse();
  const std::vector<Matrix6d> blocks = block_tridiagonal_inverse(diagonal, upper);
  ASSERT_EQ(blocks.size(), static_cast<std::size_t>(kBlocks));
  for (int i = 0; i < kBlocks; ++i) {
    const Matrix6d expected = inverse.block<6, 6>(6 * i, 6 * i);
    EXPECT_LT((blocks[static_cast<std::size_t>(i)] - expected).cwiseAbs().maxCoeff(), 1e-10);
  }
  diagonal[2] = -diagonal[2];
  EXPECT_TRUE(block_tridiagonal_inverse(diagonal, upper).empty());
}

TEST(IncrementalRefinement, NamesWhatIsOutOfRange) {
  const auto rejected = [](const IncrementalOptions& options, const char* name) {
    try {
      validate(options);
    } catch (const std::invalid_argument& error) {
      return std::string(error.what()).find(name) != std::string::npos;
    }
    return false;
  };
  IncrementalOptions options;
  options.window = 3;
  EXPECT_TRUE(rejected(options, "incremental.window"));
  options = {};
  options.sweeps = -1;
  EXPECT_TRUE(rejected(options, "incremental.sweeps"));
  options = {};
  options.moved_mm = std::numeric_limits<double>::quiet_NaN();
  EXPECT_TRUE(rejected(options, "incremental.moved_mm"));
  const SimulatedScan scan = simulated_scan({});
  IncrementalRefinement refinement(quick_options(), {}, scan.input.resolution_mm, kFieldMm);
  EXPECT_THROW(refinement.insert(1, slice_of(scan, 0), Pose::Identity(), kBright), std::invalid_argument);
  EXPECT_THROW(refinement.set(std::vector<RefinedSlice>(2)), std::invalid_argument);
  refinement.insert(0, slice_of(scan, 0), Pose::Identity(), kBright);
  EXPECT_THROW(refinement.choose(0, {}), std::invalid_argument);
}

}  // namespace
}  // namespace svort
