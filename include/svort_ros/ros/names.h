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
constexpr char kFinalEstimateTopic[] = "final_estimate";  ///< out, latched: svort_ros/SequenceEstimate
constexpr char kFinalVolumeTopic[] = "final_volume";      ///< out, latched: svort_ros/Volume, exact

constexpr char kHeadMotionTopic[] = "head_motion";                 ///< out, latched: svort_ros/HeadMotion
constexpr char kSliceQualityTopic[] = "slice_quality";             ///< out, latched: svort_ros/SequenceQuality
constexpr char kCoverageTopic[] = "coverage";                      ///< out, latched: svort_ros/Coverage
constexpr char kReacquisitionTopic[] = "reacquisition";            ///< out, latched: svort_ros/ReacquisitionPlan
constexpr char kCoverageVolumeTopic[] = "coverage_volume";         ///< out, on demand: svort_ros/Volume
constexpr char kCoverageCloudTopic[] = "coverage_cloud";           ///< out, on demand: sensor_msgs/PointCloud2
constexpr char kHeadPathTopic[] = "head_path";                     ///< out, on demand: nav_msgs/Path
constexpr char kHeadMotionMarkersTopic[] = "head_motion_markers";  ///< out, on demand: visualization_msgs/MarkerArray
constexpr char kQualityMarkersTopic[] = "slices_by_quality";       ///< out, on demand: visualization_msgs/MarkerArray
constexpr char kPlannedSlicesTopic[] = "planned_slices";           ///< out, on demand: visualization_msgs/MarkerArray
constexpr char kMotionPlotTopic[] = "motion_plot";                 ///< out, on demand: sensor_msgs/Image

constexpr char kResetService[] = "reset";        ///< std_srvs/Trigger, private
constexpr char kSaveService[] = "save";          ///< std_srvs/Trigger, private
constexpr char kFinaliseService[] = "finalise";  ///< std_srvs/Trigger, private
constexpr char kVetoService[] = "veto";          ///< svort_ros/Veto, private
constexpr char kThresholds[] = "decision";       ///< private namespace of dynamic_reconfigure's services and topics

}  // namespace svort_ros
