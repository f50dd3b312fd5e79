// Motion, geometry and artifacts of simulated scans: numbers without images.

#include "svort_ros/simulation/scanner.h"

#include <gtest/gtest.h>

#include <algorithm>
#include <array>
#include <cmath>
#include <cstdio>
#include <map>
#include <set>

#include "svort_ros/simulation/artifacts.h"
#include "svort_ros/simulation/fetal_motion.h"
#include "svort_ros/simulation/random_stream.h"

namespace svort {
namespace {

constexpr double kDegree = M_PI / 180.;

TEST(RandomStream, DistributionsHaveTheirMoments) {
  RandomStream random(5);
  constexpr int kCount = 200000;
  double sum = 0., square = 0., wait = 0., trace = 0.;
  std::array<int, 4> counts{};
  for (int i = 0; i < kCount; ++i) {
    const double value = random.normal(2.);
    sum += value;
    square += value * value;
    wait += random.exponential(3.);
    ++counts[static_cast<std::size_t>(random.integer(0, 3))];
    trace += random.rotation().trace();
  }
  // Five standard errors.
  EXPECT_NEAR(sum / kCount, 0., 5. * 2. / std::sqrt(kCount));
  EXPECT_NEAR(square / kCount, 4., 5. * 4. * std::sqrt(2. / kCount));
  EXPECT_NEAR(wait / kCount, 3., 5. * 3. / std::sqrt(kCount));
  for (const int count : counts) EXPECT_NEAR(count, kCount / 4, 5. * std::sqrt(kCount * 3. / 16.));
  // Uniform on SO(3): the trace has mean 0 and variance 1.
  EXPECT_NEAR(trace / kCount, 0., 5. / std::sqrt(kCount));
}

TEST(RandomStream, DependsOnAllThreeNumbers) {
  std::set<std::uint64_t> seen;
  for (std::uint64_t seed = 0; seed < 10; ++seed)
    for (std::uint64_t item = 0; item < 10; ++item)
      for (std::uint64_t purpose = 0; purpose < 10; ++purpose) seen.insert(RandomStream(seed, item, purpose).bits());
  EXPECT_EQ(seen.size(), 1000U);
  EXPECT_EQ(RandomStream(1, 2, 3).bits(), RandomStream(1, 2, 3).bits());
}

struct MotionStatistics {
  double displacement = 0.;  ///< mean distance from the pose in the middle of the scan, mm
  double rotation_deg = 0.;  ///< largest rotation against the start, mean over scans
  double translation_mm = 0.;
  double step_mm = 0.;     ///< mean displacement from slice to slice
  double fast_share = 0.;  ///< share of the time above 10 mm/s
};

MotionStatistics statistics(const std::string& name, int scans) {
  constexpr double kScan_s = 90., kSlice_s = 1.5;
  MotionStatistics result;
  int samples = 0;
  for (int scan = 0; scan < scans; ++scan) {
    const HeadTrajectory trajectory(motion_class(name), kScan_s, RandomStream(3, static_cast<std::uint64_t>(scan)));
    double rotation = 0., translation = 0.;
    Pose before = trajectory.at(0.);
    const Pose middle = trajectory.at(0.5 * kScan_s);
    for (double t = 0.; t < kScan_s; t += kSlice_s, ++samples) {
      const Pose pose = trajectory.at(t);
      rotation = std::max(rotation, rotation_angle(pose) / kDegree);
      translation = std::max(translation, pose.translation().norm());
      result.displacement += sphere_distance(pose, middle);
      result.step_mm += sphere_distance(pose, before);
      result.fast_share += trajectory.speed(t) > 10. ? 1. : 0.;
      before = pose;
    }
    result.rotation_deg += rotation / scans;
    result.translation_mm += translation / scans;
  }
  result.displacement /= samples;
  result.step_mm /= samples;
  result.fast_share /= samples;
  std::printf(
      "[  MOTION  ] %-9s displacement %.2f mm, largest rotation %.1f deg, largest translation %.1f mm, "
      "slice to slice %.2f mm, above 10 mm/s %.1f %%\n",
      name.c_str(), result.displacement, result.rotation_deg, result.translation_mm, result.step_mm,
      100. * result.fast_share);
  return result;
}

TEST(FetalMotion, ClassesHaveTheirDocumentedStatistics) {
  // docs/simulation.md, table of the motion classes: 90 s, 400 scans. Within 20 %, about four standard errors.
  const std::map<std::string, MotionStatistics> documented = {
      {"mild", {1.87, 4.7, 4.0, 0.66, 0.}},
      {"moderate", {5.54, 15.6, 12.2, 1.09, 0.}},
      {"severe", {13.1, 38.8, 28.6, 2.20, 0.}},
  };
  for (const auto& [name, expected] : documented) {
    const MotionStatistics found = statistics(name, 400);
    EXPECT_NEAR(found.displacement / expected.displacement, 1., 0.2) << name;
    EXPECT_NEAR(found.rotation_deg / expected.rotation_deg, 1., 0.2) << name;
    EXPECT_NEAR(found.translation_mm / expected.translation_mm, 1., 0.2) << name;
    EXPECT_NEAR(found.step_mm / expected.step_mm, 1., 0.2) << name;
  }
  EXPECT_THROW(motion_class("wild"), std::invalid_argument);
}

TEST(FetalMotion, IsContinuousAndConfined) {
  MotionOptions options = motion_class("severe");
  for (std::uint64_t scan = 0; scan < 20; ++scan) {
    const HeadTrajectory trajectory(options, 300., RandomStream(8, scan));
    EXPECT_TRUE(trajectory.at(0.).isApprox(Pose::Identity(), 1e-12));
    for (double t = 0.; t < 300.; t += 0.05) {
      // The fastest startle: three times the mean size, half a second, peak speed 1.9 times the mean; several may add.
      EXPECT_LT(sphere_distance(trajectory.at(t), trajectory.at(t + 0.01)), 6.) << t;
      // Translation of the head's centre: what the uterus allows, the swing about the neck, and breathing.
      EXPECT_LT(trajectory.at(t).translation().norm(),
                2. * (options.confinement_mm + options.neck_mm + options.breathing_mm));
    }
  }
  const HeadTrajectory still(motion_class("none"), 60., RandomStream(1));
  EXPECT_TRUE(still.at(59.).isApprox(Pose::Identity(), 1e-12));
  EXPECT_EQ(still.speed(30.), 0.);
}

TEST(Scanner, SlicesAreWithinTheProtocol) {
  ScannerOptions options;
  BrainExtent brain;
  brain.half_size << 35., 45., 33.;
  brain.centre << 2., -3., 4.;
  for (std::uint64_t scan = 0; scan < 100; ++scan) {
    const ScanPlan plan = plan_scan(options, motion_class("moderate"), brain, 4, scan);
    EXPECT_GE(plan.stacks, 1);
    EXPECT_LE(plan.stacks, 6);
    EXPECT_GE(plan.thickness_mm, 2.5);
    EXPECT_LE(plan.thickness_mm, 3.5);
    std::map<int, std::vector<int>> order;
    double time = -1.;
    for (const PlannedSlice& slice : plan.acquired) {
      EXPECT_GT(slice.time_s, time);
      time = slice.time_s;
      order[slice.stack].push_back(slice.index);
      EXPECT_GE(slice.slices_in_stack, 15);
      EXPECT_LE(slice.slices_in_stack, 30);
    }
    ASSERT_EQ(order.size(), static_cast<std::size_t>(plan.stacks));
    for (const auto& [stack, indices] : order) {
      std::vector<int> sorted = indices;
      std::sort(sorted.begin(), sorted.end());
      for (std::size_t i = 0; i < sorted.size(); ++i) EXPECT_EQ(sorted[i], static_cast<int>(i));
      EXPECT_EQ(indices[1] - indices[0], plan.interleave);
    }
  }
}

TEST(Scanner, StacksAreNearlyOrthogonalAndSpacedEvenly) {
  ScannerOptions options;
  options.stacks_min = options.stacks_max = 3;
  options.planned_share = 0.;
  options.tilt_deg = 3.;
  const ScanPlan plan = plan_scan(options, motion_class("none"), {}, 6, 0);
  std::map<int, Eigen::Vector3d> normals;
  const PlannedSlice* before = nullptr;
  for (const PlannedSlice& slice : plan.acquired) {
    normals[slice.stack] = slice.T_scanner_slice.linear().col(2);
    if (before && before->stack == slice.stack) {
      const Eigen::Vector3d step = slice.T_scanner_slice.translation() - before->T_scanner_slice.translation();
      EXPECT_NEAR(step.norm(), std::abs(slice.index - before->index) * plan.spacing_mm, 1e-9);
      EXPECT_NEAR(std::abs(step.normalized().dot(normals[slice.stack])), 1., 1e-9);
    }
    // The stack's own frame: the same slice, up to the stack's pose.
    EXPECT_NEAR(slice.T_stack_slice.translation().head<2>().norm(), 0., 1e-12);
    before = &slice;
  }
  for (int a = 0; a < 3; ++a)
    for (int b = 0; b < a; ++b) EXPECT_LT(std::abs(normals[a].dot(normals[b])), std::sin(20. * kDegree));
}

TEST(Scanner, TruthIsTheNominalPoseInTheMovedHead) {
  ScannerOptions options;
  BrainExtent brain;
  brain.centre << 2., -3., 4.;
  const ScanPlan plan = plan_scan(options, motion_class("severe"), brain, 1, 3);
  int displaced = 0;
  for (const PlannedSlice& slice : plan.acquired) {
    const Eigen::Vector3d point(10., -20., 0.);
    EXPECT_LT((slice.T_scanner_brain * (slice.T_brain_slice() * point) - slice.T_scanner_slice * point).norm(), 1e-9);
    EXPECT_EQ(slice.displaced, slice.head_displacement > options.displaced_mm);
    displaced += slice.displaced ? 1 : 0;
  }
  EXPECT_GT(displaced, 0);
  EXPECT_LT(displaced, static_cast<int>(plan.acquired.size()));
  // The first slice of a stack is acquired as it was planned.
  EXPECT_NEAR(plan.acquired.front().head_displacement, 0., 1e-9);
}

TEST(Scanner, PrefixesKeepTheBeginning) {
  ScannerOptions options;
  const ScanPlan whole = plan_scan(options, motion_class("mild"), {}, 2, 7);
  options.prefix_share = 1.;
  std::set<std::size_t> lengths;
  for (std::uint64_t scan = 0; scan < 40; ++scan) {
    const ScanPlan cut = plan_scan(options, motion_class("mild"), {}, 2, scan);
    lengths.insert(cut.acquired.size());
    EXPECT_LE(cut.acquired.size(), cut.slices);
    if (scan != 7) continue;
    for (std::size_t i = 0; i < cut.acquired.size(); ++i)
      EXPECT_TRUE(cut.acquired[i].T_scanner_slice.isApprox(whole.acquired[i].T_scanner_slice, 0.));
  }
  EXPECT_GT(lengths.size(), 15U);
}

TEST(Artifacts, SharesAreWhatTheOptionsSay) {
  ArtifactOptions options;
  options.drop_share = 0.1;
  options.mask_cut_share = 0.2;
  options.noisy_share = 0.15;
  options.void_share = 0.1;
  ScannerOptions scanner;
  std::array<double, 4> found{};
  double slices = 0., fast = 0., fast_void = 0.;
  for (std::uint64_t scan = 0; scan < 150; ++scan) {
    const ScanPlan plan = plan_scan(scanner, motion_class("severe"), {}, 5, scan);
    const ScanArtifacts artifacts = draw_artifacts(options, plan, 5, scan);
    ASSERT_EQ(artifacts.slices.size(), plan.acquired.size());
    for (std::size_t i = 0; i < plan.acquired.size(); ++i) {
      const SliceArtifacts& slice = artifacts.slices[i];
      ++slices;
      found[0] += slice.dropped;
      found[1] += slice.mask_cut;
      found[2] += slice.noisy;
      if (plan.acquired[i].head_speed < 1.) found[3] += slice.voided ? 1. : 0.;
      if (plan.acquired[i].head_speed > options.void_speed) {
        ++fast;
        fast_void += slice.voided ? 1. : 0.;
      }
      EXPECT_EQ(slice.whole_loss > 0. || slice.local_loss > 0., slice.voided);
    }
  }
  // About 11,000 slices: four standard errors are 0.016 at most.
  EXPECT_NEAR(found[0] / slices, 0.1, 0.016);
  EXPECT_NEAR(found[1] / slices, 0.2, 0.016);
  EXPECT_NEAR(found[2] / slices, 0.15, 0.016);
  ASSERT_GT(fast, 50.);
  EXPECT_GT(fast_void / fast, 0.6);  // at least 63 % at this speed, more above
}

TEST(Artifacts, NoneMeansNone) {
  const ScanPlan plan = plan_scan({}, motion_class("severe"), {}, 5, 1);
  const ScanArtifacts artifacts = draw_artifacts(no_artifacts(), plan, 5, 1);
  EXPECT_EQ(artifacts.gamma, 1.);
  EXPECT_EQ(artifacts.bias_slope.norm() + artifacts.bias_curvature.norm(), 0.);
  for (const SliceArtifacts& slice : artifacts.slices) {
    EXPECT_FALSE(slice.dropped || slice.mask_lost || slice.mask_cut || slice.noisy || slice.voided);
    EXPECT_EQ(slice.noise, 0.);
    EXPECT_EQ(slice.gain, 1.);
    EXPECT_EQ(slice.erosion_mm, 0.);
  }
}

TEST(Artifacts, BiasInThePlaneIsTheFieldInTheScanner) {
  const ScanPlan plan = plan_scan({}, motion_class("mild"), {}, 2, 1);
  const ScanArtifacts artifacts = draw_artifacts({}, plan, 2, 1);
  const Pose& pose = plan.acquired[4].T_scanner_slice;
  const PlaneQuadratic c = artifacts.log_bias(pose);
  for (const auto& [u, v] : {std::pair{0., 0.}, {30., 0.}, {0., -25.}, {14., 33.}}) {
    const Eigen::Vector3d p = pose * Eigen::Vector3d(u, v, 0.);
    const double field = artifacts.bias_slope.dot(p) + p.dot(artifacts.bias_curvature * p);
    EXPECT_NEAR(c[0] + c[1] * u + c[2] * v + c[3] * u * u + c[4] * u * v + c[5] * v * v, field, 1e-9);
  }
}

}  // namespace
}  // namespace svort
