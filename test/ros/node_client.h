#pragma once

// What the tests of running nodes share: a scanner and an audience in one.

#include <gtest/gtest.h>
#include <ros/ros.h>
#include <std_srvs/Trigger.h>
#include <tf2_ros/buffer.h>
#include <tf2_ros/transform_listener.h>

#include <chrono>
#include <condition_variable>
#include <mutex>
#include <string>
#include <thread>
#include <vector>

#include "ros/synthetic_scan.h"
#include "svort_ros/SequenceEstimate.h"
#include "svort_ros/Slice.h"
#include "svort_ros/SliceStatus.h"
#include "svort_ros/ros/conversions.h"
#include "svort_ros/ros/names.h"

namespace svort_test {

constexpr double kPatience = 30.;  // s; generous, because test machines are slow and shared

inline std::vector<svort_ros::Slice> synthetic_messages(const std::string& scan_id) {
  SyntheticScanOptions options;
  options.scan_id = scan_id;
  std::vector<svort_ros::Slice> messages;
  for (const svort::Slice& slice : synthetic_scan(options)) messages.push_back(svort_ros::to_msg(slice, "scanner"));
  return messages;
}

/// Waits until the condition holds. @return false after `patience_s`
template <class Condition>
bool eventually(const Condition& condition, double patience_s = kPatience) {
  const auto end = std::chrono::steady_clock::now() + std::chrono::duration<double>(patience_s);
  while (!condition()) {
    if (std::chrono::steady_clock::now() > end || !ros::ok()) return false;
    std::this_thread::sleep_for(std::chrono::milliseconds(5));
  }
  return true;
}

/// Collects the messages of one topic; callbacks come from an AsyncSpinner.
template <class Message>
class Collector {
 public:
  explicit Collector(const std::string& topic, std::uint32_t queue = 1000) {
    subscriber_ = nh_.subscribe<Message>(topic, queue, [this](const typename Message::ConstPtr& message) {
      const std::lock_guard<std::mutex> lock(mutex_);
      messages_.push_back(*message);
    });
  }
  std::vector<Message> all() const {
    const std::lock_guard<std::mutex> lock(mutex_);
    return messages_;
  }
  std::size_t count() const {
    const std::lock_guard<std::mutex> lock(mutex_);
    return messages_.size();
  }
  void clear() {
    const std::lock_guard<std::mutex> lock(mutex_);
    messages_.clear();
  }
  bool connected() const { return subscriber_.getNumPublishers() > 0; }

 private:
  ros::NodeHandle nh_;
  mutable std::mutex mutex_;
  std::vector<Message> messages_;
  ros::Subscriber subscriber_;  // last: its callback uses all of the above
};

/// Sends slices to the node `svort` and receives its answers.
class NodeClient {
 public:
  explicit NodeClient(const std::string& node = "svort")
      : node_(node),
        publisher_(nh_.advertise<svort_ros::Slice>(svort_ros::kSliceTopic, 1000)),
        status_(svort_ros::kSliceStatusTopic),
        estimate_(svort_ros::kEstimateTopic),
        tf_buffer_(ros::Duration(1000.)),
        tf_listener_(tf_buffer_) {}

  bool connect() {
    const bool connected = eventually([this] { return publisher_.getNumSubscribers() > 0 && status_.connected(); }) &&
                           ros::service::waitForService(node_ + "/save", ros::Duration(kPatience));
    std::this_thread::sleep_for(std::chrono::milliseconds(200));  // the other side may still be shaking hands
    return connected;
  }

  std_srvs::Trigger::Response call(const std::string& service) const {
    std_srvs::Trigger call;
    if (!ros::service::call(node_ + "/" + service, call)) ADD_FAILURE() << service << " did not answer";
    return call.response;
  }

  void send(const svort_ros::Slice& slice) { publisher_.publish(slice); }

  /// Sends, and waits for as many answers. @return the answers, fewer after a timeout
  std::vector<svort_ros::SliceStatus> send_and_wait(const std::vector<svort_ros::Slice>& slices) {
    status_.clear();
    for (const svort_ros::Slice& slice : slices) publisher_.publish(slice);
    eventually([&] { return status_.count() >= slices.size(); });
    return status_.all();
  }
  svort_ros::SliceStatus send_and_wait(const svort_ros::Slice& slice) {
    const auto answers = send_and_wait(std::vector<svort_ros::Slice>{slice});
    EXPECT_EQ(answers.size(), 1U);
    return answers.empty() ? svort_ros::SliceStatus() : answers.front();
  }

  /// tf's answer to where a slice was in the scanner when it was acquired, mm.
  svort::Pose lookup_slice(const svort_ros::Slice& slice) const {
    svort::SliceInfo info;
    info.stack = slice.stack;
    info.index = slice.index;
    geometry_msgs::TransformStamped found;
    EXPECT_TRUE(eventually([&] {
      try {
        found = tf_buffer_.lookupTransform("scanner", svort_ros::slice_frame(info), slice.header.stamp);
        return true;
      } catch (const tf2::TransformException&) {
        return false;
      }
    })) << "no tf for "
        << svort_ros::slice_frame(info);
    geometry_msgs::Pose pose;
    pose.position.x = found.transform.translation.x;
    pose.position.y = found.transform.translation.y;
    pose.position.z = found.transform.translation.z;
    pose.orientation = found.transform.rotation;
    return svort_ros::from_msg(pose);
  }

  Collector<svort_ros::SliceStatus>& status() { return status_; }
  Collector<svort_ros::SequenceEstimate>& estimate() { return estimate_; }
  tf2_ros::Buffer& tf_buffer() { return tf_buffer_; }

 private:
  std::string node_;
  ros::NodeHandle nh_;
  ros::Publisher publisher_;
  Collector<svort_ros::SliceStatus> status_;
  Collector<svort_ros::SequenceEstimate> estimate_;
  tf2_ros::Buffer tf_buffer_;
  tf2_ros::TransformListener tf_listener_;
};

/// main() of a test of running nodes.
inline int run_node_tests(int argc, char** argv, const char* name) {
  testing::InitGoogleTest(&argc, argv);
  ros::init(argc, argv, name);
  const ros::NodeHandle keep_alive;
  ros::AsyncSpinner spinner(2);
  spinner.start();
  return RUN_ALL_TESTS();
}

}  // namespace svort_test
