#pragma once

#include <ros/node_handle.h>
#include <ros/publisher.h>
#include <ros/subscriber.h>

#include <chrono>
#include <optional>
#include <string>
#include <vector>

#include "svort_ros/SliceStatus.h"
#include "svort_ros/ros/stack_input.h"

namespace svort_ros {

/// Parameters of stack_player_node, directly below its private namespace; `start_s` defaults to the present there.
struct StackPlayerOptions {
  StackInput input;
  double realtime = 1.;    ///< 1 is the scanner's pace, 2 twice as fast; 0: the next slice when the last is answered
  double timeout_s = 30.;  ///< longest wait for subscribers and for an answer; then a warning, and on
  bool publish_clock = false;    ///< publish /clock following the slices, for /use_sim_time
  bool exit_when_done = true;    ///< else the node stays, so that latched messages and rviz do
  std::string finalise_service;  ///< std_srvs/Trigger to call after the last slice was answered; empty: none

  template <class Visitor>
  void visit(Visitor&& v) {
    input.visit(v);
    v("realtime", realtime, "1: the scanner's pace, 2: twice as fast, 0: the next slice when the last is answered");
    v("timeout_s", timeout_s, "longest wait for subscribers and for an answer, s");
    v("publish_clock", publish_clock, "publish /clock following the slices, for /use_sim_time");
    v("exit_when_done", exit_when_done, "end after the last slice");
    v("finalise_service", finalise_service, "service to call after the last slice was answered; empty: none");
  }
};

/// Publishes NIfTI stacks slice by slice, as a scanner would.
class StackPlayer {
 public:
  /// Reads parameters and files.
  /// @throws std::runtime_error, std::invalid_argument naming the parameter or file
  StackPlayer(const ros::NodeHandle& nh, const ros::NodeHandle& private_nh);

  /// Plays everything; handles callbacks itself. @return the exit code: 0, or 1 if a slice stayed without an answer
  /// that was waited for, or the service failed
  int run();

 private:
  using Clock = std::chrono::steady_clock;  // /clock may be this node's own

  void receive_status(const SliceStatus& status);
  bool wait_for_subscribers();
  void wait_until(Clock::time_point due, const ros::Time& clock_start, Clock::time_point start);
  bool wait_for_answers(std::size_t count);
  bool finalise();
  void publish_clock(const ros::Time& time);

  ros::NodeHandle nh_;
  StackPlayerOptions options_;
  std::vector<Slice> slices_;
  ros::Publisher publisher_;
  ros::Publisher clock_publisher_;
  ros::Subscriber status_subscriber_;
  std::size_t sent_ = 0;
  std::size_t answered_ = 0;  ///< of the slices sent
};

/// The program: 0 if all went well, 1 if something did not answer, 2 on bad parameters or files.
int run_stack_player(int argc, char** argv);

}  // namespace svort_ros
