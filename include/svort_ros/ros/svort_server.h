#pragma once

#include <ros/node_handle.h>

#include <memory>

namespace svort_ros {

/// The live server, shared by node and nodelet: Slice messages in, everything that docs/ros_api.md lists out.
///
/// ROS callbacks only put what arrives into an inbox; one worker thread owns the pipeline and does all work, so
/// nothing is locked while it computes. Slices are never dropped: while a volume is computed they wait, and the next
/// volume contains all of them.
class SvortServer {
 public:
  /// Reads the parameters and starts to listen.
  /// @throws std::runtime_error, std::invalid_argument naming the parameter that is unknown, of the wrong type or out
  ///         of range
  SvortServer(const ros::NodeHandle& nh, const ros::NodeHandle& private_nh);

  /// Answers what has arrived, writes a scan that was not saved (if there is an output directory), and stops; no
  /// callback runs afterwards.
  ~SvortServer();

  SvortServer(const SvortServer&) = delete;
  SvortServer& operator=(const SvortServer&) = delete;

 private:
  struct CallbackThreads;
  class Worker;
  class Callbacks;
  std::unique_ptr<CallbackThreads> threads_;  ///< first: its queues outlive everybody who puts something into them
  std::unique_ptr<Worker> worker_;
  std::unique_ptr<Callbacks> callbacks_;
};

}  // namespace svort_ros
