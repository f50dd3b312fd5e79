#include "svort_ros/decision/coverage.h"

#include <gtest/gtest.h>

#include <cmath>
#include <numeric>

#include "decision/decision_fixture.h"

namespace svort {
namespace {

using svort_test::ScanSlice;

DecisionOptions perfect_slices() {
  DecisionOptions options;  // every slice counts as good, so that views can be counted by hand
  options.quality.intercept = 50.;
  return options;
}

struct Scan {
  explicit Scan(const DecisionOptions& options = perfect_slices())
      : pipeline(svort_test::quick_pipeline()), engine(options) {}
  void add(const ScanSlice& slice) { svort_test::feed(svort_test::make_slice(slice), &pipeline, &engine); }
  void add(const std::vector<ScanSlice>& slices) {
    for (const ScanSlice& slice : slices) add(slice);
  }
  LivePipeline pipeline;
  DecisionEngine engine;
};

TEST(Place, ScoreCountsViewsAndTheWorstDirection) {
  const CoverageTarget target{2., 1.};
  ViewTensor tensor{};
  EXPECT_EQ(place_score(tensor, target), 0.);
  add_view(&tensor, Eigen::Vector3d::UnitX(), 1.);
  EXPECT_NEAR(place_score(tensor, target), 0.25, 1e-6);  // half of the views, none of them sharp along x
  EXPECT_NEAR(orientation_count(tensor), 1., 1e-6);
  add_view(&tensor, Eigen::Vector3d::UnitX(), 3.);
  EXPECT_NEAR(place_score(tensor, target), 0.5, 1e-6);  // more of the same do not help
  add_view(&tensor, Eigen::Vector3d::UnitY(), 0.5);
  EXPECT_NEAR(place_score(tensor, target), 0.75, 1e-6);
  ViewTensor all{};
  for (int axis = 0; axis < 3; ++axis) add_view(&all, Eigen::Vector3d::Unit(axis), 1.);
  EXPECT_NEAR(orientation_count(all), 3., 1e-6);
  EXPECT_NEAR(view_count(all), 3., 1e-6);
  EXPECT_EQ(place_score(all, target), 1.);
}

TEST(Place, GaplessSlicesAddUpToOne) {
  for (double z = 0.; z < 3.; z += 0.25) {
    double sum = 0.;
    for (int k = -5; k <= 5; ++k) sum += profile_weight(z - 3. * k, 3.);
    EXPECT_NEAR(sum, 1., 0.07) << z;  // a Gaussian's sum ripples by 6 % at this spacing
  }
}

TEST(Coverage, TargetGrowsWithTheProtocol) {
  CoverageOptions options;
  EXPECT_NEAR(coverage_target(options, 1).views, 2. / 3., 1e-12);
  EXPECT_EQ(coverage_target(options, 1).sharp_views, 0.);
  EXPECT_NEAR(coverage_target(options, 2).sharp_views, 0.5, 1e-12);
  EXPECT_EQ(coverage_target(options, 3).views, 2.);
  EXPECT_EQ(coverage_target(options, 7).views, 2.);
  options.planned_stacks = 1;
  EXPECT_EQ(coverage_target(options, 1).sharp_views, 1.);
}

TEST(Coverage, WholeStacksSeeTheBrain) {
  Scan scan;
  scan.add(svort_test::whole_stack(0, 0, 0.));
  const double ellipsoid = 4. / 3. * M_PI * svort_test::kRadii.prod();
  // The hull reaches from pixel to pixel and slice to slice; a voxel of 4 mm more or less is 15 % of such a volume.
  EXPECT_NEAR(scan.engine.coverage().brain_mm3, ellipsoid, 0.15 * ellipsoid);
  EXPECT_NEAR(scan.engine.coverage().mean_orientations, 1., 0.01);
  EXPECT_GT(scan.engine.coverage().seen_well, 0.93);  // of what one stack can do
  EXPECT_EQ(scan.engine.coverage().complete, 0.);     // one orientation is never complete
  scan.add(svort_test::whole_stack(1, 1, 30.));
  EXPECT_NEAR(scan.engine.coverage().mean_orientations, 2., 0.1);
  scan.add(svort_test::whole_stack(2, 2, 60.));
  const CoverageMap& map = scan.engine.coverage();
  EXPECT_EQ(map.stacks, 3);
  EXPECT_NEAR(map.mean_orientations, 3., 0.2);
  EXPECT_GT(map.complete, 0.95);
  EXPECT_EQ(map.complete, map.seen_well);
  const Volume scores = map.score_volume();
  ASSERT_EQ(scores.values.size(), map.grid.voxel_count());
  EXPECT_NEAR(std::accumulate(scores.values.begin(), scores.values.end(), 0.) / static_cast<double>(map.places),
              map.mean_score, 1e-6);
}

TEST(Coverage, FindsAGapWithItsPlaceAndWidth) {
  // Four neighbouring slices are missing in the middle of the only stack: 16 mm that nobody has seen.
  Scan scan;
  for (const ScanSlice& slice : svort_test::whole_stack(0, 0, 0.))
    if (slice.index < 6 || slice.index > 9) scan.add(slice);
  ScanSlice next = svort_test::whole_stack(1, 1, 60.).front();
  scan.add(next);  // the first stack is over
  const CoverageMap& map = scan.engine.coverage();
  ASSERT_FALSE(map.gaps.empty());
  const CoverageGap& gap = map.gaps.front();
  EXPECT_NEAR(gap.width_mm, 16., 4.1);  // to a voxel
  EXPECT_NEAR(gap.centre.z() + scan.pipeline.estimate().slices[0].T_scanner_brain.translation().z(), 0., 4.1);
  const double disc_ml = M_PI * svort_test::kRadii.x() * svort_test::kRadii.y() * 16. * 1e-3;
  EXPECT_NEAR(gap.volume_ml, disc_ml, 0.35 * disc_ml);  // its ends are nearer to the slices by a voxel
}

TEST(Coverage, ABadSliceSeesLessAndAnOutlierNothing) {
  Scan good;
  good.add(svort_test::whole_stack(0, 0, 0.));
  Estimate estimate = good.pipeline.estimate();
  QualityMonitor quality{perfect_slices().quality};
  quality.update(good.pipeline.sequence(), estimate, good.pipeline.volume(), 30.);
  const double before = measure_coverage(estimate, quality, 1, {}).seen_well;
  for (SliceEstimate& slice : estimate.slices)
    if (slice.info.index == 7) slice.weight = 0.;
  quality.update(good.pipeline.sequence(), estimate, good.pipeline.volume(), 30.);
  const double after = measure_coverage(estimate, quality, 1, {}).seen_well;
  EXPECT_LT(after, before - 0.03);  // a slice in the middle is 7 % of the ellipsoid
  QualityMonitor other{perfect_slices().quality};
  EXPECT_THROW(measure_coverage(estimate, other, 1, {}), std::invalid_argument);
}

TEST(Coverage, OptionsOutOfRangeAreNamed) {
  CoverageOptions options;
  options.well = 0.;
  try {
    validate(options);
    FAIL() << "was accepted";
  } catch (const std::invalid_argument& error) {
    EXPECT_STREQ(error.what(), "decision.coverage.well is 0; it must be in (0, 1]");
  }
}

}  // namespace
}  // namespace svort
