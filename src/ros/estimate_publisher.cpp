#include "svort_ros/ros/estimate_publisher.h"

#include <geometry_msgs/PoseStamped.h>

#include <algorithm>
#include <boost/make_shared.hpp>
#include <cmath>

#include "svort_ros/ros/conversions.h"
#include "svort_ros/ros/names.h"

namespace svort_ros {
namespace {

bool same_pose(const svort::Pose& a, const svort::Pose& b) { return a.matrix() == b.matrix(); }

/// What a message says about its volume: of the slices the newest alone.
svort::Estimate about_volume(const svort::Estimate& estimate, std::uint64_t revision_offset) {
  svort::Estimate about;
  about.scan_id = estimate.scan_id;
  about.revision = estimate.revision + revision_offset;
  about.final = estimate.final;
  if (!estimate.slices.empty()) about.slices = {estimate.slices.back()};
  return about;
}

}  // namespace

EstimatePublisher::EstimatePublisher(ros::NodeHandle nh, const NodeOptions& options,
                                     std::function<void(Product)> on_connect)
    : options_(options),
      estimate_publisher_(nh.advertise<SequenceEstimate>(kEstimateTopic, 10, true)),
      head_pose_publisher_(nh.advertise<geometry_msgs::PoseStamped>(kHeadPoseTopic, 100, true)),
      volume_publisher_(nh.advertise<Volume>(kVolumeTopic, 2, true)),
      final_estimate_publisher_(nh.advertise<SequenceEstimate>(kFinalEstimateTopic, 10, true)),
      final_volume_publisher_(nh.advertise<Volume>(kFinalVolumeTopic, 2, true)) {
  const auto advertise = [&](auto message, Product product, const char* topic) {
    // Not latched by ROS, which would send a state from when somebody last subscribed before the present one.
    const auto connected = [on_connect, product](const ros::SingleSubscriberPublisher&) { on_connect(product); };
    products_[product] = nh.advertise<decltype(message)>(topic, 2, ros::SubscriberStatusCallback(connected));
  };
  advertise(Volume(), Product::volume_compact, kVolumeCompactTopic);
  advertise(sensor_msgs::PointCloud2(), Product::cloud, kVolumeCloudTopic);
  advertise(visualization_msgs::Marker(), Product::surface, kSurfaceTopic);
  advertise(visualization_msgs::MarkerArray(), Product::current_slice, kCurrentSliceTopic);
}

geometry_msgs::TransformStamped EstimatePublisher::stamped(const std::string& parent, const std::string& child,
                                                           const svort::Pose& T_parent_child,
                                                           std::int64_t stamp_ns) const {
  geometry_msgs::TransformStamped transform;
  transform.header.stamp = to_ros_time(stamp_ns);
  transform.header.frame_id = parent;
  transform.child_frame_id = child;
  transform.transform = to_transform_msg(T_parent_child);
  return transform;
}

void EstimatePublisher::publish_transforms(const svort::LivePipeline& pipeline) {
  const svort::Estimate& estimate = pipeline.estimate();
  const svort::SliceEstimate* newest = pipeline.newest();
  if (!newest || estimate.slices.empty()) return;
  const svort::SliceEstimate& latest = estimate.slices.back();  // by acquisition time; newest may have come late
  std::vector<geometry_msgs::TransformStamped> transforms;

  const auto send_head = [&](const svort::Pose& pose, std::int64_t stamp_ns) {
    if (!sent_head_stamps_.insert(stamp_ns).second) return false;  // tf ignores a repeated stamp
    transforms.push_back(stamped(options_.scanner_frame, options_.brain_frame, pose, stamp_ns));
    if (stamp_ns >= latest_head_.stamp_ns) latest_head_ = {pose, stamp_ns};
    return true;
  };
  send_head(newest->T_scanner_brain, newest->info.stamp_ns);
  // If the present head pose has changed without a newer slice, a slightly later stamp is the only way to say so.
  if (!same_pose(latest_head_.pose, latest.T_scanner_brain)) {
    std::int64_t stamp = latest_head_.stamp_ns + 1;
    while (!send_head(latest.T_scanner_brain, stamp)) ++stamp;
  }

  for (const svort::SliceEstimate& slice : estimate.slices) {
    const auto key = std::make_pair(slice.info.stack, slice.info.index);
    const auto sent = sent_slices_.find(key);
    std::int64_t stamp = slice.info.stamp_ns;
    if (sent != sent_slices_.end()) {
      if (same_pose(sent->second.pose, slice.T_brain_slice)) continue;
      stamp = std::max(latest.info.stamp_ns, sent->second.stamp_ns + 1);
    }
    transforms.push_back(stamped(options_.brain_frame, slice_frame(slice.info), slice.T_brain_slice, stamp));
    sent_slices_[key] = {slice.T_brain_slice, stamp};
  }
  if (!transforms.empty()) broadcaster_.sendTransform(transforms);
}

void EstimatePublisher::publish_estimate(const svort::LivePipeline& pipeline, std::uint64_t revision_offset) {
  SequenceEstimate message = to_msg(pipeline.estimate(), options_.scanner_frame, options_.brain_frame);
  message.revision += revision_offset;
  estimate_publisher_.publish(message);
  if (pipeline.estimate().slices.empty()) return;
  geometry_msgs::PoseStamped head;
  head.header.stamp = message.header.stamp;
  head.header.frame_id = options_.scanner_frame;
  head.pose = message.slices.back().scanner_from_brain;
  head_pose_publisher_.publish(head);
  publish(Product::current_slice, pipeline);
}

void EstimatePublisher::publish_volume(const svort::LivePipeline& pipeline, std::uint64_t revision_offset) {
  if (pipeline.volume().empty()) return;
  volume_estimate_ = about_volume(pipeline.estimate(), revision_offset);
  // Shared, so that nodelets in the same process get it without a copy.
  volume_publisher_.publish(boost::make_shared<const Volume>(
      to_msg(pipeline.volume(), VolumeEncoding::exact, volume_estimate_, options_.brain_frame)));
  for (const Product product : {Product::volume_compact, Product::cloud, Product::surface}) publish(product, pipeline);
}

void EstimatePublisher::publish_final(const svort::LivePipeline& pipeline, std::uint64_t revision_offset) {
  SequenceEstimate message = to_msg(pipeline.estimate(), options_.scanner_frame, options_.brain_frame);
  message.revision += revision_offset;
  final_estimate_publisher_.publish(message);
  final_volume_publisher_.publish(boost::make_shared<const Volume>(
      to_msg(pipeline.volume(), VolumeEncoding::exact, about_volume(pipeline.estimate(), revision_offset),
             options_.brain_frame)));
}

std_msgs::Header EstimatePublisher::volume_header() const {
  std_msgs::Header header;
  header.stamp = to_ros_time(volume_estimate_.slices.empty() ? 0 : volume_estimate_.slices.back().info.stamp_ns);
  header.frame_id = options_.brain_frame;
  return header;
}

void EstimatePublisher::publish(Product product, const svort::LivePipeline& pipeline) {
  const ros::Publisher& publisher = products_.at(product);
  if (publisher.getNumSubscribers() == 0) return;
  const svort::Volume& volume = pipeline.volume();
  if (product != Product::current_slice && volume.empty()) return;
  switch (product) {
    case Product::volume_compact:
      publisher.publish(to_msg(volume, VolumeEncoding::compact, volume_estimate_, options_.brain_frame));
      break;
    case Product::cloud:
      publisher.publish(to_cloud(volume, options_.cloud_threshold, volume_header()));
      break;
    case Product::surface: {
      const double factor = std::round(options_.surface_resolution_mm / volume.grid.spacing.x());
      const int limit = std::max(1, volume.grid.size.minCoeff() / 4);
      const svort::Volume coarse = coarsen(volume, static_cast<int>(std::clamp(factor, 1., double(limit))));
      publisher.publish(to_surface(coarse, options_.surface_threshold, volume_header()));
      break;
    }
    case Product::current_slice: {
      const svort::SliceEstimate* newest = pipeline.newest();
      if (!newest) return;
      std_msgs::Header header;
      header.stamp = to_ros_time(newest->info.stamp_ns);
      header.frame_id = options_.brain_frame;
      const SliceImage image{pipeline.sequence().newest_arrival().get(), pipeline.sequence().intensity_scale()};
      publisher.publish(to_slice_markers(*newest, image, header));
      break;
    }
  }
}

void EstimatePublisher::begin_scan() {
  sent_slices_.clear();
  sent_head_stamps_.clear();
  latest_head_ = Sent();
  volume_estimate_ = svort::Estimate();
}

void EstimatePublisher::clear(const svort::LivePipeline& pipeline, std::uint64_t revision_offset) {
  begin_scan();
  publish_estimate(pipeline, revision_offset);
  volume_publisher_.publish(to_msg(svort::Volume(), VolumeEncoding::exact, volume_estimate_, options_.brain_frame));
  products_.at(Product::volume_compact)
      .publish(to_msg(svort::Volume(), VolumeEncoding::compact, volume_estimate_, options_.brain_frame));
  products_.at(Product::cloud).publish(to_cloud(svort::Volume(), options_.cloud_threshold, volume_header()));
  visualization_msgs::Marker remove;
  remove.header.frame_id = options_.brain_frame;
  remove.action = visualization_msgs::Marker::DELETEALL;
  products_.at(Product::surface).publish(remove);
  visualization_msgs::MarkerArray remove_all;
  remove_all.markers.push_back(remove);
  products_.at(Product::current_slice).publish(remove_all);
}

}  // namespace svort_ros
