#pragma once

#include <Eigen/Core>
#include <cstdint>
#include <limits>
#include <string>
#include <vector>

#include "svort_ros/geometry/pose.h"
#include "svort_ros/live/incremental_estimator.h"

namespace svort {

/// How head motion is measured and classed; docs/motion.md defines the quantities.
struct MotionMonitorOptions {
  double head_radius_mm = 0.;  ///< sphere on which motion is measured; 0: the sphere of the brain's volume
  double reference_s = -1.;    ///< motion is counted from this time after the first slice; below 0: first good stack
  /// 95 % error of a head pose that the estimator gives none for. Raise it if a head at rest is reported to move.
  double assumed_error_mm = 2.;
  double speed_window_s = 5.;  ///< speed is the displacement over this time, divided by it
  double window_s = 90.;       ///< motion class: mean displacement over this time
  double mild_mm = 1.;         ///< motion class "mild" from here on
  double moderate_mm = 3.2;    ///< "moderate" from here on
  double severe_mm = 8.5;      ///< "severe" from here on

  template <class Visitor>
  void visit(Visitor&& v) {
    v("head_radius_mm", head_radius_mm, "sphere on which motion is measured, mm; 0: the sphere of the brain's volume");
    v("reference_s", reference_s,
      "motion is counted from this time after the first slice, s; below 0: first good stack");
    v("assumed_error_mm", assumed_error_mm, "95 % error of a head pose that the estimator gives none for, mm");
    v("speed_window_s", speed_window_s, "speed is the displacement over this time, s");
    v("window_s", window_s, "motion class: mean displacement over this time, s");
    v("mild_mm", mild_mm, "motion class mild from this mean displacement on, mm");
    v("moderate_mm", moderate_mm, "motion class moderate from here on, mm");
    v("severe_mm", severe_mm, "motion class severe from here on, mm");
  }
};

/// @throws std::invalid_argument naming the option that is out of range
void validate(const MotionMonitorOptions& options);

/// Of docs/simulation.md, told from the mean displacement.
enum class MotionClass { none, mild, moderate, severe };
const char* to_string(MotionClass motion);

/// Where the head was at one slice.
struct HeadMotion {
  int stack = 0;
  int index = 0;
  std::int64_t stamp_ns = 0;
  Pose T_scanner_brain = Pose::Identity();             ///< mm
  Eigen::Vector3d shift_mm = Eigen::Vector3d::Zero();  ///< of the brain's centre since the reference, scanner axes
  Eigen::Vector3d rotation = Eigen::Vector3d::Zero();  ///< since the reference, axis times angle (rad), scanner axes
  double displacement_mm = 0.;                         ///< since the reference, rms over the head's sphere
  double error_mm = 0.;                                ///< 95 % error of that; infinite for an outlier
  bool moved = false;                                  ///< displacement above its error
  double framewise_mm = 0.;                            ///< since the slice before (Power et al. 2012)
  double speed_mm_s = 0.;                              ///< 0 unless the displacement it is made of exceeds its error
};

/// The head's way through the scan at one revision.
struct MotionReport {
  double head_radius_mm = 0.;
  std::size_t reference = 0;       ///< which of `slices` motion is counted from
  std::vector<HeadMotion> slices;  ///< in acquisition order
  MotionClass motion = MotionClass::none;
  double window_displacement_mm = 0.;  ///< mean over the last window, what lies within its error counted as 0
  /// Newest head pose that is not an outlier's; null without slices.
  const HeadMotion* now() const;
};

/// Motion of all slices of an estimate. All poses are of one revision, so a step of the brain frame is never motion.
///
/// @param brain_volume_mm3 volume of the brain, for the radius; 0 if unknown: the radius is 40 mm then
MotionReport measure_motion(const Estimate& estimate, double brain_volume_mm3, const MotionMonitorOptions& options);

/// Root mean square distance between the points of a sphere around the brain frame's origin under a and under b, mm.
double sphere_displacement(const Pose& a, const Pose& b, double radius_mm);

}  // namespace svort
