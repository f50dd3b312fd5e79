#include "svort_ros/live/live_pipeline.h"

#include <gtest/gtest.h>

#include <algorithm>
#include <atomic>
#include <cmath>
#include <random>

#include "svort_ros/live/threads.h"
#include "synthetic_scan.h"

namespace svort {
namespace {

using svort_test::phantom_intensity;
using svort_test::synthetic_scan;
using svort_test::SyntheticScanOptions;

PipelineOptions small_options() {
  PipelineOptions options;
  options.estimator.method = "nominal";
  options.estimator.volume_resolution_mm = 2.;
  options.estimator.volume_size_mm = 96.;
  options.estimator.final_volume.resolution_mm = options.estimator.volume_resolution_mm;
  return options;
}

double distance_mm(const Pose& a, const Pose& b) { return (a.translation() - b.translation()).norm(); }

TEST(LivePipeline, NominalPosesPlaceEverySliceWhereTheScannerSaidItWas) {
  LivePipeline pipeline(small_options());
  for (const Slice& slice : synthetic_scan()) {
    ASSERT_TRUE(is_kept(pipeline.add(slice).status));
    ASSERT_NE(pipeline.newest(), nullptr);
    EXPECT_EQ(pipeline.newest()->info.stamp_ns, slice.info.stamp_ns);
  }
  ASSERT_EQ(pipeline.estimate().slices.size(), 24U);
  for (const SliceEstimate& slice : pipeline.estimate().slices) {
    const Pose back = slice.T_scanner_brain * slice.T_brain_slice;
    EXPECT_LT(distance_mm(back, slice.info.T_scanner_slice), 1e-9);
    EXPECT_TRUE(back.linear().isApprox(slice.info.T_scanner_slice.linear(), 1e-12));
    EXPECT_EQ(slice.status, PoseStatus::nominal);
    EXPECT_TRUE(slice.T_scanner_brain.isApprox(pipeline.estimate().slices.front().T_scanner_brain))
        << "a head that is assumed not to move has one pose";
  }
}

TEST(LivePipeline, BrainFrameSettlesAtTheCentreOfTheBrain) {
  LivePipeline pipeline(small_options());
  const SyntheticScanOptions scan;
  for (const Slice& slice : synthetic_scan(scan)) pipeline.add(slice);
  const Eigen::Vector3d origin = pipeline.estimate().slices.front().T_scanner_brain.translation();
  EXPECT_LE((origin - scan.centre_mm).norm(), pipeline.options().estimator.recentre_mm + 2.);
  EXPECT_GE(pipeline.estimate().frame_revision, 1U) << "the first slice lies at the edge of the brain";
}

TEST(LivePipeline, FinalVolumeShowsThePhantomInItsPlace) {
  LivePipeline pipeline(small_options());
  const SyntheticScanOptions scan;
  for (const Slice& slice : synthetic_scan(scan)) pipeline.add(slice);
  ASSERT_TRUE(pipeline.finalise());
  EXPECT_TRUE(pipeline.estimate().final);
  EXPECT_FALSE(pipeline.finalise()) << "nothing has changed since";

  const Volume& volume = pipeline.volume();
  const Pose T_scanner_brain = pipeline.estimate().slices.front().T_scanner_brain;
  const double scale = pipeline.sequence().intensity_scale();
  double error = 0., norm = 0.;
  int voxels = 0;
  for (int k = 0; k < volume.grid.size.z(); ++k)
    for (int j = 0; j < volume.grid.size.y(); ++j)
      for (int i = 0; i < volume.grid.size.x(); ++i) {
        const Eigen::Vector3d p = T_scanner_brain * volume.grid.position(Eigen::Vector3d(i, j, k)) - scan.centre_mm;
        if (p.cwiseQuotient(Eigen::Vector3d(20., 26., 18.)).squaredNorm() > 1. || std::abs(p.z()) > 12.) continue;
        const double truth = phantom_intensity(p) / scale;
        const double difference = volume.values[volume.grid.offset(i, j, k)] - truth;
        error += difference * difference;
        norm += truth * truth;
        ++voxels;
      }
  ASSERT_GT(voxels, 1000);
  // Partial volume and interpolation leave some per cent; a flipped axis gives more than 20.
  EXPECT_LT(std::sqrt(error / norm), .05);
  for (const SliceEstimate& slice : pipeline.estimate().slices) EXPECT_GT(slice.ncc, .9) << describe(slice.info);
}

TEST(LivePipeline, FinalStateDoesNotDependOnWhenVolumesWereUpdated) {
  set_thread_count(2);
  const std::vector<Slice> scan = synthetic_scan();
  LivePipeline every(small_options()), never(small_options());
  for (const Slice& slice : scan) {
    every.add(slice);
    EXPECT_TRUE(every.update_volume());
    EXPECT_FALSE(every.update_volume()) << "no new slice, no new volume";
    never.add(slice);
  }
  every.finalise();
  never.finalise();
  EXPECT_EQ(every.volume().values, never.volume().values);
  for (std::size_t i = 0; i < scan.size(); ++i) {
    EXPECT_EQ(every.estimate().slices[i].T_brain_slice.matrix(), never.estimate().slices[i].T_brain_slice.matrix());
    EXPECT_EQ(every.estimate().slices[i].ncc, never.estimate().slices[i].ncc);
  }
}

TEST(LivePipeline, FinalisingCanBeGivenUpAndTakenUpAgain) {
  PipelineOptions options = small_options();
  options.estimator.method = "registration";
  options.estimator.registration.finest_mm = 3.;
  LivePipeline stopped(options), straight(options);
  for (const Slice& slice : synthetic_scan()) {
    stopped.add(slice);
    straight.add(slice);
  }
  const Estimate before = stopped.estimate();
  const std::atomic<bool> stop{true};
  EXPECT_FALSE(stopped.finalise(&stop));
  EXPECT_FALSE(stopped.estimate().final);
  EXPECT_EQ(stopped.estimate().revision, before.revision);
  for (std::size_t i = 0; i < before.slices.size(); ++i)
    EXPECT_EQ(stopped.estimate().slices[i].T_brain_slice.matrix(), before.slices[i].T_brain_slice.matrix());

  EXPECT_TRUE(stopped.finalise());
  EXPECT_TRUE(straight.finalise());
  EXPECT_TRUE(stopped.estimate().final);
  EXPECT_EQ(stopped.volume().values, straight.volume().values);
}

TEST(LivePipeline, AScanIsTheSameFinalisedOnOneCore) {
  PipelineOptions options = small_options();
  options.estimator.method = "registration";
  options.estimator.registration.finest_mm = 3.;
  set_thread_count(2);
  LivePipeline one(options), two(options);
  for (const Slice& slice : synthetic_scan()) {
    one.add(slice);
    two.add(slice);
  }
  {
    const OneCoreScope one_core(2);
    one.finalise();
  }
  EXPECT_EQ(thread_count(), 2);
  two.finalise();
  EXPECT_EQ(one.volume().values, two.volume().values);
  for (std::size_t i = 0; i < one.estimate().slices.size(); ++i)
    EXPECT_EQ(one.estimate().slices[i].T_brain_slice.matrix(), two.estimate().slices[i].T_brain_slice.matrix());
}

TEST(LivePipeline, SlicesInAnyOrderAreKeptInAcquisitionOrder) {
  std::vector<Slice> scan = synthetic_scan();
  std::shuffle(scan.begin(), scan.end(), std::mt19937(7));
  LivePipeline pipeline(small_options());
  for (const Slice& slice : scan) {
    ASSERT_TRUE(is_kept(pipeline.add(slice).status));
    EXPECT_EQ(pipeline.newest()->info.index, slice.info.index);
    EXPECT_EQ(pipeline.newest()->info.stack, slice.info.stack);
  }
  const auto& slices = pipeline.estimate().slices;
  ASSERT_EQ(slices.size(), scan.size());
  for (std::size_t i = 1; i < slices.size(); ++i) EXPECT_LT(slices[i - 1].info.stamp_ns, slices[i].info.stamp_ns);
}

TEST(LivePipeline, RevisionsOnlyGoUp) {
  LivePipeline pipeline(small_options());
  std::uint64_t last = 0;
  for (const Slice& slice : synthetic_scan()) {
    pipeline.add(slice);
    EXPECT_GT(pipeline.estimate().revision, last);
    last = pipeline.estimate().revision;
  }
  pipeline.reset();
  EXPECT_EQ(pipeline.newest(), nullptr);
  EXPECT_TRUE(pipeline.estimate().slices.empty());
  pipeline.add(synthetic_scan().front());
  EXPECT_GT(pipeline.estimate().revision, last);
}

TEST(LivePipeline, AChangedScanIdHandsTheFinishedScanOver) {
  LivePipeline pipeline(small_options());
  int ended = 0;
  pipeline.set_scan_end_callback([&](const LivePipeline& p) {
    ++ended;
    EXPECT_EQ(p.sequence().scan_id(), "synthetic");
    EXPECT_EQ(p.estimate().slices.size(), 24U);
    EXPECT_TRUE(p.estimate().final);
    EXPECT_FALSE(p.volume().empty());
  });
  for (const Slice& slice : synthetic_scan()) pipeline.add(slice);
  SyntheticScanOptions next;
  next.scan_id = "second";
  next.start_s = 500.;
  const Arrival arrival = pipeline.add(synthetic_scan(next).front());
  EXPECT_TRUE(arrival.starts_scan);
  EXPECT_EQ(ended, 1);
  EXPECT_EQ(pipeline.estimate().scan_id, "second");
  EXPECT_EQ(pipeline.estimate().slices.size(), 1U);
  EXPECT_TRUE(pipeline.volume().empty());

  EXPECT_EQ(pipeline.add(synthetic_scan().front()).status, ArrivalStatus::ended_scan);
  EXPECT_EQ(ended, 1);
  EXPECT_EQ(pipeline.estimate().scan_id, "second");
}

TEST(LivePipeline, ABadSliceOfAnotherScanDoesNotEndThisOne) {
  LivePipeline pipeline(small_options());
  for (const Slice& slice : synthetic_scan()) pipeline.add(slice);
  Slice bad = synthetic_scan().front();
  bad.info.scan_id = "second";
  bad.pixels[3] = std::nanf("");
  EXPECT_EQ(pipeline.add(bad).status, ArrivalStatus::bad_image);
  EXPECT_EQ(pipeline.estimate().slices.size(), 24U);
}

TEST(LivePipeline, StacksOfDifferentThicknessShareOneVolume) {
  LivePipeline pipeline(small_options());
  SyntheticScanOptions thick;
  thick.stacks = 2;
  for (Slice slice : synthetic_scan(thick)) {
    if (slice.info.stack == 1) slice.info.thickness = 6.;
    ASSERT_TRUE(is_kept(pipeline.add(slice).status));
  }
  pipeline.finalise();
  for (const SliceEstimate& slice : pipeline.estimate().slices) EXPECT_GT(slice.ncc, .9) << describe(slice.info);
}

TEST(MakeEstimator, NamesTheOptionThatIsWrong) {
  const auto message = [](const EstimatorOptions& options) {
    try {
      make_estimator(options);
    } catch (const std::invalid_argument& error) {
      return std::string(error.what());
    }
    return std::string("accepted");
  };
  EstimatorOptions options;
  EXPECT_EQ(message(options), "accepted");
  options.method = "magic";
  EXPECT_NE(message(options).find("'magic'"), std::string::npos);
  options = {};
  options.formulation = "quick";
  EXPECT_NE(message(options).find("estimator.formulation"), std::string::npos);
  EXPECT_NE(message(options).find("'quick'"), std::string::npos);
  options.formulation = "exact";
  EXPECT_EQ(message(options), "accepted");
  options = {};
  options.volume_resolution_mm = 0.;
  EXPECT_NE(message(options).find("volume_resolution_mm"), std::string::npos);
  options = {};
  options.volume_size_mm = std::nan("");
  EXPECT_NE(message(options).find("volume_size_mm"), std::string::npos);
  options = {};
  options.recentre_mm = -1.;
  EXPECT_NE(message(options).find("recentre_mm"), std::string::npos);
  options = {};
  options.final_volume.passes = -1;
  EXPECT_NE(message(options).find("final_volume.passes"), std::string::npos);
}

}  // namespace
}  // namespace svort
