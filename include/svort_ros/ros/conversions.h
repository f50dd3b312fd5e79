#pragma once

#include <geometry_msgs/Pose.h>
#include <geometry_msgs/Transform.h>
#include <ros/time.h>
#include <sensor_msgs/PointCloud2.h>
#include <visualization_msgs/Marker.h>
#include <visualization_msgs/MarkerArray.h>

#include <cstdint>
#include <string>

#include "svort_ros/Slice.h"
#include "svort_ros/SequenceEstimate.h"
#include "svort_ros/SliceStatus.h"
#include "svort_ros/Volume.h"
#include "svort_ros/acquisition/slice.h"
#include "svort_ros/geometry/image_grid.h"
#include "svort_ros/live/incremental_estimator.h"
#include "svort_ros/sequence/slice_sequence.h"

namespace svort_ros {

// The only place where metres become millimetres and back.

geometry_msgs::Pose to_pose_msg(const svort::Pose& pose_mm);
geometry_msgs::Transform to_transform_msg(const svort::Pose& pose_mm);
/// @throws std::invalid_argument if the quaternion is not finite or not of unit length (1e-3)
svort::Pose from_msg(const geometry_msgs::Pose& pose_m);

/// Exact: nanoseconds both ways.
ros::Time to_ros_time(std::int64_t stamp_ns);

/// Result of reading a Slice message: a slice, or the status and reason why it is none.
struct SliceFromMessage {
  svort::Slice slice;  ///< on failure, `info` still holds scan id, stack, index and stamp
  bool ok = false;
  svort::ArrivalStatus status = svort::ArrivalStatus::bad_image;
  std::string reason;
};
SliceFromMessage from_msg(const Slice& message);

/// `frame_id` is the scanner frame. Pixels are sent as 32FC1, which is exact.
Slice to_msg(const svort::Slice& slice, const std::string& frame_id);

SequenceEstimate to_msg(const svort::Estimate& estimate, const std::string& scanner_frame,
                        const std::string& brain_frame);

enum class VolumeEncoding { exact, compact };
Volume to_msg(const svort::Volume& volume, VolumeEncoding encoding, const svort::Estimate& estimate,
              const std::string& brain_frame);
/// @throws std::invalid_argument if length and size do not fit, or the encoding is unknown
svort::Volume from_msg(const Volume& message);

/// One point (x, y, z in m, intensity) for every voxel above `threshold` (fraction of the volume's 0.99 quantile).
sensor_msgs::PointCloud2 to_cloud(const svort::Volume& volume, double threshold, const std_msgs::Header& header);

/// Isosurface at `threshold` (fraction of the volume's 0.99 quantile) as a triangle list.
visualization_msgs::Marker to_surface(const svort::Volume& volume, double threshold, const std_msgs::Header& header);

/// Outline of a slice's plane and its axes, in the brain frame.
visualization_msgs::MarkerArray to_slice_markers(const svort::SliceEstimate& slice, const std_msgs::Header& header);

/// tf name of a slice: slice_<stack>_<index>.
std::string slice_frame(const svort::SliceInfo& info);

}  // namespace svort_ros
