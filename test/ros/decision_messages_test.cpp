#include <gtest/gtest.h>

#include <algorithm>
#include <cmath>

#include "decision/decision_fixture.h"
#include "svort_ros/ros/conversions.h"
#include "svort_ros/ros/decision_publisher.h"
#include "svort_ros/ros/reconfigure.h"

namespace svort_ros {
namespace {

struct Scan {
  Scan() : pipeline(svort_test::quick_pipeline()), engine(options()) {
    for (int stack = 0; stack < 3; ++stack)
      for (const svort_test::ScanSlice& slice : svort_test::whole_stack(stack, stack, 30. * stack)) {
        if (stack == 2 && slice.index == 7) continue;
        svort_test::feed(svort_test::make_slice(slice), &pipeline, &engine);
      }
  }
  static svort::DecisionOptions options() {
    svort::DecisionOptions options;
    options.quality = svort_test::plain_quality();
    options.reacquisition.confirm_updates = 1;
    options.coverage.views = 2.6;
    options.coverage.sharp_views = 1.6;
    return options;
  }
  svort::LivePipeline pipeline;
  svort::DecisionEngine engine;
};

const Scan& scan() {
  static const Scan the_scan;
  return the_scan;
}

TEST(DecisionMessages, MillimetresBecomeMetres) {
  svort::MotionReport motion;
  motion.head_radius_mm = 35.;
  motion.motion = svort::MotionClass::severe;
  motion.window_displacement_mm = 9.;
  svort::HeadMotion slice;
  motion.slices.push_back(slice);
  slice.stack = 2;
  slice.stamp_ns = 1500000000;
  slice.shift_mm << 1., -2., 3.;
  slice.rotation << 0., 0.1, 0.;
  slice.displacement_mm = 5.;
  slice.error_mm = 2.;
  slice.moved = true;
  slice.framewise_mm = 1.5;
  slice.speed_mm_s = 4.;
  motion.slices.push_back(slice);
  const HeadMotion message = to_msg(motion, svort::Estimate(), "scanner");
  EXPECT_EQ(message.header.frame_id, "scanner");
  EXPECT_EQ(message.header.stamp, ros::Time(1, 500000000));
  EXPECT_DOUBLE_EQ(message.shift.y, -0.002);
  EXPECT_DOUBLE_EQ(message.rotation.y, 0.1);
  EXPECT_DOUBLE_EQ(message.displacement, 0.005);
  EXPECT_DOUBLE_EQ(message.error, 0.002);
  EXPECT_TRUE(message.moved);
  EXPECT_DOUBLE_EQ(message.speed, 0.004);
  EXPECT_DOUBLE_EQ(message.head_radius, 0.035);
  EXPECT_EQ(message.motion_class, HeadMotion::SEVERE);
  EXPECT_EQ(to_path(motion, "scanner").poses.size(), 2U);
}

TEST(DecisionMessages, HoldWhatTheEngineKnows) {
  const svort::Estimate& estimate = scan().pipeline.estimate();
  const SequenceQuality quality = to_msg(scan().engine.quality(), 0.5, estimate, "fetal_brain");
  ASSERT_EQ(quality.slices.size(), estimate.slices.size());
  EXPECT_EQ(quality.slices[3].score, static_cast<float>(scan().engine.quality()[3].score));
  const Coverage coverage =
      to_msg(scan().engine.coverage(), scan().engine.planner().completion(), estimate, "fetal_brain");
  EXPECT_NEAR(coverage.brain_volume, 1e-9 * scan().engine.coverage().brain_mm3, 1e-15);
  EXPECT_EQ(coverage.gaps.size(), coverage.gap_widths.size());
  EXPECT_EQ(coverage.gaps.size(), scan().engine.coverage().gaps.size());
  const ReacquisitionPlan plan = to_msg(scan().engine.planner(), true, estimate, "scanner");
  ASSERT_FALSE(plan.requests.empty());
  EXPECT_TRUE(plan.dry_run);
  EXPECT_EQ(plan.requests[0].rank, 1);
  EXPECT_EQ(plan.requests[0].state, ReacquisitionRequest::PROPOSED);
  EXPECT_TRUE(from_msg(plan.requests[0].scanner_from_slice)
                  .isApprox(scan().engine.planner().waiting()[0].T_scanner_slice, 1e-9));
}

TEST(DecisionMarkers, ShowSlicesPlanAndCoverage) {
  const svort::Estimate& estimate = scan().pipeline.estimate();
  const auto quality = to_quality_markers(estimate, scan().engine.quality_monitor(), "fetal_brain");
  ASSERT_EQ(quality.markers.size(), 1U);
  EXPECT_EQ(quality.markers[0].points.size(), 8 * estimate.slices.size());
  EXPECT_EQ(quality.markers[0].colors.size(), quality.markers[0].points.size());
  std_msgs::Header header;
  header.frame_id = "fetal_brain";
  const auto waiting = scan().engine.planner().waiting();
  const auto plan = to_plan_markers(waiting, scan().engine.coverage(), 30., header);
  ASSERT_EQ(plan.markers.size(), waiting.size() + 2);  // delete, a label each, the outlines
  EXPECT_EQ(plan.markers.front().action, visualization_msgs::Marker::DELETEALL);
  const visualization_msgs::Marker& outlines = plan.markers.back();
  ASSERT_EQ(outlines.points.size(), 8 * waiting.size());
  // The first outline lies in the first plane.
  const Eigen::Vector3d corner(outlines.points[0].x, outlines.points[0].y, outlines.points[0].z);
  EXPECT_NEAR((waiting[0].T_brain_slice.inverse() * (1000. * corner)).z(), 0., 1e-6);
  const auto cloud = to_coverage_cloud(scan().engine.coverage(), header);
  EXPECT_EQ(cloud.width * cloud.height, scan().engine.coverage().places);
  EXPECT_EQ(to_plan_markers({}, svort::CoverageMap(), 30., header).markers.size(), 1U);
  EXPECT_EQ(to_coverage_cloud(svort::CoverageMap(), header).data.size(), 0U);
  const auto plot = to_motion_plot(scan().engine.motion(), header);
  EXPECT_EQ(plot.data.size(), std::size_t{plot.step} * plot.height);
  EXPECT_NE(std::count(plot.data.begin(), plot.data.end(), 255), static_cast<std::ptrdiff_t>(plot.data.size()));
}

TEST(Reconfigure, ConfigGoesThereAndBack) {
  svort::DecisionOptions options = Scan::options();
  options.reacquisition.dry_run = false;
  options.reacquisition.open_requests = 3;
  const dynamic_reconfigure::Config config = to_config(options);
  svort::DecisionOptions read;
  apply_config(config, &read);
  EXPECT_EQ(read.reacquisition.open_requests, 3);
  EXPECT_FALSE(read.reacquisition.dry_run);
  EXPECT_EQ(read.coverage.views, 2.6);
  const auto description = describe(svort::DecisionOptions());
  ASSERT_EQ(description.groups.size(), 1U);
  EXPECT_EQ(description.groups[0].parameters.size(), config.bools.size() + config.ints.size() + config.doubles.size());
  EXPECT_EQ(description.dflt.doubles.size(), config.doubles.size());
}

TEST(Reconfigure, UnknownNamesAndTypesAreRefused) {
  svort::DecisionOptions options;
  dynamic_reconfigure::Config config;
  dynamic_reconfigure::IntParameter whole;  // "3" for "3.0" is what people write
  whole.name = "reacquisition__budget_s";
  whole.value = 45;
  config.ints.push_back(whole);
  apply_config(config, &options);
  EXPECT_EQ(options.reacquisition.budget_s, 45.);
  config.ints[0].name = "reacquisition__budget";
  try {
    apply_config(config, &options);
    FAIL() << "was accepted";
  } catch (const std::invalid_argument& error) {
    EXPECT_NE(std::string(error.what()).find("'reacquisition__budget'"), std::string::npos) << error.what();
  }
  config = dynamic_reconfigure::Config();
  dynamic_reconfigure::DoubleParameter real;
  real.name = "reacquisition__open_requests";
  real.value = 2.5;
  config.doubles.push_back(real);
  EXPECT_THROW(apply_config(config, &options), std::invalid_argument);
}

}  // namespace
}  // namespace svort_ros
