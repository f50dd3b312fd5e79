#include "svort_ros/live/registration_estimator.h"

#include <gtest/gtest.h>

#include <algorithm>
#include <chrono>
#include <stdexcept>
#include <string>
#include <thread>

#include "moving_scan.h"
#include "registration/registration_fixture.h"
#include "svort_ros/live/live_pipeline.h"

namespace svort {
namespace {

using svort_test::moving_scan;
using svort_test::quick_options;
using svort_test::relative_error_mm;
using Scan = svort_test::MovingScan;

BrainTemplate phantom_template() {
  const torch::Tensor values = svort_test::brain_volume(48, 2.);
  BrainTemplate brain;
  brain.name = "phantom";
  brain.volume.grid.size.setConstant(48);
  brain.volume.grid.spacing.setConstant(2.);
  brain.volume.values.assign(values.data_ptr<float>(), values.data_ptr<float>() + values.numel());
  return brain;
}

struct Poses {
  std::vector<Pose> estimated, nominal, truth;
};

/// Feeds the scan; `kept` says which slices were.
Poses run(LivePipeline& pipeline, const Scan& scan, int volume_every) {
  std::vector<Pose> truth;
  int count = 0;
  for (std::size_t i = 0; i < scan.slices.size(); ++i) {
    if (!is_kept(pipeline.add(scan.slices[i]).status)) continue;
    truth.push_back(scan.truth[i]);
    if (volume_every > 0 && ++count % volume_every == 0) pipeline.update_volume();
  }
  pipeline.finalise();
  Poses poses;
  poses.truth = truth;
  for (const SliceEstimate& slice : pipeline.estimate().slices) {
    poses.estimated.push_back(slice.T_brain_slice);
    poses.nominal.push_back(slice.info.T_scanner_slice);
  }
  return poses;
}

TEST(RegistrationEstimator, FollowsTheHead) {
  const Scan scan = moving_scan();
  LivePipeline pipeline(quick_options());
  const Poses poses = run(pipeline, scan, 0);
  const double nominal = relative_error_mm(poses.nominal, poses.truth);
  const double error = relative_error_mm(poses.estimated, poses.truth);
  EXPECT_GT(nominal, 2.) << "the scan must hold something to be found";
  EXPECT_LT(error, 1.3) << "nominal " << nominal << " mm";
  EXPECT_LT(error, 0.5 * nominal);
  for (const SliceEstimate& slice : pipeline.estimate().slices) {
    EXPECT_TRUE(slice.status == PoseStatus::registered || slice.status == PoseStatus::outlier);
    EXPECT_EQ(slice.status == PoseStatus::outlier, slice.weight == 0.);
    EXPECT_EQ(slice.status == PoseStatus::outlier, !slice.reason.empty());
    // What tf composes is the scanner's prescription again.
    EXPECT_TRUE((slice.T_scanner_brain * slice.T_brain_slice).isApprox(slice.info.T_scanner_slice, 1e-9));
  }
}

TEST(RegistrationEstimator, RegistersAllSlicesAgainIfAskedTo) {
  const Scan scan = moving_scan(2);
  PipelineOptions options = quick_options();
  options.estimator.update = "full";
  LivePipeline full(options), incremental(quick_options());
  const Poses a = run(full, scan, 0), b = run(incremental, scan, 0);
  const double nominal = relative_error_mm(a.nominal, a.truth);
  EXPECT_LT(relative_error_mm(a.estimated, a.truth), 0.6 * nominal);
  EXPECT_LT(relative_error_mm(b.estimated, b.truth), 0.6 * nominal);
  // The frame, which the way there has left, is rounded differently.
  EXPECT_LT(relative_error_mm(a.estimated, b.estimated), 1e-6) << "the end does not depend on the way";
  EXPECT_TRUE(full.estimate().slices.back().start.empty()) << "what only the incremental update knows";
  EXPECT_FALSE(incremental.estimate().slices.back().start.empty());
}

TEST(RegistrationEstimator, ImprovesWhileNothingArrivesIfTimeIsTheBudget) {
  const Scan scan = moving_scan(2);
  PipelineOptions options = quick_options();
  LivePipeline counted(options);
  options.estimator.budget = "time";
  LivePipeline timed(options);
  for (const Slice& slice : scan.slices) {
    counted.add(slice);
    timed.add(slice);
  }
  EXPECT_FALSE(counted.improve()) << "poses must not depend on time";
  const auto error = [&](const LivePipeline& pipeline) {
    std::vector<Pose> poses, truth;
    for (const SliceEstimate& slice : pipeline.estimate().slices) {
      for (std::size_t i = 0; i < scan.slices.size(); ++i)
        if (scan.slices[i].info.stamp_ns == slice.info.stamp_ns) truth.push_back(scan.truth[i]);
      poses.push_back(slice.T_brain_slice);
    }
    return relative_error_mm(poses, truth);
  };
  EXPECT_EQ(error(counted), error(timed)) << "the same until there is time";
  const double before = error(timed);
  const std::uint64_t revision = timed.estimate().revision;
  int steps = 0;
  while (timed.improve() && steps < 100) ++steps;
  EXPECT_GT(steps, 3);
  EXPECT_LT(steps, 100) << "it comes to an end";
  EXPECT_GT(timed.estimate().revision, revision);
  EXPECT_LT(error(timed), 1.05 * before);
  timed.finalise();
  EXPECT_FALSE(timed.improve()) << "nothing is better than final";
}

/// Its head turns by 63 degrees within the second stack.
Scan jumping_scan() {
  Pose jump = Pose::Identity();
  jump.linear() = Eigen::AngleAxisd(1.1, Eigen::Vector3d(1., -2., 1.).normalized()).toRotationMatrix();
  jump.translation() = Eigen::Vector3d(5., -4., 3.);
  return moving_scan(3, 33, jump, 22);
}

PipelineOptions without_searches() {
  PipelineOptions options = quick_options();
  options.estimator.search_every = 0;
  options.estimator.incremental.find_lost = false;
  return options;
}

/// Of the poses as they were followed, before finalise().
double followed_error_mm(LivePipeline& pipeline, const Scan& scan) {
  std::vector<Pose> truth, poses;
  for (std::size_t i = 0; i < scan.slices.size(); ++i)
    if (is_kept(pipeline.add(scan.slices[i]).status)) truth.push_back(scan.truth[i]);
  for (const SliceEstimate& slice : pipeline.estimate().slices) poses.push_back(slice.T_brain_slice);
  return relative_error_mm(poses, truth);
}

std::size_t found(const LivePipeline& pipeline) {
  const auto& slices = pipeline.estimate().slices;
  return static_cast<std::size_t>(
      std::count_if(slices.begin(), slices.end(), [](const SliceEstimate& slice) { return slice.start == "search"; }));
}

TEST(RegistrationEstimator, FindsAHeadThatHasJumpedWhileSlicesArrive) {
  const Scan scan = jumping_scan();
  LivePipeline blind(without_searches());
  const double lost = followed_error_mm(blind, scan);
  ASSERT_GT(lost, 6.);
  EXPECT_EQ(found(blind), 0U);
  LivePipeline nearby(quick_options());  // both kinds of search
  EXPECT_LT(followed_error_mm(nearby, scan), 0.4 * lost);
  EXPECT_GT(found(nearby), 0U);
  // The search in the background alone.
  PipelineOptions background = without_searches();
  background.estimator.search_every = quick_options().estimator.search_every;
  LivePipeline searching(background);
  EXPECT_LT(followed_error_mm(searching, scan), 0.4 * lost);
  EXPECT_GT(found(searching), 0U);
  for (const SliceEstimate& slice : searching.estimate().slices)
    EXPECT_TRUE((slice.T_scanner_brain * slice.T_brain_slice).isApprox(slice.info.T_scanner_slice, 1e-9));
  // The same again, to the byte, however long the searches took.
  LivePipeline again(background);
  followed_error_mm(again, scan);
  for (std::size_t i = 0; i < again.estimate().slices.size(); ++i)
    EXPECT_EQ(again.estimate().slices[i].T_brain_slice.matrix(), searching.estimate().slices[i].T_brain_slice.matrix());
}

TEST(RegistrationEstimator, TakesInWhatASearchHasFoundWhileNothingArrives) {
  const Scan scan = jumping_scan();
  PipelineOptions options = without_searches();
  options.estimator.budget = "time";
  options.estimator.search_every = 1000;  // one before the jump; the next one begins when there is nothing else to do
  LivePipeline pipeline(options);
  for (const Slice& slice : scan.slices) pipeline.add(slice);
  EXPECT_EQ(found(pipeline), 0U);
  using Clock = std::chrono::steady_clock;
  const auto limit = Clock::now() + std::chrono::minutes(2);
  while (found(pipeline) == 0 && Clock::now() < limit) {
    while (pipeline.improve()) {
    }
    std::this_thread::sleep_for(std::chrono::milliseconds(20));
  }
  EXPECT_GT(found(pipeline), 0U);
}

TEST(RegistrationEstimator, ASearchThatIsNotWantedAnyMoreIsGivenUp) {
  const Scan scan = jumping_scan();
  PipelineOptions options = quick_options();
  options.estimator.search_every = 4;
  for (const int end : {0, 1, 2}) {
    LivePipeline pipeline(options);
    for (std::size_t i = 0; i < 34; ++i) pipeline.add(scan.slices[i]);
    if (end == 0) continue;  // the destructor waits for the thread
    if (end == 1) pipeline.finalise();
    if (end == 2) pipeline.reset();
    // And what it would have found is not taken in afterwards.
    const std::size_t revision_slices = pipeline.estimate().slices.size();
    EXPECT_EQ(revision_slices > 0, end == 1);
    Scan next = moving_scan(2);
    for (Slice& slice : next.slices) slice.info.scan_id = "next";
    const Poses poses = run(pipeline, next, 0);
    EXPECT_LT(relative_error_mm(poses.estimated, poses.truth), 1.5);
  }
}

TEST(RegistrationEstimator, AgreementTellsPosesThatAreNotToBeTrusted) {
  PipelineOptions options = quick_options();
  options.estimator.method = "nominal";  // a head that jumps is in the wrong place
  const auto agreement = [&](std::size_t jump_at, std::size_t slices) {
    Pose jump = Pose::Identity();
    jump.linear() = Eigen::AngleAxisd(0.9, Eigen::Vector3d(1., -2., 1.).normalized()).toRotationMatrix();
    jump.translation() = Eigen::Vector3d(8., 6., -5.);
    const Scan scan = moving_scan(3, jump_at, jump);
    LivePipeline pipeline(options);
    for (std::size_t i = 0; i < slices; ++i) pipeline.add(scan.slices[i]);
    EXPECT_TRUE(std::isnan(pipeline.estimate().agreement)) << "no volume yet";
    pipeline.update_volume();
    return pipeline.estimate().agreement;
  };
  EXPECT_TRUE(std::isnan(agreement(0, 23))) << "7 slices across the first stack say little";
  EXPECT_GT(agreement(0, 24), kAgreement);
  EXPECT_GT(agreement(0, 48), kAgreement);
  EXPECT_LT(agreement(20, 48), kAgreement);
}

TEST(RegistrationEstimator, FindsTheCanonicalFrameWithATemplate) {
  const Scan scan = moving_scan();
  LivePipeline pipeline(quick_options(), {phantom_template()});
  const Poses poses = run(pipeline, scan, 0);
  double error = 0.;
  for (std::size_t i = 0; i < poses.truth.size(); ++i)
    error += ((poses.estimated[i] * Eigen::Vector3d::Zero()) - (poses.truth[i] * Eigen::Vector3d::Zero())).norm() /
             static_cast<double>(poses.truth.size());
  // The template is the head itself: what is left is the match of coarse volumes, about half of a 3 mm voxel.
  EXPECT_LT(error, 2.);
  EXPECT_GE(pipeline.estimate().frame_revision, 1U);
}

TEST(RegistrationEstimator, PosesDoNotDependOnWhenVolumesAreMade) {
  const Scan scan = moving_scan(2);
  LivePipeline never(quick_options()), often(quick_options());
  const Poses a = run(never, scan, 0), b = run(often, scan, 3);
  ASSERT_EQ(a.estimated.size(), b.estimated.size());
  for (std::size_t i = 0; i < a.estimated.size(); ++i)
    EXPECT_EQ(a.estimated[i].matrix(), b.estimated[i].matrix()) << "slice " << i;
  EXPECT_EQ(never.volume().values, often.volume().values);
}

TEST(RegistrationEstimator, TheFrameIsHeldWhileSlicesArrive) {
  // Slices that are there hold the frame: from one revision to the next they move by the correction of their own poses,
  // not together.
  const Scan scan = moving_scan(2);
  LivePipeline pipeline(quick_options());
  std::vector<Pose> before;
  std::uint64_t frame = 0;
  for (const Slice& slice : scan.slices) {
    if (!is_kept(pipeline.add(slice).status)) continue;
    std::vector<Pose> after;
    for (const SliceEstimate& each : pipeline.estimate().slices) after.push_back(each.T_brain_slice);
    if (!before.empty() && frame == pipeline.estimate().frame_revision) {
      Eigen::Vector3d mean = Eigen::Vector3d::Zero();
      for (std::size_t i = 0; i < before.size(); ++i)
        mean += (after[i].translation() - before[i].translation()) / static_cast<double>(before.size());
      EXPECT_LT(mean.norm(), 1.) << after.size() << " slices";
    }
    before = after;
    frame = pipeline.estimate().frame_revision;
  }
}

TEST(RegistrationEstimator, StartsAnewAfterReset) {
  const Scan scan = moving_scan(1);
  LivePipeline pipeline(quick_options());
  const Poses first = run(pipeline, scan, 0);
  const std::uint64_t revision = pipeline.estimate().revision;
  pipeline.reset();
  const Poses second = run(pipeline, scan, 0);
  EXPECT_GT(pipeline.estimate().revision, revision);
  ASSERT_EQ(first.estimated.size(), second.estimated.size());
  for (std::size_t i = 0; i < first.estimated.size(); ++i)
    EXPECT_EQ(first.estimated[i].matrix(), second.estimated[i].matrix());
}

TEST(RegistrationEstimator, NamesTheOptionThatIsOutOfRange) {
  PipelineOptions options = quick_options();
  options.estimator.registration.lever_mm = -1.;
  EXPECT_THROW(LivePipeline pipeline(options), std::invalid_argument);
  options = quick_options();
  options.estimator.incremental.window = 1;
  EXPECT_THROW(LivePipeline pipeline(options), std::invalid_argument);
  options = quick_options();
  options.estimator.update = "sometimes";
  EXPECT_THROW(LivePipeline pipeline(options), std::invalid_argument);
  options = quick_options();
  options.estimator.budget = "money";
  EXPECT_THROW(LivePipeline pipeline(options), std::invalid_argument);
  options = quick_options();
  options.estimator.search_every = -1;
  EXPECT_THROW(LivePipeline pipeline(options), std::invalid_argument);
  options = quick_options();
  options.estimator.template_match.refined = 0;
  EXPECT_THROW(LivePipeline pipeline(options), std::invalid_argument);
}

}  // namespace
}  // namespace svort
