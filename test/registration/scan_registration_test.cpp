#include "svort_ros/registration/scan_registration.h"

#include <gtest/gtest.h>

#include <stdexcept>
#include <vector>

#include "registration_fixture.h"

namespace svort {
namespace {

using svort_test::relative_error_mm;
using svort_test::simulated_scan;

constexpr double kSizeMm = 96.;

/// A head that turns by this much, out of registration's reach, before its second stack, and back halfway before its
/// third.
svort_test::SimulatedScan turned_between_stacks(double angle) {
  svort_test::SimulatedScanOptions options;
  options.slices = 22;  // all of the head
  options.walk_mm = 0.2;
  options.between_mm = 0.;
  svort_test::SimulatedScan scan = simulated_scan(options);
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

std::vector<Pose> poses_of(const Refinement& refinement) {
  std::vector<Pose> poses;
  for (const RefinedSlice& slice : refinement.slices) poses.push_back(slice.T_brain_slice);
  return poses;
}

TEST(AssembleStacks, BringsStacksTogetherHoweverFarTheHeadTurned) {
  const svort_test::SimulatedScan scan = turned_between_stacks(1.9);
  const std::vector<Pose>& nominal = scan.input.T_world_slice;
  ASSERT_GT(relative_error_mm(nominal, scan.truth), 15.);
  const std::vector<Pose> assembled = assemble_stacks(scan.input, nominal, kSizeMm);
  // A voxel of the match is 3 mm.
  EXPECT_LT(relative_error_mm(assembled, scan.truth), 3.);
  EXPECT_EQ(assembled.size(), nominal.size());
}

TEST(RegisterScan, FindsWhatRefinementFromTheStartDoesNot) {
  const svort_test::SimulatedScan scan = turned_between_stacks(1.9);
  const std::vector<Pose>& nominal = scan.input.T_world_slice;
  RefinementOptions options;
  options.finest_mm = 2.;  // the pixels of this scan
  const Refinement refined = refine_poses(scan.input, nominal, options);
  ASSERT_GT(relative_error_mm(poses_of(refined), scan.truth), 5.);
  const Refinement registered = register_scan(scan.input, {nominal}, kSizeMm, options);
  EXPECT_LT(relative_error_mm(poses_of(registered), scan.truth), 1.);
  EXPECT_LT(registered.report.last_cost, refined.report.last_cost);
}

TEST(RegisterScan, IsNeverWorseThanItsBestStart) {
  svort_test::SimulatedScanOptions options;
  options.slices = 22;
  const svort_test::SimulatedScan scan = simulated_scan(options);
  RefinementOptions refinement;
  refinement.finest_mm = 2.;
  const double from_truth = refine_poses(scan.input, scan.truth, refinement).report.last_cost;
  const Refinement best = register_scan(scan.input, {scan.input.T_world_slice, scan.truth}, kSizeMm, refinement);
  EXPECT_LE(best.report.last_cost, from_truth);
}

TEST(AssembleStacks, LeavesOneStackAsItIs) {
  svort_test::SimulatedScanOptions options;
  options.stacks = 1;
  const svort_test::SimulatedScan scan = simulated_scan(options);
  const std::vector<Pose> assembled = assemble_stacks(scan.input, scan.input.T_world_slice, kSizeMm);
  for (std::size_t i = 0; i < assembled.size(); ++i)
    EXPECT_TRUE(assembled[i].isApprox(scan.input.T_world_slice[i], 0.)) << i;
}

TEST(AssembleStacks, KeepsAStackOfFewSlicesBesideTheOneBeforeIt) {
  svort_test::SimulatedScan scan = turned_between_stacks(1.9);
  // The last stack has only begun.
  const std::size_t count = 2 * 22 + 5;
  RegistrationInput begun = scan.input;
  begun.slices = scan.input.slices.narrow(0, 0, count).contiguous();
  begun.masks = scan.input.masks.narrow(0, 0, count).contiguous();
  begun.T_world_slice.resize(count);
  begun.stack.resize(count);
  begun.time_s.resize(count);
  begun.thickness_mm.resize(count);
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
  const svort_test::SimulatedScan scan = simulated_scan(options);
  EXPECT_THROW(register_scan(scan.input, {}, kSizeMm), std::invalid_argument);
  EXPECT_THROW(assemble_stacks(scan.input, {Pose::Identity()}, kSizeMm), std::invalid_argument);
}

}  // namespace
}  // namespace svort
