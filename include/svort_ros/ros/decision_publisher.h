#pragma once

#include <nav_msgs/Path.h>
#include <ros/node_handle.h>
#include <ros/publisher.h>
#include <sensor_msgs/Image.h>
#include <sensor_msgs/PointCloud2.h>
#include <visualization_msgs/MarkerArray.h>

#include <cstdint>
#include <functional>
#include <map>
#include <string>

#include "svort_ros/Coverage.h"
#include "svort_ros/HeadMotion.h"
#include "svort_ros/ReacquisitionPlan.h"
#include "svort_ros/SequenceQuality.h"
#include "svort_ros/decision/decision_engine.h"
#include "svort_ros/live/live_pipeline.h"
#include "svort_ros/ros/parameters.h"

namespace svort_ros {

// Messages of decisions; the core's millimetres become metres here, by conversions.h.

HeadMotion to_msg(const svort::MotionReport& motion, const svort::Estimate& estimate, const std::string& scanner_frame);
SequenceQuality to_msg(const std::vector<svort::SliceQuality>& slices, double accept, const svort::Estimate& estimate,
                       const std::string& brain_frame);
Coverage to_msg(const svort::CoverageMap& coverage, const svort::Completion& completion,
                const svort::Estimate& estimate, const std::string& brain_frame);
ReacquisitionPlan to_msg(const svort::ReacquisitionPlanner& planner, bool dry_run, const svort::Estimate& estimate,
                         const std::string& scanner_frame);

/// The head's poses in the scanner, outliers left out.
nav_msgs::Path to_path(const svort::MotionReport& motion, const std::string& scanner_frame);
/// Where the brain's centre has gone: a chain of arrows, and one from the reference to the present.
visualization_msgs::MarkerArray to_motion_markers(const svort::MotionReport& motion, const std::string& scanner_frame);
/// Outline of every slice's brain, red (spoilt) to green.
visualization_msgs::MarkerArray to_quality_markers(const svort::Estimate& estimate,
                                                   const svort::QualityMonitor& quality,
                                                   const std::string& brain_frame);
/// Every place of the brain, intensity its score.
sensor_msgs::PointCloud2 to_coverage_cloud(const svort::CoverageMap& coverage, const std_msgs::Header& header);
/// Outlines of the planned slices with their ranks.
visualization_msgs::MarkerArray to_plan_markers(const std::vector<svort::ReacquisitionRequest>& waiting,
                                                const svort::CoverageMap& coverage, double head_radius_mm,
                                                const std_msgs::Header& header);
/// The live plot of head motion.
sensor_msgs::Image to_motion_plot(const svort::MotionReport& motion, const std_msgs::Header& header);

/// Publishes what was decided. What rviz shows is made only while somebody subscribes, and once for everybody who comes
/// later. One thread calls all members.
class DecisionPublisher {
 public:
  /// @param on_connect called from a ROS thread when somebody subscribes to a picture: publish_pictures() is due
  DecisionPublisher(ros::NodeHandle nh, const NodeOptions& options, const std::function<void()>& on_connect);

  /// After an update of the engine.
  void publish(const svort::DecisionEngine& engine, const svort::LivePipeline& pipeline, std::uint64_t revision_offset);
  /// What rviz shows, again.
  void publish_pictures(const svort::DecisionEngine& engine, const svort::LivePipeline& pipeline);
  /// After a reset or at a new scan: nothing is known and nothing is wanted.
  void clear(const svort::LivePipeline& pipeline, std::uint64_t revision_offset);

 private:
  NodeOptions options_;
  ros::Publisher motion_, quality_, coverage_, plan_;
  ros::Publisher coverage_volume_, path_, motion_markers_, quality_markers_, coverage_cloud_, plan_markers_, plot_;
};

}  // namespace svort_ros
