#pragma once

#include <ros/node_handle.h>
#include <ros/publisher.h>
#include <tf2_ros/transform_broadcaster.h>

#include <cstdint>
#include <functional>
#include <map>
#include <set>
#include <string>
#include <vector>

#include "svort_ros/live/live_pipeline.h"
#include "svort_ros/ros/parameters.h"

namespace svort_ros {

/// Everything that leaves the node but the answers to slices: tf, estimate, volume and what rviz shows.
///
/// Point cloud, surface, compact volume and slice markers cost more than the estimate itself, so they are made only
/// while somebody subscribes, and once for everybody who comes later. One thread calls all members.
class EstimatePublisher {
 public:
  enum class Product { volume_compact, cloud, surface, current_slice };

  /// @param on_connect called from a ROS thread when somebody subscribes to a product: publish(product) is due
  EstimatePublisher(ros::NodeHandle nh, const NodeOptions& options, std::function<void(Product)> on_connect);

  /// tf of the newest slice, of every slice whose pose has changed since it was sent, and of the head.
  void publish_transforms(const svort::LivePipeline& pipeline);
  /// @param revision_offset added to the revision that the message names
  void publish_estimate(const svort::LivePipeline& pipeline, std::uint64_t revision_offset);
  /// Takes note of the pipeline's new volume and publishes it and its products.
  void publish_volume(const svort::LivePipeline& pipeline, std::uint64_t revision_offset);
  /// Poses and volume of a scan that is final, which need not be the scan in hand.
  void publish_final(const svort::LivePipeline& pipeline, std::uint64_t revision_offset);
  /// One product again, from the last state.
  void publish(Product product, const svort::LivePipeline& pipeline);

  /// Another scan begins: its frames are new.
  void begin_scan();
  /// After a reset: tells everybody that there is no scan.
  void clear(const svort::LivePipeline& pipeline, std::uint64_t revision_offset);

 private:
  std_msgs::Header volume_header() const;
  geometry_msgs::TransformStamped stamped(const std::string& parent, const std::string& child,
                                          const svort::Pose& T_parent_child, std::int64_t stamp_ns) const;

  NodeOptions options_;
  tf2_ros::TransformBroadcaster broadcaster_;
  ros::Publisher estimate_publisher_;
  ros::Publisher head_pose_publisher_;
  ros::Publisher volume_publisher_;
  ros::Publisher final_estimate_publisher_;
  ros::Publisher final_volume_publisher_;
  std::map<Product, ros::Publisher> products_;

  struct Sent {
    svort::Pose pose = svort::Pose::Identity();
    std::int64_t stamp_ns = -1;
  };
  std::map<std::pair<int, int>, Sent> sent_slices_;  ///< by stack and index
  std::set<std::int64_t> sent_head_stamps_;
  Sent latest_head_;                 ///< the one with the latest stamp
  svort::Estimate volume_estimate_;  ///< what the last volume was made from; of its slices only the newest
};

}  // namespace svort_ros
