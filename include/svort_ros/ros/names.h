#pragma once

namespace svort_ros {

// Names of topics and services; all relative, so that they can be remapped. "On demand": made only while somebody
// subscribes, and sent to late subscribers from the present state.

constexpr char kSliceTopic[] = "slices";                  ///< in: svort_ros/Slice
constexpr char kSliceStatusTopic[] = "slice_status";      ///< out: svort_ros/SliceStatus, one per arriving slice
constexpr char kEstimateTopic[] = "estimate";             ///< out, latched: svort_ros/SequenceEstimate
constexpr char kVolumeTopic[] = "volume";                 ///< out, latched: svort_ros/Volume, exact
constexpr char kVolumeCompactTopic[] = "volume_compact";  ///< out, on demand: svort_ros/Volume, 16 bit, cropped
constexpr char kVolumeCloudTopic[] = "volume_cloud";      ///< out, on demand: sensor_msgs/PointCloud2
constexpr char kSurfaceTopic[] = "brain_surface";         ///< out, on demand: visualization_msgs/Marker
constexpr char kCurrentSliceTopic[] = "current_slice";    ///< out, on demand: visualization_msgs/MarkerArray
constexpr char kHeadPoseTopic[] = "head_pose";            ///< out, latched: geometry_msgs/PoseStamped, scanner frame

constexpr char kResetService[] = "reset";        ///< std_srvs/Trigger, private
constexpr char kSaveService[] = "save";          ///< std_srvs/Trigger, private
constexpr char kFinaliseService[] = "finalise";  ///< std_srvs/Trigger, private

}  // namespace svort_ros
