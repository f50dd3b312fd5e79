// The same server as a nodelet; nodelet.test has a manager load it from launch/nodelet.launch.

#include <gtest/gtest.h>

#include "ros/node_client.h"

namespace svort_ros {
namespace {

TEST(Nodelet, AnswersSlicesAndServices) {
  svort_test::NodeClient client;
  ASSERT_TRUE(client.connect());
  auto slices = svort_test::synthetic_messages("nodelet");
  slices.resize(5);
  const auto answers = client.send_and_wait(slices);
  ASSERT_EQ(answers.size(), slices.size());
  for (const SliceStatus& status : answers) EXPECT_EQ(int{status.status}, int{SliceStatus::ACCEPTED});
  for (const Slice& slice : slices)
    EXPECT_LT((client.lookup_slice(slice).matrix() - from_msg(slice.nominal_pose).matrix()).norm(), 1e-6);
  EXPECT_TRUE(client.call(kFinaliseService).success);
  const auto answer = client.call(kSaveService);  // no folder was given
  EXPECT_FALSE(answer.success);
  EXPECT_NE(answer.message.find("output_directory"), std::string::npos) << answer.message;
  EXPECT_TRUE(client.call(kResetService).success);
  EXPECT_EQ(int{client.send_and_wait(slices[0]).status}, int{SliceStatus::ACCEPTED});
}

}  // namespace
}  // namespace svort_ros

int main(int argc, char** argv) { return svort_test::run_node_tests(argc, argv, "nodelet_rostest"); }
