#include "svort_ros/decision/slice_quality.h"

#include <gtest/gtest.h>

#include <algorithm>
#include <cmath>
#include <functional>

#include "decision/decision_fixture.h"

namespace svort {
namespace {

using svort_test::ScanSlice;

/// Three stacks, with one slice of the second one changed.
std::vector<SliceQuality> score(const std::function<void(ScanSlice&)>& damage) {
  LivePipeline pipeline(svort_test::quick_pipeline());
  for (int stack = 0; stack < 3; ++stack)
    for (ScanSlice slice : svort_test::whole_stack(stack, stack, 30. * stack)) {
      if (stack == 1 && slice.index == 8) damage(slice);
      pipeline.add(svort_test::make_slice(slice));
    }
  pipeline.update_volume();
  QualityMonitor monitor(svort_test::plain_quality());
  return monitor.update(pipeline.sequence(), pipeline.estimate(), pipeline.volume(), 30.);
}

const SliceQuality& changed(const std::vector<SliceQuality>& all) {
  for (const SliceQuality& slice : all)
    if (slice.stack == 1 && slice.index == 8) return slice;
  throw std::logic_error("the slice is not there");
}

bool has(const SliceQuality& slice, QualityReason reason) {
  return std::find(slice.reasons.begin(), slice.reasons.end(), reason) != slice.reasons.end();
}

TEST(SliceQuality, GoodSlicesScoreHigh) {
  const auto all = score([](ScanSlice&) {});
  std::vector<double> scores;
  for (const SliceQuality& slice : all) scores.push_back(slice.score);
  std::sort(scores.begin(), scores.end());
  EXPECT_GT(scores[scores.size() / 2], 0.8);
  EXPECT_TRUE(changed(all).reasons.empty());
  EXPECT_GT(changed(all).score, 0.5);
}

TEST(SliceQuality, ADarkSliceIsDark) {
  const auto good = score([](ScanSlice&) {}), all = score([](ScanSlice&slice) { slice.gain = 0.4; });
  // Against the neighbouring slices: 0.4 of the signal, to the phantom's texture.
  EXPECT_NEAR(changed(all).features.dark_image, -std::log(0.4), 0.2);
  EXPECT_GT(changed(all).features.dark_volume, 0.2);  // the volume contains the slice
  EXPECT_TRUE(has(changed(all), QualityReason::dark));
  EXPECT_LT(changed(all).score, changed(good).score - 0.3);
  EXPECT_LT(changed(all).image_score, changed(good).image_score - 0.2);
}

TEST(SliceQuality, AHoleIsAVoid) {
  const auto all = score([](ScanSlice& slice) { slice.hole_mm = 14.; });
  // Share of the slice's area, in blocks of 4 mm.
  const double share = 14. * 14. / (svort_test::kRadii.x() * svort_test::kRadii.z());
  EXPECT_NEAR(changed(all).features.void_image, share, 0.3 * share);
  EXPECT_GT(changed(all).features.void_volume, 0.4 * share);
  EXPECT_TRUE(has(changed(all), QualityReason::signal_void));
  EXPECT_FALSE(has(changed(all), QualityReason::noise));
}

TEST(SliceQuality, WhatIsUsualInTheScanIsNoDamage) {
  // Anatomy that changes from slice to slice, as where dark tissue follows bright fluid: a dark spot of another size in
  // every slice. One slice has lost more.
  LivePipeline pipeline(svort_test::quick_pipeline());
  for (int stack = 0; stack < 3; ++stack)
    for (ScanSlice slice : svort_test::whole_stack(stack, stack, 30. * stack)) {
      slice.hole_mm = stack == 1 && slice.index == 8 ? 20. : slice.index % 2 == 0 ? 4. : 8. + slice.index % 3;
      pipeline.add(svort_test::make_slice(slice));
    }
  QualityMonitor monitor(svort_test::plain_quality());
  const auto& all = monitor.update(pipeline.sequence(), pipeline.estimate(), Volume(), 30.);
  EXPECT_TRUE(has(changed(all), QualityReason::signal_void)) << changed(all).features.void_image;
  const auto spoilt =
      std::count_if(all.begin(), all.end(), [](const SliceQuality& slice) { return slice.features.void_image > 0.; });
  // About half of the slices have a larger spot than their neighbours.
  EXPECT_LT(static_cast<std::size_t>(spoilt), all.size() / 5) << "of " << all.size();
}

TEST(SliceQuality, ANoisySliceIsNoise) {
  const auto all = score([](ScanSlice& slice) { slice.noise = 150.; });
  EXPECT_GT(changed(all).features.noise, 1.);
  EXPECT_TRUE(has(changed(all), QualityReason::noise));
}

TEST(SliceQuality, AnOutlierIsWorthNothingAndAJumpIsNamed) {
  LivePipeline pipeline(svort_test::quick_pipeline());
  for (const ScanSlice& slice : svort_test::whole_stack(0, 0, 0.)) pipeline.add(svort_test::make_slice(slice));
  pipeline.update_volume();
  Estimate estimate = pipeline.estimate();
  ASSERT_GE(estimate.slices.size(), 11U);
  estimate.slices[3].weight = 0.;
  estimate.slices[6].T_scanner_brain.translation().x() += 25.;  // there and back
  for (std::size_t i = 9; i < estimate.slices.size(); ++i)
    estimate.slices[i].T_scanner_brain.translation().y() += 25.;  // and stays
  SliceQualityOptions options = svort_test::plain_quality();
  options.jump = -1.;
  QualityMonitor monitor(options);
  const auto& all = monitor.update(pipeline.sequence(), estimate, pipeline.volume(), 30.);
  EXPECT_EQ(all[3].score, 0.);
  EXPECT_TRUE(has(all[3], QualityReason::outlier));
  EXPECT_NEAR(all[6].features.jump, std::log1p(25. / 2.), 1e-9);
  EXPECT_TRUE(has(all[6], QualityReason::pose_jump));
  EXPECT_EQ(all[9].features.jump, 0.);
}

TEST(SliceQuality, TheFirstScoreStays) {
  LivePipeline pipeline(svort_test::quick_pipeline());
  QualityMonitor monitor(svort_test::plain_quality());
  double first = -1.;
  for (ScanSlice slice : svort_test::whole_stack(0, 0, 0.)) {
    if (slice.index == 2) slice.gain = 0.5;
    pipeline.add(svort_test::make_slice(slice));
    pipeline.update_volume();
    const auto& all = monitor.update(pipeline.sequence(), pipeline.estimate(), pipeline.volume(), 30.);
    for (const SliceQuality& each : all)
      if (each.index == 2) {
        if (first < 0.) first = each.score;
        EXPECT_EQ(each.first_score, first);
      }
  }
  EXPECT_GE(first, 0.);
}

TEST(SliceQuality, WithoutAVolumeTheImageSpeaks) {
  LivePipeline pipeline(svort_test::quick_pipeline());
  for (ScanSlice slice : svort_test::whole_stack(0, 0, 0.)) {
    if (slice.index == 8) slice.gain = 0.4;
    pipeline.add(svort_test::make_slice(slice));
  }
  QualityMonitor monitor(svort_test::plain_quality());
  const auto& all = monitor.update(pipeline.sequence(), pipeline.estimate(), Volume(), 30.);
  for (const SliceQuality& slice : all) {
    EXPECT_TRUE(std::isnan(slice.features.void_volume));
    EXPECT_TRUE(std::isfinite(slice.score));
    if (slice.index == 8) {
      EXPECT_TRUE(has(slice, QualityReason::dark));
    }
  }
  EXPECT_THROW(monitor.update(pipeline.sequence(), Estimate(), Volume(), 30.), std::invalid_argument);
}

TEST(SliceQuality, BlocksLieWhereTheirPixelsDo) {
  PreparedSlice slice;
  slice.size = 64;
  slice.resolution = 1.;
  slice.T_slice_crop.translation() << 5., -3., 0.;
  slice.pixels.assign(64 * 64, 0.F);
  slice.mask.assign(64 * 64, 0);
  for (int row = 30; row < 33; ++row)  // block (10, 10) of 3 x 3 pixels
    for (int column = 30; column < 33; ++column) {
      slice.pixels[static_cast<std::size_t>(row * 64 + column)] = 7.F;
      slice.mask[static_cast<std::size_t>(row * 64 + column)] = 1;
    }
  slice.brain_pixels = 9;
  const SliceBlocks blocks = make_blocks(slice);
  ASSERT_EQ(blocks.size, 21);
  const int at = 10 * 21 + 10;
  EXPECT_EQ(blocks.brain[at], 1);
  EXPECT_EQ(std::count(blocks.brain.begin(), blocks.brain.end(), 1), 1);
  EXPECT_EQ(blocks.mean[at], 7.F);
  // Pixel 31 of 64 is half a pixel before the crop's centre.
  EXPECT_TRUE(blocks.centre(10, 10).isApprox(Eigen::Vector3d(4.5, -3.5, 0.), 1e-12));
  EXPECT_EQ(blocks.at(Eigen::Vector3d(4.5, -3.5, 0.)), at);
  EXPECT_EQ(blocks.at(Eigen::Vector3d(400., 0., 0.)), -1);
}

TEST(SliceQuality, OptionsOutOfRangeAreNamed) {
  SliceQualityOptions options;
  options.noise = std::nan("");
  EXPECT_THROW(QualityMonitor{options}, std::invalid_argument);
  options = SliceQualityOptions();
  options.accept = 1.5;
  try {
    validate(options);
    FAIL() << "was accepted";
  } catch (const std::invalid_argument& error) {
    EXPECT_STREQ(error.what(), "decision.quality.accept is 1.5; it must be from 0 to 1");
  }
}

}  // namespace
}  // namespace svort
