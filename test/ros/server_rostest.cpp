// The server within this process: how it starts and how it ends.

#include "svort_ros/ros/svort_server.h"

#include <gtest/gtest.h>

#include <future>

#include "ros/node_client.h"
#include "svort_ros/io/tables.h"

namespace svort_ros {
namespace {

using svort_test::eventually;
using svort_test::synthetic_messages;

/// A namespace of parameters for one server.
class ServerTest : public testing::Test {
 protected:
  void SetUp() override {
    ros::param::set("svort/estimator/volume_resolution_mm", 3.);
    ros::param::set("svort/estimator/volume_size_mm", 96.);
    ros::param::set("svort/node/output_directory", folder_.path().string());
  }
  void TearDown() override { ros::param::del("svort"); }

  static std::unique_ptr<SvortServer> make_server() {
    return std::make_unique<SvortServer>(ros::NodeHandle(), ros::NodeHandle("svort"));
  }
  static std::string error_of_server() {
    try {
      make_server();
    } catch (const std::exception& error) {
      return error.what();
    }
    return "no error";
  }

  svort_test::TemporaryFolder folder_;
};

TEST_F(ServerTest, BadParametersAreNamed) {
  ros::param::set("svort/node/quue_size", 5);
  EXPECT_EQ(error_of_server(), "parameter /svort/node/quue_size is unknown");
  ros::param::del("svort/node/quue_size");
  ros::param::set("svort/sequence/size_px", "128");
  EXPECT_EQ(error_of_server(),
            "parameter /svort/sequence/size_px has a value of the wrong type; it must be an integer");
  ros::param::del("svort/sequence/size_px");
  ros::param::set("svort/node/volume_every", 0);
  EXPECT_NE(error_of_server().find("node.volume_every is 0"), std::string::npos) << error_of_server();
  ros::param::set("svort/node/volume_every", 8);
  ros::param::set("svort/estimator/method", "magic");
  EXPECT_NE(error_of_server().find("estimator.method is 'magic'"), std::string::npos) << error_of_server();
  ros::param::set("svort/estimator/method", "nominal");
  EXPECT_EQ(error_of_server(), "no error");
}

TEST_F(ServerTest, EndsInTheMiddleOfWorkAndAnswersWhoWaits) {
  // More work than is done before the end: large volumes, and services that wait for them.
  ros::param::set("svort/estimator/volume_resolution_mm", 1.);
  ros::param::set("svort/estimator/volume_size_mm", 128.);
  auto server = make_server();
  svort_test::NodeClient client;
  ASSERT_TRUE(client.connect());
  const auto slices = synthetic_messages("ends");
  for (const Slice& slice : slices) client.send(slice);
  ASSERT_TRUE(eventually([&] { return client.status().count() > 0; }));
  std::vector<std::future<bool>> calls;
  for (const char* service : {kFinaliseService, kSaveService, kFinaliseService})
    calls.push_back(std::async(std::launch::async, [service] {
      std_srvs::Trigger call;
      return ros::service::call(std::string("svort/") + service, call);
    }));
  std::this_thread::sleep_for(std::chrono::milliseconds(50));
  auto end = std::async(std::launch::async, [&] { server.reset(); });
  ASSERT_EQ(end.wait_for(std::chrono::seconds(60)), std::future_status::ready) << "the server hangs";
  for (auto& call : calls)
    EXPECT_EQ(call.wait_for(std::chrono::seconds(20)), std::future_status::ready) << "a service was never answered";
}

TEST_F(ServerTest, WritesAScanThatWasNotSavedWhenItEnds) {
  auto server = make_server();
  {
    svort_test::NodeClient client;
    ASSERT_TRUE(client.connect());
    auto slices = synthetic_messages("unsaved");
    slices.resize(4);
    ASSERT_EQ(client.send_and_wait(slices).size(), 4U);
  }
  EXPECT_FALSE(std::filesystem::exists(folder_.path() / "unsaved"));
  server.reset();
  EXPECT_EQ(svort::read_pose_table(folder_.path() / "unsaved" / "poses.csv").size(), 4U);
}

TEST_F(ServerTest, WritesScansThatHaveEndedThoughTheyAreNotFinalYet) {
  // Registered as a whole they take longer than their slices: some wait when the server ends.
  ros::param::set("svort/estimator/final_volume/resolution_mm", 1.);
  auto server = make_server();
  const std::vector<std::string> scans = {"first", "second", "third"};
  {
    svort_test::NodeClient client;
    ASSERT_TRUE(client.connect());
    for (const std::string& scan : scans)
      for (const SliceStatus& status : client.send_and_wait(synthetic_messages(scan)))
        EXPECT_TRUE(status.kept) << status.reason;
  }
  server.reset();
  for (const std::string& scan : scans)
    EXPECT_EQ(svort::read_pose_table(folder_.path() / scan / "poses.csv").size(), 24U) << scan;
}

TEST_F(ServerTest, StartsAndEndsManyTimesWithSlicesComingIn) {
  svort_test::NodeClient client;
  const auto slices = synthetic_messages("again");
  for (std::size_t round = 0; round < 5; ++round) {
    auto server = make_server();
    ASSERT_TRUE(client.connect());
    for (std::size_t i = 0; i < 6; ++i) client.send(slices[i]);
    if (round % 2 == 0) {
      ASSERT_TRUE(eventually([&] { return client.status().count() >= round + 1; }));
    }
  }
}

}  // namespace
}  // namespace svort_ros

int main(int argc, char** argv) { return svort_test::run_node_tests(argc, argv, "server_rostest"); }
