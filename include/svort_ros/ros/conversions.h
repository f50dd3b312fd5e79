#pragma once

#include <geometry_msgs/Pose.h>
#include <geometry_msgs/Transform.h>
#include <ros/time.h>
#include <sensor_msgs/PointCloud2.h>
#include <std_msgs/Header.h>
#include <visualization_msgs/Marker.h>
#include <visualization_msgs/MarkerArray.h>

#include <cstdint>
#include <string>

#include "svort_ros/SequenceEstimate.h"
#include "svort_ros/Slice.h"
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
/// @throws std::invalid_argument if a number is not finite or the quaternion is not of unit length (1e-3)
svort::Pose from_msg(const geometry_msgs::Pose& pose_m);

/// Exact: nanoseconds both ways. @throws std::invalid_argument outside of what ros::Time holds (1970 to 2106)
ros::Time to_ros_time(std::int64_t stamp_ns);

/// Result of reading a Slice message: a slice, or the status and reason why it is none.
struct SliceFromMessage {
  svort::Slice slice;  ///< on failure, `info` still holds scan id, stack, index and stamp
  bool ok = false;
  svort::ArrivalStatus status = svort::ArrivalStatus::bad_image;
  std::string reason;
};
/// Reads any encoding that Slice.msg names, in either byte order, without loss (64FC1 is rounded to float32).
/// Whether the content makes sense (NaN, zero spacing, empty mask) is for svort::SliceSequence to say.
SliceFromMessage from_msg(const Slice& message);

/// The answer to a message that holds no slice (`ok` is false).
svort::Arrival rejection(const SliceFromMessage& decoded);

/// `frame_id` is the scanner frame. Pixels are sent as 32FC1, which is exact.
Slice to_msg(const svort::Slice& slice, const std::string& frame_id);

/// The message's name for a status, SliceStatus::ACCEPTED and so on.
std::uint8_t to_status_code(svort::ArrivalStatus status);

SequenceEstimate to_msg(const svort::Estimate& estimate, const std::string& scanner_frame,
                        const std::string& brain_frame);

enum class VolumeEncoding { exact, compact };
/// @param estimate says scan, revision and the stamp of the newest slice
/// @throws std::invalid_argument if the voxels are not cubes, or `compact` and a value is not finite
Volume to_msg(const svort::Volume& volume, VolumeEncoding encoding, const svort::Estimate& estimate,
              const std::string& brain_frame);
/// @throws std::invalid_argument if length and size do not fit, or the encoding is unknown
svort::Volume from_msg(const Volume& message);

/// The intensity that thresholds refer to: 0.99 quantile of the values above a thousandth of the largest, so that it
/// does not depend on how much air the grid holds, nor on the faint rim around what the slices cover. 0 if no value is
/// positive.
double reference_intensity(const svort::Volume& volume);

/// Block means over factor^3 voxels; what does not fill a block at the upper ends is left out.
/// @throws std::invalid_argument if factor < 1
svort::Volume coarsen(const svort::Volume& volume, int factor);

/// One point (x, y, z in m, intensity) for every voxel above `threshold` (fraction of the reference intensity).
sensor_msgs::PointCloud2 to_cloud(const svort::Volume& volume, double threshold, const std_msgs::Header& header);

/// Isosurface at `threshold` (fraction of the reference intensity) as a triangle list; without any voxel above it, a
/// marker that deletes the last one.
visualization_msgs::Marker to_surface(const svort::Volume& volume, double threshold, const std_msgs::Header& header);

/// What is drawn inside a slice's outline.
struct SliceImage {
  const svort::PreparedSlice* slice = nullptr;  ///< null: outline and axes only
  double intensity_scale = 1.;                  ///< this intensity is drawn white
};

/// A slice in the brain frame: outline of its field of view, axes (x red, y green, z blue) and, in grey, the pixels of
/// the brain.
visualization_msgs::MarkerArray to_slice_markers(const svort::SliceEstimate& slice, const SliceImage& image,
                                                 const std_msgs::Header& header);

/// tf name of a slice: slice_<stack>_<index>.
std::string slice_frame(const svort::SliceInfo& info);

}  // namespace svort_ros
