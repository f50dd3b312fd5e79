// Simulated scans as files: written, replayed, scored.

#include "svort_ros/ros/simulate.h"

#include <gtest/gtest.h>

#include <algorithm>
#include <fstream>
#include <nlohmann/json.hpp>

#include "ros/synthetic_scan.h"
#include "svort_ros/io/evaluation.h"
#include "svort_ros/io/nifti.h"
#include "svort_ros/io/tables.h"
#include "svort_ros/ros/bag.h"
#include "svort_ros/ros/conversions.h"
#include "svort_ros/ros/replay.h"

namespace svort_ros {
namespace {

namespace fs = std::filesystem;
using svort_test::read_bytes;
using svort_test::TemporaryFolder;

/// A small, quick scan: two stacks of 2 mm pixels.
SimulateOptions small_scan(const fs::path& folder) {
  SimulateOptions options;
  options.output = folder.string();
  options.simulator.size_px = 64;
  options.simulator.resolution_mm = 2.;
  options.simulator.scanner.stacks_min = options.simulator.scanner.stacks_max = 2;
  options.simulator.artifacts.drop_share = 0.1;
  options.phantom.length_mm = 70.;
  options.phantom.resolution_mm = 2.;
  return options;
}

int run(int (*program)(int, char**), std::vector<std::string> words) {
  std::vector<char*> argv;
  for (std::string& word : words) argv.push_back(word.data());
  return program(static_cast<int>(argv.size()), argv.data());
}

std::string error_of(const SimulateOptions& options) {
  try {
    simulate(options);
  } catch (const std::exception& error) {
    return error.what();
  }
  return "no error";
}

TEST(Simulate, StacksAndBagHoldTheSameScan) {
  const TemporaryFolder folder;
  const SimulateOptions options = small_scan(folder.path());
  const std::vector<std::string> replay = simulate(options);
  for (const char* name : {"stack_0.nii.gz", "mask_0.nii.gz", "stack_1.nii.gz", "mask_1.nii.gz", "scan.bag",
                           "truth.csv", "volume.nii.gz", "scan.json", "scan.png"})
    EXPECT_TRUE(fs::exists(folder.path() / name)) << name;
  EXPECT_FALSE(fs::exists(folder.path() / "stack_2.nii.gz"));

  std::ifstream file(folder.path() / "scan.json");
  const nlohmann::json json = nlohmann::json::parse(file);
  svort::StackTimingOptions timing;
  timing.interleave = json["interleave"];
  timing.tr_s = json["tr_s"];
  timing.thickness_mm = json["thickness_mm"];
  const auto slices =
      svort::read_stacks({folder.path() / "stack_0.nii.gz", folder.path() / "stack_1.nii.gz"},
                         {folder.path() / "mask_0.nii.gz", folder.path() / "mask_1.nii.gz"}, "simulated", timing);
  const std::vector<Slice> messages = read_slices(folder.path() / "scan.bag", "slices");
  const auto truth = svort::read_pose_table(folder.path() / "truth.csv");
  ASSERT_EQ(messages.size(), truth.size());
  ASSERT_EQ(slices.size(), json["slices"].get<std::size_t>());
  EXPECT_GT(json["dropped"].get<std::size_t>(), 0U);
  ASSERT_EQ(slices.size(), truth.size() + json["dropped"].get<std::size_t>());
  std::size_t next = 0;  // dropped slices are in the files, black, but not in the bag
  for (const svort::Slice& slice : slices) {
    if (next == messages.size() || messages[next].stack != slice.info.stack ||
        messages[next].index != slice.info.index) {
      EXPECT_EQ(*std::max_element(slice.pixels.begin(), slice.pixels.end()), 0.F);
      continue;
    }
    const SliceFromMessage message = from_msg(messages[next]);
    ASSERT_TRUE(message.ok) << message.reason;
    EXPECT_EQ(message.slice.pixels, slice.pixels);
    EXPECT_EQ(message.slice.mask, slice.mask);
    EXPECT_NEAR(double(message.slice.info.stamp_ns), double(slice.info.stamp_ns), 1000.);  // 1 us
    EXPECT_NEAR(message.slice.info.thickness, slice.info.thickness, 1e-6);
    // 1e-4 mm for float32 affines of some 100 mm
    EXPECT_LT((message.slice.info.T_scanner_slice.matrix() - slice.info.T_scanner_slice.matrix()).norm(), 1e-4);
    EXPECT_EQ(truth[next].stack, slice.info.stack);
    EXPECT_EQ(truth[next].slice, slice.info.index);
    EXPECT_NEAR(double(truth[next].stamp_ns), double(slice.info.stamp_ns), 1000.);
    ++next;
  }
  EXPECT_EQ(next, messages.size());
  EXPECT_EQ(replay[0], "svort_replay");
}

TEST(Simulate, IsTheSameBytesForTheSameSeed) {
  const TemporaryFolder first, second, third;
  simulate(small_scan(first.path()));
  simulate(small_scan(second.path()));
  SimulateOptions other = small_scan(third.path());
  other.scan = 1;
  simulate(other);
  for (const char* name : {"stack_0.nii.gz", "mask_1.nii.gz", "scan.bag", "truth.csv", "volume.nii.gz", "scan.png"})
    EXPECT_EQ(read_bytes(first.path() / name), read_bytes(second.path() / name)) << name;
  EXPECT_NE(read_bytes(first.path() / "truth.csv"), read_bytes(third.path() / "truth.csv"));
}

TEST(Simulate, CanBeReplayedAndScored) {
  const TemporaryFolder folder;
  SimulateOptions options = small_scan(folder.path() / "scan");
  options.simulator.motion = "none";
  options.simulator.artifacts = svort::no_artifacts();
  std::vector<std::string> replay = simulate(options);
  for (const char* word : {"--estimator.method", "nominal", "--estimator.volume_resolution_mm", "4", "--threads", "1"})
    replay.emplace_back(word);
  std::vector<std::string> from_bag{"svort_replay",
                                    "--bag",
                                    (folder.path() / "scan/scan.bag").string(),
                                    "--output",
                                    (folder.path() / "bag").string(),
                                    "--estimator.method",
                                    "nominal",
                                    "--estimator.volume_resolution_mm",
                                    "4",
                                    "--threads",
                                    "1"};
  replay.insert(replay.end(), {"--output", (folder.path() / "stacks").string()});
  ASSERT_EQ(run(run_svort_replay, replay), 0);
  ASSERT_EQ(run(run_svort_replay, from_bag), 0);
  for (const char* input : {"bag", "stacks"}) {
    const std::string poses = (folder.path() / input / "poses.csv").string();
    const std::string truth = (folder.path() / "scan/truth.csv").string();
    ASSERT_EQ(run(svort::run_svort_evaluate, {"svort_evaluate", "--poses", poses, "--truth", truth, "--output",
                                              (folder.path() / "score").string()}),
              0);
    const auto evaluation =
        svort::evaluate_poses(svort::read_pose_table(poses), svort::read_pose_table(truth), {}, poses, truth);
    ASSERT_EQ(evaluation.scores.size(), 3U);  // all, and two stacks
    // A head at rest: nominal poses are right up to the frame. float32 affines of some 100 mm leave 1e-4 mm.
    EXPECT_LT(evaluation.scores[0].relative_ed.maximum, 1e-2) << input;
    EXPECT_GT(evaluation.scores[0].ed.mean, 1.) << input;
    EXPECT_NE(read_bytes(folder.path() / "score/evaluation.csv").find("relative_ed_mm_mean"), std::string::npos);
  }
}

TEST(Simulate, ErrorsNameWhatIsWrong) {
  const TemporaryFolder folder;
  SimulateOptions options = small_scan(folder.path());
  options.simulator.scanner.reversed_share = 0.5;
  EXPECT_NE(error_of(options).find("reversed_share"), std::string::npos);
  options = small_scan(folder.path());
  options.masks = {"mask.nii.gz"};
  EXPECT_NE(error_of(options).find("--mask"), std::string::npos);
  options.volumes = {(folder.path() / "missing.nii.gz").string()};
  EXPECT_NE(error_of(options).find("missing.nii.gz"), std::string::npos);
  EXPECT_EQ(run(run_svort_simulate, {"svort_simulate", "--output", "x"}), 2);
  EXPECT_EQ(
      run(run_svort_simulate, {"svort_simulate", "--phantom", "--output", folder.path().string(), "--motion", "wild"}),
      2);
  EXPECT_EQ(run(run_svort_simulate, {"svort_simulate", "--help"}), 0);
}

}  // namespace
}  // namespace svort_ros
