#include <gtest/gtest.h>
#include <torch/types.h>

#include <algorithm>
#include <cmath>
#include <filesystem>
#include <string>
#include <vector>

#include "svort_ros/live/live_pipeline.h"
#include "synthetic_scan.h"

namespace svort {
namespace {

/// Poses of the default weights over a synthetic scan, with the forward model in this formulation.
std::vector<Pose> poses_with(const std::string& formulation) {
  PipelineOptions options;
  options.estimator.method = "network";
  options.estimator.network.weights = (std::filesystem::path(SVORT_SOURCE_DIR) / "models" / "live.pt").string();
  options.estimator.network.formulation = formulation;
  LivePipeline pipeline(options);
  for (const Slice& slice : svort_test::synthetic_scan()) EXPECT_TRUE(is_kept(pipeline.add(slice).status));
  EXPECT_TRUE(pipeline.finalise());
  std::vector<Pose> poses;
  for (const SliceEstimate& slice : pipeline.estimate().slices) poses.push_back(slice.T_brain_slice);
  return poses;
}

// Networks with random weights react to every change of the volume (golden_svort_test); trained ones must not.
TEST(LiveWeights, TheFastForwardModelMovesNoPoseByATenth) {
  const std::vector<Pose> exact = poses_with("exact"), fast = poses_with("fast");
  ASSERT_EQ(exact.size(), fast.size());
  ASSERT_GT(exact.size(), 10U);
  double shift_mm = 0., turn_deg = 0.;
  for (std::size_t i = 0; i < exact.size(); ++i) {
    shift_mm = std::max(shift_mm, (exact[i].translation() - fast[i].translation()).norm());
    const Eigen::AngleAxisd turn(exact[i].linear().transpose() * fast[i].linear());
    turn_deg = std::max(turn_deg, turn.angle() * 180. / M_PI);
  }
  std::cout << "largest difference over " << exact.size() << " slices: " << shift_mm << " mm, " << turn_deg
            << " degrees\n";
  EXPECT_GT(shift_mm, 0.) << "both ran the same formulation";
  EXPECT_LT(shift_mm, 0.1);
  EXPECT_LT(turn_deg, 0.1);
}

}  // namespace
}  // namespace svort
