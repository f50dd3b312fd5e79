#include "svort_ros/ros/arrivals.h"

#include <gtest/gtest.h>

#include <cmath>

#include "ros/synthetic_scan.h"

namespace svort_ros {
namespace {

svort::SliceEstimate head_at(double x_mm, double angle_rad) {
  svort::SliceEstimate slice;
  slice.T_scanner_brain.linear() = Eigen::AngleAxisd(angle_rad, Eigen::Vector3d::UnitY()).toRotationMatrix();
  slice.T_scanner_brain.translation().x() = x_mm;
  return slice;
}

TEST(HeadDisplacement, IsMotionSinceTheFirstSlice) {
  const HeadDisplacement displacement = head_displacement(head_at(10., 0.3), head_at(13., 0.4));
  EXPECT_NEAR(displacement.distance_mm, 3., 1e-12);
  EXPECT_NEAR(displacement.angle_deg, 0.1 * 180. / M_PI, 1e-9);
}

TEST(HeadDisplacement, AStepOfTheFrameIsNoMotion) {
  svort::SliceEstimate first = head_at(10., 0.3);
  svort::SliceEstimate second = first;
  const svort::Pose step = head_at(25., 1.).T_scanner_brain;
  first.T_scanner_brain = first.T_scanner_brain * step;
  second.T_scanner_brain = second.T_scanner_brain * step;
  EXPECT_NEAR(head_displacement(first, second).distance_mm, 0., 1e-12);
  EXPECT_NEAR(head_displacement(first, second).angle_deg, 0., 1e-5);
}

svort::SliceInfo slice_info(int stack, int index, int count) {
  svort::SliceInfo info;
  info.scan_id = "s";
  info.stack = stack;
  info.index = index;
  info.slices_in_stack = count;
  return info;
}

TEST(ScanProgress, CountsKeptAndEmptySlicesAgainstThePrescription) {
  ScanProgress progress;
  progress.add(slice_info(0, 0, 22), svort::ArrivalStatus::empty_mask);
  progress.add(slice_info(0, 2, 22), svort::ArrivalStatus::accepted);
  progress.add(slice_info(0, 2, 22), svort::ArrivalStatus::duplicate);
  progress.add(slice_info(5, 0, 1'000'000), svort::ArrivalStatus::bad_geometry);
  progress.add(slice_info(1, 0, 20), svort::ArrivalStatus::late);
  EXPECT_EQ(progress.done(), 3U);
  EXPECT_EQ(progress.prescribed(), 42U);
  EXPECT_EQ(progress_head(progress, slice_info(1, 4, 20), svort::ArrivalStatus::accepted),
            "[  3/ 42] stack 1 slice  4  accepted");
  progress.clear();
  EXPECT_EQ(progress.done(), 0U);
}

TEST(ProgressLine, HasEverythingAUserWatches) {
  svort::JournalEntry entry;
  entry.latency_ms = 0.42;
  entry.volume_latency_ms = 112.4;
  EXPECT_EQ(progress_line("head", entry, head_at(0., 0.), head_at(1.26, M_PI / 180.)),
            "head  pose   0.4 ms  volume  112 ms  head 1.3 mm 1.0 deg  nominal");
  entry.info = slice_info(1, 4, 20);
  entry.reason = svort::describe(entry.info) + ": NaN at row 3";
  EXPECT_EQ(rejection_line("head", entry), "head  NaN at row 3");
  entry.reason = "something else";
  EXPECT_EQ(rejection_line("head", entry), "head  something else");
}

TEST(Journal, GetsPosesAndLatenciesOfArrivals) {
  svort::PipelineOptions options;
  options.estimator.volume_resolution_mm = 4.;
  svort::LivePipeline pipeline(options);
  AwaitingVolume awaiting;
  const auto scan = svort_test::synthetic_scan();
  for (std::size_t i = 0; i < 2; ++i) {
    const svort::Arrival arrival = pipeline.add(scan[i]);
    ASSERT_TRUE(svort::is_kept(arrival.status)) << arrival.reason;
    svort::JournalEntry entry = make_journal_entry(pipeline, scan[i].info, arrival);
    EXPECT_EQ(entry.sequence_length, i + 1);
    EXPECT_EQ(entry.revision, pipeline.estimate().revision);
    EXPECT_TRUE(entry.T_brain_slice.isApprox(pipeline.newest()->T_brain_slice, 0.));
    EXPECT_EQ(entry.device, "cpu");
    awaiting.add({pipeline.journal().add(entry), Clock::now() - std::chrono::seconds(1), "head"});
  }
  const svort::Arrival repeated = pipeline.add(scan[0]);
  const svort::JournalEntry rejected = make_journal_entry(pipeline, scan[0].info, repeated);
  EXPECT_EQ(rejected.status, svort::ArrivalStatus::duplicate);
  EXPECT_EQ(rejected.revision, 0U);
  EXPECT_EQ(rejected.sequence_length, 2U);

  EXPECT_TRUE(std::isnan(pipeline.journal().entries()[1].volume_latency_ms));
  pipeline.update_volume();
  const auto published = awaiting.volume_published(pipeline);
  ASSERT_EQ(published.size(), 2U);
  EXPECT_GE(published[0].latency_ms, 1000.);
  EXPECT_DOUBLE_EQ(pipeline.journal().entries()[1].volume_latency_ms, published[1].latency_ms);
  EXPECT_EQ(awaiting.size(), 0U);
}

}  // namespace
}  // namespace svort_ros
