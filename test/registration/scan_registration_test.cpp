#include "svort_ros/registration/scan_registration.h"

#include <gtest/gtest.h>

#include <atomic>
#include <cstdint>
#include <random>
#include <stdexcept>
#include <vector>

#include "../../src/registration/scan_pieces.h"
#include "registration_fixture.h"

namespace svort {
namespace {

using svort_test::relative_error_mm;
using svort_test::simulated_scan;
using svort_test::SimulatedScan;

constexpr double kSizeMm = 96.;

/// A head that turns by this much, out of registration's reach, before its second stack, and back halfway before its
/// third.
SimulatedScan turned_between_stacks(double angle) {
  svort_test::SimulatedScanOptions options;
  options.slices = 22;  // all of the head
  options.walk_mm = 0.2;
  options.between_mm = 0.;
  SimulatedScan scan = simulated_scan(options);
  // Turning the head with the scanner at rest is turning the scanner's poses with the head at rest.
  for (std::size_t i = 0; i < scan.input.count(); ++i) {
    const double turn = scan.input.stack[i] == 1 ? angle : scan.input.stack[i] == 2 ? 0.5 * angle : 0.;
    Pose pose = Pose::Identity();
    pose.linear() = Eigen::AngleAxisd(turn, Eigen::Vector3d(1., -2., .5).normalized()).toRotationMatrix();
    pose.translation() = turn * Eigen::Vector3d(4., -3., 6.);
    scan.input.T_world_slice[i] = pose * scan.input.T_world_slice[i];
  }
  return scan;
}

/// Leaves the first `count` slices.
void truncate(SimulatedScan* scan, std::size_t count) {
  RegistrationInput& input = scan->input;
  input.slices = input.slices.narrow(0, 0, static_cast<std::int64_t>(count)).contiguous();
  input.masks = input.masks.narrow(0, 0, static_cast<std::int64_t>(count)).contiguous();
  input.T_world_slice.resize(count);
  input.stack.resize(count);
  input.time_s.resize(count);
  input.thickness_mm.resize(count);
  scan->truth.resize(count);
}

std::vector<Pose> poses_of(const Refinement& refinement) {
  std::vector<Pose> poses;
  for (const RefinedSlice& slice : refinement.slices) poses.push_back(slice.T_brain_slice);
  return poses;
}

TEST(AssembleStacks, BringsStacksTogetherHoweverFarTheHeadTurned) {
  const SimulatedScan scan = turned_between_stacks(1.9);
  const std::vector<Pose>& nominal = scan.input.T_world_slice;
  ASSERT_GT(relative_error_mm(nominal, scan.truth), 15.);
  const std::vector<Pose> assembled = assemble_stacks(scan.input, nominal, kSizeMm);
  // A voxel of the match is 3 mm.
  EXPECT_LT(relative_error_mm(assembled, scan.truth), 3.);
  EXPECT_EQ(assembled.size(), nominal.size());
}

TEST(RegisterScan, FindsWhatRefinementFromTheStartDoesNot) {
  const SimulatedScan scan = turned_between_stacks(2.8);
  const std::vector<Pose>& nominal = scan.input.T_world_slice;
  RefinementOptions options;
  options.finest_mm = 2.;  // the pixels of this scan
  const Refinement refined = refine_poses(scan.input, nominal, options);
  ASSERT_GT(relative_error_mm(poses_of(refined), scan.truth), 5.);
  const Refinement registered = register_scan(scan.input, {nominal}, kSizeMm, options);
  EXPECT_LT(relative_error_mm(poses_of(registered), scan.truth), 1.);

  const std::atomic<bool> stop{true};
  const Refinement stopped = register_scan(scan.input, {nominal}, kSizeMm, options, {}, &stop);
  for (std::size_t i = 0; i < refined.slices.size(); ++i)
    EXPECT_TRUE(stopped.slices[i].T_brain_slice.isApprox(refined.slices[i].T_brain_slice, 0.))
        << "no step but the first";
}

TEST(RegisterScan, TakesTheBetterStart) {
  svort_test::SimulatedScanOptions options;
  options.slices = 22;
  const SimulatedScan scan = simulated_scan(options);
  RefinementOptions refinement;
  refinement.finest_mm = 2.;
  std::vector<Pose> scattered = scan.truth;
  std::mt19937 random(3);
  for (Pose& pose : scattered) pose = svort_test::small_motion(random, 60.) * pose;
  ASSERT_GT(relative_error_mm(poses_of(refine_poses(scan.input, scattered, refinement)), scan.truth), 5.);
  const Refinement best = register_scan(scan.input, {scan.truth, scattered}, kSizeMm, refinement);
  EXPECT_LT(relative_error_mm(poses_of(best), scan.truth), 1.);
}

/// Turns the head by `angle` within a stack, once after every eleven slices, each time about another axis.
SimulatedScan turned_within_stacks(double angle) {
  svort_test::SimulatedScanOptions options;
  options.slices = 22;
  options.walk_mm = 0.2;
  options.between_mm = 0.;
  SimulatedScan scan = simulated_scan(options);
  std::mt19937 random(5);
  std::normal_distribution<double> normal(0., 1.);
  Pose head = Pose::Identity();
  for (std::size_t i = 0; i < scan.input.count(); ++i) {
    if (i > 0 && i % 11 == 0) {
      const Eigen::Vector3d axis = Eigen::Vector3d(normal(random), normal(random), normal(random)).normalized();
      head.linear() = Eigen::AngleAxisd(angle, axis).toRotationMatrix();
      head.translation() = 5. * axis;
    }
    scan.input.T_world_slice[i] = head * scan.input.T_world_slice[i];
  }
  return scan;
}

TEST(ScanPieces, FindsAHeadThatJumpedWithinItsStacks) {
  const SimulatedScan scan = turned_within_stacks(1.2);
  const std::vector<Pose>& nominal = scan.input.T_world_slice;
  ASSERT_GT(relative_error_mm(nominal, scan.truth), 15.);
  const ScanPieces pieces(scan.input, 8, 4., 6.);
  const std::vector<Pose> found = pieces.search(nominal);
  // Every second piece straddles a jump.
  EXPECT_LT(relative_error_mm(found, scan.truth), 0.4 * relative_error_mm(nominal, scan.truth));
  EXPECT_GT(pieces.agreement(found), pieces.agreement(nominal) + 0.05);
  // The same again, to the byte.
  const std::vector<Pose> again = pieces.search(nominal);
  for (std::size_t i = 0; i < found.size(); ++i) EXPECT_TRUE(found[i].isApprox(again[i], 0.)) << i;
}

TEST(RegisterScan, FollowsAHeadThatJumpsWithinItsStacks) {
  const SimulatedScan scan = turned_within_stacks(1.2);
  RefinementOptions options;
  options.finest_mm = 2.;
  const std::vector<Pose>& nominal = scan.input.T_world_slice;
  const double alone = relative_error_mm(poses_of(refine_poses(scan.input, nominal, options)), scan.truth);
  ASSERT_GT(alone, 15.);
  EXPECT_LT(relative_error_mm(poses_of(register_scan(scan.input, {nominal}, kSizeMm, options)), scan.truth), 1.);
}

TEST(SearchScan, FindsWhereAFollowedHeadWentWithoutTheRestOfTheScan) {
  SimulatedScan scan = turned_within_stacks(0.9);
  truncate(&scan, 2 * 22 + 11);
  RefinementOptions options;
  options.finest_mm = 2.;
  const std::vector<Pose> followed = poses_of(refine_poses(scan.input, scan.input.T_world_slice, options));
  const double lost = relative_error_mm(followed, scan.truth);
  ASSERT_GT(lost, 10.);
  const auto found = search_scan(scan.input, followed, {}, kSizeMm, options);
  ASSERT_TRUE(found.has_value());
  EXPECT_LT(relative_error_mm(poses_of(*found), scan.truth), 0.3 * lost);
  EXPECT_GT(coarse_agreement(scan.input, poses_of(*found)), coarse_agreement(scan.input, followed) + 0.02);
  // The same again, to the byte.
  const auto again = search_scan(scan.input, followed, {}, kSizeMm, options);
  ASSERT_TRUE(again.has_value());
  for (std::size_t i = 0; i < followed.size(); ++i)
    EXPECT_TRUE(found->slices[i].T_brain_slice.isApprox(again->slices[i].T_brain_slice, 0.)) << i;
}

TEST(SearchScan, FindsNothingWhereNothingIsLost) {
  svort_test::SimulatedScanOptions how;
  how.slices = 22;
  const SimulatedScan scan = simulated_scan(how);
  RefinementOptions options;
  options.finest_mm = 2.;
  EXPECT_FALSE(search_scan(scan.input, scan.truth, {}, kSizeMm, options).has_value());
  // One stack says nothing about jumps.
  how.stacks = 1;
  const SimulatedScan one = simulated_scan(how);
  EXPECT_FALSE(search_scan(one.input, one.input.T_world_slice, {}, kSizeMm, options).has_value());
}

TEST(SearchScan, WaitsForSlicesThatLieAcrossTheFirstStack) {
  SimulatedScan scan = turned_within_stacks(0.9);
  truncate(&scan, 22 + 7);
  RefinementOptions options;
  options.finest_mm = 2.;
  EXPECT_FALSE(search_scan(scan.input, scan.input.T_world_slice, {}, kSizeMm, options).has_value());
}

TEST(SearchScan, GivesUpWhenItIsTold) {
  const SimulatedScan scan = turned_within_stacks(1.2);
  const std::atomic<bool> stop{true};
  RefinementOptions options;
  options.finest_mm = 2.;
  EXPECT_FALSE(search_scan(scan.input, scan.input.T_world_slice, {}, kSizeMm, options, {}, &stop).has_value());
  const ScanPieces pieces(scan.input, 8, 4., 6.);
  const std::vector<Pose> as_given = pieces.search(scan.input.T_world_slice, &stop);
  for (std::size_t i = 0; i < as_given.size(); ++i)
    EXPECT_TRUE(as_given[i].isApprox(scan.input.T_world_slice[i], 1e-9)) << i;
}

TEST(ScanPieces, AgreementTellsTruthFromScatteredAndDisplacedSlices) {
  svort_test::SimulatedScanOptions options;
  options.slices = 22;
  const SimulatedScan scan = simulated_scan(options);
  const ScanPieces pieces(scan.input, 8, 2., 2.);
  const double truth = pieces.agreement(scan.truth);
  EXPECT_GT(truth, 0.9);
  // Wherever the whole lies.
  std::vector<Pose> moved = scan.truth;
  Pose elsewhere = Pose::Identity();
  elsewhere.linear() = Eigen::AngleAxisd(1.2, Eigen::Vector3d(1., 2., -1.).normalized()).toRotationMatrix();
  elsewhere.translation() = Eigen::Vector3d(40., -30., 55.);
  for (Pose& pose : moved) pose = elsewhere * pose;
  EXPECT_NEAR(pieces.agreement(moved), truth, 0.01);
  // A run of slices that has left the others fits itself, and nothing else.
  std::vector<Pose> displaced = scan.truth;
  for (std::size_t i = 0; i < 8; ++i) displaced[i].translation().x() += 80.;
  EXPECT_LT(pieces.agreement(displaced), truth - 0.05);
  std::vector<Pose> scattered = scan.truth;
  std::mt19937 random(3);
  for (Pose& pose : scattered) pose = svort_test::small_motion(random, 10.) * pose;
  EXPECT_LT(pieces.agreement(scattered), truth - 0.05);
}

TEST(ScanPieces, TakesWhatHoldsNoBrain) {
  svort_test::SimulatedScanOptions options;
  options.slices = 12;
  SimulatedScan scan = simulated_scan(options);
  // The first and a middle slice have no mask, and go along with others.
  for (const std::int64_t i : {0, 17}) scan.input.masks[i].zero_();
  const ScanPieces pieces(scan.input, 8, 4., 6.);
  const std::vector<Pose> found = pieces.search(scan.input.T_world_slice);
  for (const Pose& pose : found) EXPECT_TRUE(is_rigid(pose));
  const Pose motion = found[16] * scan.input.T_world_slice[16].inverse();
  EXPECT_TRUE(found[17].isApprox(motion * scan.input.T_world_slice[17], 1e-9));
  // Nothing at all: nothing moves, nothing agrees.
  scan.input.masks.zero_();
  const ScanPieces nothing(scan.input, 8, 4., 6.);
  EXPECT_EQ(nothing.agreement(scan.truth), -1.);
  EXPECT_TRUE(nothing.search(scan.truth)[5].isApprox(scan.truth[5], 0.));
}

TEST(AssembleStacks, LeavesOneStackAsItIs) {
  svort_test::SimulatedScanOptions options;
  options.stacks = 1;
  const SimulatedScan scan = simulated_scan(options);
  const std::vector<Pose> assembled = assemble_stacks(scan.input, scan.input.T_world_slice, kSizeMm);
  for (std::size_t i = 0; i < assembled.size(); ++i)
    EXPECT_TRUE(assembled[i].isApprox(scan.input.T_world_slice[i], 0.)) << i;
}

TEST(AssembleStacks, KeepsAStackOfFewSlicesBesideTheOneBeforeIt) {
  SimulatedScan scan = turned_between_stacks(1.9);
  // The last stack has only begun.
  constexpr std::size_t count = 2 * 22 + 5;
  truncate(&scan, count);
  const RegistrationInput& begun = scan.input;
  const std::vector<Pose> assembled = assemble_stacks(begun, begun.T_world_slice, kSizeMm);
  // All five go where one rigid motion takes them.
  const Pose motion = assembled[44] * begun.T_world_slice[44].inverse();
  for (std::size_t i = 45; i < count; ++i)
    EXPECT_TRUE((motion * begun.T_world_slice[i]).isApprox(assembled[i], 1e-9)) << i;
  EXPECT_FALSE(motion.isApprox(Pose::Identity(), 1e-3)) << "the stack before it was moved";
}

TEST(RegisterScan, NamesWhatDoesNotFit) {
  svort_test::SimulatedScanOptions options;
  options.stacks = 1;
  const SimulatedScan scan = simulated_scan(options);
  EXPECT_THROW(register_scan(scan.input, {}, kSizeMm), std::invalid_argument);
  EXPECT_THROW(assemble_stacks(scan.input, {Pose::Identity()}, kSizeMm), std::invalid_argument);
  EXPECT_THROW(search_scan(scan.input, {Pose::Identity()}, {}, kSizeMm), std::invalid_argument);
  EXPECT_THROW(coarse_agreement(scan.input, {Pose::Identity()}), std::invalid_argument);
}

}  // namespace
}  // namespace svort
