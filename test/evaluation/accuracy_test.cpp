#include "svort_ros/evaluation/accuracy.h"

#include <gtest/gtest.h>
#include <torch/types.h>

#include <cmath>
#include <stdexcept>

#include "evaluation_fixture.h"
#include "svort_ros/evaluation/left_out.h"

namespace svort {
namespace {

using svort_test::quick_setup;
using svort_test::small_brain;

PoseMethod method(PoseSource source) {
  PoseMethod result;
  result.name = "method";
  result.source = source;
  return result;
}

TEST(Accuracy, TheScansFollowTheirOptions) {
  EvaluationScanOptions options;
  options.motion = "none";
  const EvaluationScan three = simulate_evaluation_scan(small_brain(), options);
  options.stacks = 1;
  const EvaluationScan one = simulate_evaluation_scan(small_brain(), options);
  ASSERT_EQ(three.slices.size(), three.truth.size());
  EXPECT_EQ(three.slices.back().info.stack, 2);
  EXPECT_EQ(one.slices.back().info.stack, 0);
  // The same scan, cut: the first stack's slices are the same bytes.
  for (std::size_t i = 0; i < one.slices.size(); ++i) EXPECT_EQ(one.slices[i].pixels, three.slices[i].pixels);
  options.damaged_masks = true;
  const EvaluationScan damaged = simulate_evaluation_scan(small_brain(), options);
  const auto brain_pixels = [](const EvaluationScan& scan) {
    std::size_t count = 0;
    for (const Slice& slice : scan.slices)
      for (const std::uint8_t pixel : slice.mask) count += pixel;
    return count;
  };
  EXPECT_LT(brain_pixels(damaged), brain_pixels(one));
  options.stacks = 4;
  EXPECT_THROW(simulate_evaluation_scan(small_brain(), options), std::invalid_argument);
}

TEST(Accuracy, NominalPosesOfAHeadAtRestAreRightAndOfAMovingOneAreNot) {
  EvaluationScanOptions options;
  options.motion = "none";
  const AccuracyRow rest =
      measure_accuracy(simulate_evaluation_scan(small_brain(), options), method(PoseSource::nominal), quick_setup());
  EXPECT_LT(rest.relative_ed_mm, 1e-3);
  EXPECT_LT(rest.relative_gd_rad, 1e-4);
  EXPECT_TRUE(std::isnan(rest.atlas.ed_mm)) << "there is no template, so the frame is unknown";

  options.motion = "moderate";
  const EvaluationScan scan = simulate_evaluation_scan(small_brain(), options);
  const AccuracyRow nominal = measure_accuracy(scan, method(PoseSource::nominal), quick_setup());
  const AccuracyRow registered = measure_accuracy(scan, method(PoseSource::registration), quick_setup());
  EXPECT_GT(nominal.relative_ed_mm, 2.) << "the scan must hold something to be found";
  EXPECT_LT(registered.relative_ed_mm, 0.5 * nominal.relative_ed_mm);
  EXPECT_EQ(nominal.slices, registered.slices);
}

TEST(Accuracy, AHeadAtRestIsReportedToMoveByLessThanHalfAMillimetre) {
  // Noise, bias and voids as usual: what registration makes of them must not look like motion. 0.2 to 0.4 mm measured.
  EvaluationScanOptions options;
  options.motion = "none";
  const AccuracyRow row = measure_accuracy(simulate_evaluation_scan(small_brain(), options),
                                           method(PoseSource::registration), quick_setup());
  EXPECT_LT(row.relative_ed_mm, 0.5);
}

TEST(Accuracy, VolumesAreComparedWithTheTruth) {
  EvaluationScanOptions options;
  options.motion = "none";
  PoseMethod nominal = method(PoseSource::nominal);
  nominal.with_volume = true;
  AccuracySetup setup = quick_setup();
  setup.pipeline.estimator.final_volume.passes = 2;
  const AccuracyRow row = measure_accuracy(simulate_evaluation_scan(small_brain(), options), nominal, setup);
  EXPECT_GT(row.psf.psnr_db, 10.);
  EXPECT_GT(row.final.psnr_db, row.psf.psnr_db) << "poses are true, so the inverse problem must sharpen";
  EXPECT_GT(row.final.ssim, row.psf.ssim);
  EXPECT_LT(row.final.ssim, 1.);
}

TEST(Accuracy, CausalPosesAreCountedAgainstTheirRadii) {
  EvaluationScanOptions options;
  options.motion = "mild";
  options.stacks = 2;
  const EvaluationScan scan = simulate_evaluation_scan(small_brain(), options);
  AccuracySetup setup = quick_setup();
  const auto measured = [&](double factor) {
    setup.pipeline.estimator.radius_factor = setup.pipeline.estimator.radius_factor_one_stack = factor;
    return measure_accuracy(scan, method(PoseSource::live), setup);
  };
  const AccuracyRow wide = measured(1e3), narrow = measured(1e-3);
  for (const RadiusScore AccuracyRow::*score : {&AccuracyRow::radius, &AccuracyRow::radius_one_stack}) {
    EXPECT_GT((wide.*score).slices, 10U);
    EXPECT_EQ((wide.*score).within, (wide.*score).slices);
    EXPECT_EQ((narrow.*score).slices, (wide.*score).slices);
    EXPECT_EQ((narrow.*score).within, 0U);
    EXPECT_NEAR((narrow.*score).ratio_95, 1e6 * (wide.*score).ratio_95, 1.) << "errors do not depend on the factor";
  }
  EXPECT_EQ(wide.network_starts, 0U) << "there is no network";
  EXPECT_GT(wide.followed_ed_mm, 0.);
  EXPECT_LT(wide.followed_ed_mm, 5.);
}

TEST(StackCorrelations, RightPosesPredictTheStackThatIsLeftOut) {
  EvaluationScanOptions options;
  options.motion = "moderate";
  const EvaluationScan scan = simulate_evaluation_scan(small_brain(), options);
  const auto mean = [&](const char* name) {
    PipelineOptions pipeline_options = quick_setup().pipeline;
    pipeline_options.estimator.method = name;
    LivePipeline pipeline(pipeline_options);
    for (const Slice& slice : scan.slices) pipeline.add(slice);
    pipeline.finalise();
    StackCorrelation sum;
    const auto stacks = stack_correlations(pipeline);
    EXPECT_EQ(stacks.size(), 3U);
    for (const auto& [stack, correlation] : stacks) {
      sum.with_all += correlation.with_all / 3.;
      sum.with_others += correlation.with_others / 3.;
    }
    EXPECT_LT(sum.with_others, sum.with_all);
    return sum;
  };
  const StackCorrelation nominal = mean("nominal"), registered = mean("registration");
  EXPECT_GT(registered.with_others, nominal.with_others + 0.05);
}

}  // namespace
}  // namespace svort
