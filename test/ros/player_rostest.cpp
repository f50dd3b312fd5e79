// Stacks in files, played through the node, and a bag, played through node and offline replay; player.test starts the
// node.

#include <gtest/gtest.h>
#include <rosgraph_msgs/Clock.h>
#include <sys/wait.h>

#include <chrono>
#include <cstdlib>
#include <filesystem>

#include "ros/node_client.h"
#include "svort_ros/io/tables.h"
#include "svort_ros/ros/bag.h"

namespace svort_ros {
namespace {

namespace fs = std::filesystem;
using svort_test::read_bytes;

/// Runs a command line. @return its exit code
int run(const std::string& command) {
  const int status = std::system(command.c_str());
  return WIFEXITED(status) ? WEXITSTATUS(status) : -1;
}

std::string program(const std::string& name) { return std::string(SVORT_PROGRAM_DIR) + "/" + name; }

class PlayerTest : public testing::Test {
 protected:
  void SetUp() override {
    ASSERT_TRUE(client_.connect());
    ASSERT_TRUE(client_.call(kResetService).success);
    client_.status().clear();
    std::string folder;
    ASSERT_TRUE(ros::param::get("svort/node/output_directory", folder));
    output_ = folder;
    fs::remove_all(output_);
  }
  void TearDown() override { fs::remove_all(output_); }

  /// Writes the phantom's stacks and masks. @return the player's command line
  std::string player_command(int stacks) {
    svort_test::SyntheticScanOptions options;
    options.stacks = stacks;
    options.tilt_rad = 0.45;  // far from any axis
    scan_ = svort_test::synthetic_scan(options);
    std::string images;
    std::string masks;
    for (int stack = 0; stack < stacks; ++stack) {
      const std::string name = std::to_string(stack) + ".nii.gz";
      svort_test::write_stack(folder_.path() / ("stack" + name), scan_, stack, false);
      svort_test::write_stack(folder_.path() / ("mask" + name), scan_, stack, true);
      images += (stack ? "," : "") + (folder_.path() / ("stack" + name)).string();
      masks += (stack ? "," : "") + (folder_.path() / ("mask" + name)).string();
    }
    return program("stack_player_node") + " _stacks:=[" + images + "] _masks:=[" + masks +
           "] _scan_id:=phantom _start_s:=1000 _timeout_s:=30";
  }

  svort_test::NodeClient client_;
  svort_test::TemporaryFolder folder_;
  std::vector<svort::Slice> scan_;
  fs::path output_;
};

TEST_F(PlayerTest, ObliqueStacksKeepTheirGeometry) {
  const std::string command = player_command(3);
  ASSERT_EQ(run(command + " _realtime:=0 _finalise_service:=svort/finalise"), 0);
  ASSERT_TRUE(svort_test::eventually([&] {
    const auto estimates = client_.estimate().all();
    return !estimates.empty() && estimates.back().final && estimates.back().slices.size() == scan_.size();
  }));
  const SequenceEstimate estimate = client_.estimate().all().back();
  ASSERT_EQ(estimate.slices.size(), scan_.size());
  for (std::size_t i = 0; i < scan_.size(); ++i) {
    const SlicePose& pose = estimate.slices[i];
    EXPECT_EQ(pose.stack, scan_[i].info.stack);
    EXPECT_EQ(pose.index, scan_[i].info.index);
    EXPECT_NEAR(pose.stamp.toSec(), 1e-9 * double(scan_[i].info.stamp_ns), 1e-6);
    const svort::Pose T_scanner_slice = from_msg(pose.scanner_from_brain) * from_msg(pose.brain_from_slice);
    // NIfTI holds the affine in float32: 1e-4 mm at some 100 mm.
    EXPECT_LT((T_scanner_slice.matrix() - scan_[i].info.T_scanner_slice.matrix()).norm(), 1e-4) << "slice " << i;
    Slice at;
    at.stack = pose.stack;
    at.index = pose.index;
    at.header.stamp = pose.stamp;
    EXPECT_LT((client_.lookup_slice(at).matrix() - scan_[i].info.T_scanner_slice.matrix()).norm(), 1e-4);
  }
  EXPECT_EQ(client_.status().count(), scan_.size());
}

TEST_F(PlayerTest, KeepsTheScannersPaceAndItsClock) {
  const std::string command = player_command(1);
  svort_test::Collector<rosgraph_msgs::Clock> clock("/clock");
  const auto start = std::chrono::steady_clock::now();
  ASSERT_EQ(run(command + " _realtime:=4 _publish_clock:=true"), 0);
  const std::chrono::duration<double> wall = std::chrono::steady_clock::now() - start;
  // Eight slices, seven pauses of 1.2 s at four times the pace; the rest is starting up.
  EXPECT_GT(wall.count(), 7 * 1.2 / 4);
  EXPECT_LT(wall.count(), 7 * 1.2 / 4 + 15.);
  EXPECT_EQ(client_.status().count(), 8U);
  const auto ticks = clock.all();
  ASSERT_GT(ticks.size(), 20U);  // also between the slices
  for (std::size_t i = 1; i < ticks.size(); ++i) EXPECT_GE(ticks[i].clock, ticks[i - 1].clock);
  EXPECT_NEAR(ticks.back().clock.toSec(), 1000. + 7 * 1.2, 1e-3);
}

TEST_F(PlayerTest, BadParametersEndWithCodeTwo) {
  const std::string player = program("stack_player_node");
  EXPECT_EQ(run(player), 2);                                  // no stacks
  EXPECT_EQ(run(player + " _stacks:=[/no/such.nii.gz]"), 2);  // no file
  EXPECT_EQ(run(player_command(1) + " _interleave:=0"), 2);   // out of range
  EXPECT_EQ(run(player_command(1) + " _intreleave:=2"), 2);   // unknown
  EXPECT_EQ(run(program("svort_node") + " __name:=other _node/threads:=-4"), 2);
}

TEST_F(PlayerTest, NodeAndOfflineReplayGiveTheSameBytes) {
  const fs::path bag = folder_.path() / "scan.bag";
  auto slices = svort_test::synthetic_messages("parity");
  slices.push_back(slices[3]);      // a duplicate,
  std::swap(slices[4], slices[5]);  // slices out of order
  slices[9].image.data.resize(7);   // and a broken one are part of the truth
  write_slices(bag, slices, "slices");
  ASSERT_EQ(run("rosbag play --quiet --immediate --wait-for-subscribers " + bag.string() + " --topics slices"), 0);
  ASSERT_TRUE(svort_test::eventually([&] { return client_.status().count() >= slices.size(); }));
  ASSERT_TRUE(client_.call(kFinaliseService).success);
  ASSERT_TRUE(client_.call(kSaveService).success);

  const fs::path offline = folder_.path() / "offline";
  ASSERT_EQ(run(program("svort_replay") + " --bag " + bag.string() + " --output " + offline.string() + " --config " +
                SVORT_TEST_DIR + "/ros/coarse.yaml"),
            0);
  const fs::path live = output_ / "parity";
  EXPECT_EQ(svort::read_pose_table(live / "poses.csv").size(), 23U);
  EXPECT_EQ(read_bytes(live / "poses.csv"), read_bytes(offline / "poses.csv"));
  EXPECT_EQ(read_bytes(live / "volume.nii.gz"), read_bytes(offline / "volume.nii.gz"));
}

}  // namespace
}  // namespace svort_ros

int main(int argc, char** argv) { return svort_test::run_node_tests(argc, argv, "player_rostest"); }
