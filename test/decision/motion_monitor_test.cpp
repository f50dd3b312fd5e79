#include "svort_ros/decision/motion_monitor.h"

#include <gtest/gtest.h>

#include <Eigen/Geometry>
#include <cmath>
#include <functional>

namespace svort {
namespace {

constexpr double kTr_s = 1.5;

Pose head(double x_mm, double angle_rad) {
  Pose pose = Pose::Identity();
  pose.translation().x() = x_mm;
  pose.linear() = Eigen::AngleAxisd(angle_rad, Eigen::Vector3d::UnitZ()).toRotationMatrix();
  return pose;
}

/// Slices of stacks of ten, one every 1.5 s, with the head where the function says.
Estimate estimate_of(int count, const std::function<Pose(int)>& head_at) {
  Estimate estimate;
  for (int i = 0; i < count; ++i) {
    SliceEstimate slice;
    slice.info.stack = i / 10;
    slice.info.index = i % 10;
    slice.info.slices_in_stack = 10;
    slice.info.stamp_ns = std::llround(1e9 * kTr_s * i);
    slice.T_scanner_brain = head_at(i);
    slice.status = PoseStatus::registered;
    estimate.slices.push_back(slice);
  }
  return estimate;
}

TEST(SphereDisplacement, IsTheRootMeanSquareOverTheSphere) {
  // Summed over a fine grid of directions.
  const Pose a = head(0., 0.), b = head(3., 0.4);
  constexpr double kRadius = 35.;
  double sum = 0.;
  int count = 0;
  for (int i = 0; i < 400; ++i)
    for (int k = 0; k < 100; ++k) {
      const double z = -1. + 2. * (i + 0.5) / 400., angle = 2. * M_PI * k / 100., r = std::sqrt(1. - z * z);
      const Eigen::Vector3d p = kRadius * Eigen::Vector3d(r * std::cos(angle), r * std::sin(angle), z);
      sum += (a * p - b * p).squaredNorm();
      ++count;
    }
  EXPECT_NEAR(sphere_displacement(a, b, kRadius), std::sqrt(sum / count), 1e-4);  // the grid's own error
}

TEST(MotionMonitor, RestIsNoMotion) {
  // Half a millimetre to and fro lies within the error of 2 mm.
  const MotionReport report =
      measure_motion(estimate_of(30, [](int i) { return head(i % 2 ? 0.25 : -0.25, 0.); }), 0., {});
  EXPECT_EQ(report.motion, MotionClass::none);
  EXPECT_EQ(report.window_displacement_mm, 0.);
  for (const HeadMotion& slice : report.slices) {
    EXPECT_FALSE(slice.moved);
    EXPECT_EQ(slice.speed_mm_s, 0.);
  }
}

TEST(MotionMonitor, TakesTheEstimatorsOwnErrorWhereThereIsOne) {
  // The same half millimetre is motion if the poses are known to a tenth.
  Estimate estimate = estimate_of(30, [](int i) { return head(i % 2 ? 0.25 : -0.25, 0.); });
  for (SliceEstimate& slice : estimate.slices) slice.radius_95_mm = 0.1;
  const MotionReport report = measure_motion(estimate, 0., {});
  EXPECT_GT(report.window_displacement_mm, 0.2);
  bool moved = false;
  for (const HeadMotion& slice : report.slices) {
    moved = moved || slice.moved;
    EXPECT_LE(slice.error_mm, 0.1 * std::sqrt(2.) + 1e-12);
  }
  EXPECT_TRUE(moved);
}

TEST(MotionMonitor, MeasuresAStep) {
  // 6 mm and 0.1 rad between slices 14 and 15.
  const Estimate estimate = estimate_of(30, [](int i) { return i < 15 ? head(1., 0.) : head(7., 0.1); });
  MotionMonitorOptions options;
  options.head_radius_mm = 40.;
  const MotionReport report = measure_motion(estimate, 0., options);
  EXPECT_EQ(report.reference, 0U);
  const HeadMotion& after = report.slices[20];
  EXPECT_NEAR(after.shift_mm.x(), 6., 1e-9);
  EXPECT_NEAR(after.rotation.z(), 0.1, 1e-9);
  EXPECT_TRUE(after.moved);
  EXPECT_NEAR(after.displacement_mm, std::sqrt(36. + 4. / 3. * 1600. * (1. - std::cos(0.1))), 1e-9);
  EXPECT_NEAR(report.slices[15].framewise_mm, 6. + 40. * 0.1, 1e-9);
  EXPECT_NEAR(report.slices[16].framewise_mm, 0., 1e-9);
  EXPECT_GT(report.slices[15].speed_mm_s, 0.);
  EXPECT_EQ(report.slices[25].speed_mm_s, 0.);
  // All slices are within the 90 s; the middle one lies after the step, half of the others before it.
  EXPECT_NEAR(report.window_displacement_mm, 0.5 * after.displacement_mm, 1e-9);
  EXPECT_EQ(report.motion, MotionClass::moderate);
}

TEST(MotionMonitor, AFrameStepIsNoMotion) {
  const Estimate before = estimate_of(20, [](int i) { return head(0.5 * i, 0.01 * i); });
  Estimate after = before;
  Pose T_new_old = head(12., 1.);
  T_new_old.translation().z() = -4.;
  ++after.frame_revision;
  for (SliceEstimate& slice : after.slices) slice.T_scanner_brain = slice.T_scanner_brain * T_new_old.inverse();
  MotionMonitorOptions options;
  options.reference_s = 0.;
  const MotionReport a = measure_motion(before, 2e5, options), b = measure_motion(after, 2e5, options);
  for (std::size_t i = 0; i < a.slices.size(); ++i) {
    // The rotation is the same; displacements are of the same head about another centre, 12.6 mm away.
    EXPECT_TRUE(a.slices[i].rotation.isApprox(b.slices[i].rotation, 1e-9));
    EXPECT_NEAR(a.slices[i].displacement_mm, b.slices[i].displacement_mm, 12.7 * 0.01 * static_cast<double>(i) + 1e-9);
  }
  EXPECT_EQ(a.motion, b.motion);
}

TEST(MotionMonitor, OutliersTellNothing) {
  Estimate estimate = estimate_of(20, [](int i) { return i == 12 || i == 19 ? head(80., 1.) : head(0., 0.); });
  for (const std::size_t i : {12U, 19U}) {
    estimate.slices[i].weight = 0.;
    estimate.slices[i].status = PoseStatus::outlier;
  }
  const MotionReport report = measure_motion(estimate, 0., {});
  EXPECT_EQ(report.motion, MotionClass::none);
  EXPECT_TRUE(std::isinf(report.slices[12].error_mm));
  EXPECT_FALSE(report.slices[12].moved);
  EXPECT_EQ(report.slices[13].framewise_mm, 0.);
  ASSERT_NE(report.now(), nullptr);
  EXPECT_EQ(report.now()->stack, 1);
  EXPECT_EQ(report.now()->index, 8);
}

TEST(MotionMonitor, ReferenceIsTheFirstGoodStackOrAChosenTime) {
  Estimate estimate = estimate_of(30, [](int i) { return head(0.2 * i, 0.); });
  for (std::size_t i = 0; i < 10; i += 2) estimate.slices[i].weight = 0.;  // half of stack 0 is spoilt
  EXPECT_EQ(measure_motion(estimate, 0., {}).reference, 14U);              // in the middle of the poses of stack 1
  MotionMonitorOptions options;
  options.reference_s = 30.;
  EXPECT_EQ(measure_motion(estimate, 0., options).reference, 20U);  // 30 s
  EXPECT_EQ(measure_motion(Estimate(), 0., {}).now(), nullptr);
}

TEST(MotionMonitor, RadiusIsTheBrainsAndClassesFollowTheThresholds) {
  const Estimate estimate = estimate_of(60, [](int i) { return head(i % 20 < 10 ? 0. : 30., 0.); });
  EXPECT_NEAR(measure_motion(estimate, 4. / 3. * M_PI * 30. * 30. * 30., {}).head_radius_mm, 30., 1e-9);
  EXPECT_EQ(measure_motion(estimate, 0., {}).head_radius_mm, 40.);
  EXPECT_EQ(measure_motion(estimate, 0., {}).motion, MotionClass::severe);
  MotionMonitorOptions options;
  options.severe_mm = 100.;
  EXPECT_EQ(measure_motion(estimate, 0., options).motion, MotionClass::moderate);
  EXPECT_STREQ(to_string(MotionClass::moderate), "moderate");
}

TEST(MotionMonitor, OptionsOutOfRangeAreNamed) {
  MotionMonitorOptions options;
  options.moderate_mm = options.severe_mm;
  try {
    validate(options);
    FAIL() << "was accepted";
  } catch (const std::invalid_argument& error) {
    EXPECT_NE(std::string(error.what()).find("decision.motion.severe_mm is 8.5"), std::string::npos) << error.what();
  }
}

}  // namespace
}  // namespace svort
