#include "svort_ros/ros/stack_player.h"

#include <ros/ros.h>
#include <rosgraph_msgs/Clock.h>
#include <std_srvs/Trigger.h>

#include <algorithm>
#include <cmath>
#include <cstdio>
#include <stdexcept>
#include <thread>

#include "svort_ros/ros/names.h"
#include "svort_ros/ros/parameters.h"

namespace svort_ros {
namespace {

using Seconds = std::chrono::duration<double>;

constexpr std::chrono::milliseconds kTick{2};        // how often callbacks are looked after while waiting
constexpr std::chrono::milliseconds kClockTick{20};  // /clock between two slices
constexpr std::chrono::milliseconds kSettle{200};    // a connection that is there may still be shaking hands
constexpr std::chrono::seconds kWaitForAnswerer{2};

StackPlayerOptions load(const ros::NodeHandle& private_nh) {
  StackPlayerOptions options;
  ParameterReader reader = read_parameters(private_nh);
  if (!reader.has("start_s")) options.input.timing.start_s = ros::WallTime::now().toSec();
  options.visit(reader);
  reader.reject_unknown();
  const std::string ns = private_nh.getNamespace() + "/";
  if (options.input.stacks.empty()) throw std::invalid_argument("parameter " + ns + "stacks is missing or empty");
  if (!(options.realtime >= 0.) || !std::isfinite(options.realtime))
    throw std::invalid_argument("parameter " + ns + "realtime is " + std::to_string(options.realtime) +
                                "; it must be zero or positive");
  if (!(options.timeout_s > 0.))
    throw std::invalid_argument("parameter " + ns + "timeout_s is " + std::to_string(options.timeout_s) +
                                "; it must be positive");
  return options;
}

}  // namespace

StackPlayer::StackPlayer(const ros::NodeHandle& nh, const ros::NodeHandle& private_nh)
    : nh_(nh), options_(load(private_nh)), slices_(read_messages(options_.input)) {
  // A queue as long as the scan: the last slices must not be lost to a slow connection.
  publisher_ = nh_.advertise<Slice>(kSliceTopic, static_cast<std::uint32_t>(slices_.size() + 1));
  status_subscriber_ = nh_.subscribe<SliceStatus>(
      kSliceStatusTopic, 1000, [this](const SliceStatus::ConstPtr& status) { receive_status(*status); });
  if (options_.publish_clock) clock_publisher_ = nh_.advertise<rosgraph_msgs::Clock>("/clock", 10);
}

void StackPlayer::receive_status(const SliceStatus& status) {
  const auto end = slices_.begin() + static_cast<std::ptrdiff_t>(sent_);
  const bool ours = std::any_of(slices_.begin(), end, [&](const Slice& slice) {
    return slice.scan_id == status.scan_id && slice.stack == status.stack && slice.index == status.index &&
           slice.header.stamp == status.header.stamp;
  });
  if (ours) ++answered_;
}

void StackPlayer::publish_clock(const ros::Time& time) {
  if (!options_.publish_clock) return;
  rosgraph_msgs::Clock clock;
  clock.clock = time;
  clock_publisher_.publish(clock);
}

bool StackPlayer::wait_for_subscribers() {
  const auto started = Clock::now();
  std::optional<Clock::time_point> subscribed;
  bool warned = false;
  while (ros::ok()) {
    const auto now = Clock::now();
    if (publisher_.getNumSubscribers() == 0)
      subscribed.reset();
    else if (!subscribed)
      subscribed = now;
    // Whoever answers does so on another connection, which must be there for the first answer. At the scanner's pace
    // nobody needs to answer (a recorder does not), so that wait is short then.
    const bool someone_answers = status_subscriber_.getNumPublishers() > 0;
    const bool answer_is_needed = options_.realtime <= 0.;
    if (subscribed && someone_answers && now - *subscribed > kSettle) return true;
    if (subscribed && !answer_is_needed && now - *subscribed > kWaitForAnswerer) return true;
    if (!warned && now - started > Seconds(options_.timeout_s)) {
      ROS_WARN("nobody has subscribed to %s%s for %.1f s; waiting on", publisher_.getTopic().c_str(),
               subscribed ? " and answers" : "", options_.timeout_s);
      warned = true;
    }
    publish_clock(slices_.front().header.stamp);  // a node with simulated time starts only when there is one
    ros::spinOnce();
    std::this_thread::sleep_for(kClockTick);
  }
  return false;
}

void StackPlayer::wait_until(Clock::time_point due, const ros::Time& clock_start, Clock::time_point start) {
  auto next_clock = Clock::now();
  while (ros::ok() && Clock::now() < due) {
    if (Clock::now() >= next_clock) {
      const Seconds passed = Clock::now() - start;
      publish_clock(clock_start + ros::Duration(passed.count() * options_.realtime));
      next_clock += kClockTick;
    }
    ros::spinOnce();
    std::this_thread::sleep_for(std::min<Clock::duration>(kTick, std::max(Clock::duration(0), due - Clock::now())));
  }
}

bool StackPlayer::wait_for_answers(std::size_t count) {
  const auto started = Clock::now();
  while (ros::ok() && answered_ < count) {
    if (Clock::now() - started > Seconds(options_.timeout_s)) {
      ROS_WARN("no answer on %s to %zu of %zu slices for %.1f s", status_subscriber_.getTopic().c_str(),
               count - answered_, count, options_.timeout_s);
      answered_ = count;  // do not wait for the same slice again
      return false;
    }
    ros::spinOnce();
    std::this_thread::sleep_for(kTick);
  }
  return ros::ok();
}

bool StackPlayer::finalise() {
  const std::string name = nh_.resolveName(options_.finalise_service);
  if (!ros::service::waitForService(name, ros::Duration(options_.timeout_s))) {
    ROS_ERROR("service %s is not there", name.c_str());
    return false;
  }
  std_srvs::Trigger call;
  const bool answered = ros::service::call(name, call);
  const bool good = answered && call.response.success;
  const std::string text = answered ? call.response.message : "no answer";
  if (good)
    ROS_INFO("%s: %s", name.c_str(), text.c_str());
  else
    ROS_ERROR("%s: %s", name.c_str(), text.c_str());
  return good;
}

int StackPlayer::run() {
  if (!wait_for_subscribers()) return 0;  // told to end
  ROS_INFO("playing %zu slices on %s", slices_.size(), publisher_.getTopic().c_str());
  const auto start = Clock::now();
  const ros::Time clock_start = slices_.front().header.stamp;
  bool good = true;
  for (const Slice& slice : slices_) {
    if (options_.realtime > 0.) {
      const Seconds offset((slice.header.stamp - clock_start).toSec() / options_.realtime);
      wait_until(start + std::chrono::duration_cast<Clock::duration>(offset), clock_start, start);
    }
    if (!ros::ok()) return 0;
    publish_clock(slice.header.stamp);
    ++sent_;
    publisher_.publish(slice);
    if (options_.realtime <= 0.) good = wait_for_answers(sent_) && good;
  }
  // Leaving at once would cut the connection before the last slices are through.
  if (status_subscriber_.getNumPublishers() > 0) good = wait_for_answers(sent_) && good;
  ROS_INFO("played %zu slices in %.1f s", sent_, Seconds(Clock::now() - start).count());
  if (ros::ok() && !options_.finalise_service.empty()) good = finalise() && good;
  if (!options_.exit_when_done) ros::spin();
  return good ? 0 : 1;
}

int run_stack_player(int argc, char** argv) {
  setvbuf(stdout, nullptr, _IOLBF, 0);  // a progress line must be seen at once in a pipe, too
  ros::init(argc, argv, "stack_player");
  try {
    return StackPlayer(ros::NodeHandle(), ros::NodeHandle("~")).run();
  } catch (const std::exception& error) {
    ROS_FATAL("%s", error.what());
    return 2;
  }
}

}  // namespace svort_ros
