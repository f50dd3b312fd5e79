#pragma once

#include <diagnostic_updater/diagnostic_updater.h>
#include <ros/node_handle.h>
#include <ros/timer.h>

#include <cstddef>
#include <deque>
#include <functional>
#include <limits>
#include <map>
#include <mutex>
#include <string>
#include <vector>

#include "svort_ros/ros/arrivals.h"
#include "svort_ros/ros/parameters.h"

namespace svort_ros {

/// Counts what the node does and reports it on /diagnostics once per second of ROS time (~diagnostic_period). All
/// members may be called from any thread; the worker is held up for no longer than a few numbers take to copy.
class NodeHealth {
 public:
  struct Estimator {
    std::string method;
    std::string device;
    int threads = 0;
    std::vector<std::string> warnings;  ///< see svort::EstimatorNotes
  };

  /// @param inbox_length asked for at every report
  NodeHealth(const ros::NodeHandle& nh, const ros::NodeHandle& private_nh, const NodeOptions& options,
             std::function<std::size_t()> inbox_length);

  void set_estimator(Estimator estimator);
  void slice_answered(svort::ArrivalStatus status, double latency_ms);
  void volume_published(double latency_ms);  ///< once for every slice that is new in the volume
  void set_agreement(double agreement);      ///< see svort::Estimate
  void failed(const std::string& what);      ///< an exception that is this program's own fault
  void write_failed(const std::string& what, std::size_t scans_kept_in_memory);
  void write_succeeded(std::size_t scans_kept_in_memory);
  void set_ended_scans(std::size_t being_finalised);

 private:
  void report_slices(diagnostic_updater::DiagnosticStatusWrapper& status);
  void report_estimator(diagnostic_updater::DiagnosticStatusWrapper& status);
  void report_results(diagnostic_updater::DiagnosticStatusWrapper& status);

  NodeOptions options_;
  std::function<std::size_t()> inbox_length_;

  mutable std::mutex mutex_;  ///< guards what follows, down to the updater
  Estimator estimator_;
  std::map<svort::ArrivalStatus, std::size_t> counts_;
  std::deque<Clock::time_point> recent_arrivals_;
  std::deque<double> pose_latencies_ms_;
  std::deque<double> volume_latencies_ms_;
  double agreement_ = std::numeric_limits<double>::quiet_NaN();
  std::size_t failures_ = 0;
  std::string last_failure_;
  std::size_t writes_ = 0;
  std::size_t failed_writes_ = 0;
  bool last_write_failed_ = false;
  std::string last_write_failure_;
  std::size_t scans_kept_ = 0;
  std::size_t being_finalised_ = 0;

  diagnostic_updater::Updater updater_;
  ros::Timer timer_;
};

}  // namespace svort_ros
