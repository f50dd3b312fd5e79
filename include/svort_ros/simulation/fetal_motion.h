#pragma once

#include <Eigen/Core>
#include <Eigen/Geometry>
#include <string>
#include <vector>

#include "svort_ros/geometry/pose.h"
#include "svort_ros/simulation/random_stream.h"

namespace svort {

/// How a fetal head moves. docs/simulation.md gives the figures that follow from these and where they come from.
struct MotionOptions {
  double drift_deg = 0.;           ///< root mean square rotation that drift adds in one minute, degrees
  double drift_mm = 0.;            ///< the same for translation, mm
  double bursts_per_hour = 0.;     ///< movements of the body
  double burst_s = 9.;             ///< their mean duration, s
  double burst_deg_per_s = 0.;     ///< root mean square angular speed during a burst, degrees/s
  double burst_mm_per_s = 0.;      ///< root mean square speed during a burst, mm/s
  double startles_per_hour = 0.;   ///< sudden movements, over within a second
  double startle_deg = 0.;         ///< mean rotation of a startle, degrees
  double startle_mm = 0.;          ///< mean translation of a startle, mm
  double startle_return = 0.5;     ///< share of startles after which the head goes back within seconds
  double breathing_mm = 0.;        ///< amplitude of the mother's breathing where the head is, mm
  double breathing_period_s = 4.;  ///< its period, s
  double confinement_mm = 25.;     ///< translation stays within so much of its start: the uterus holds the head
  double neck_mm = 45.;            ///< the head turns about a point so far below its centre, mm

  template <class Visitor>
  void visit(Visitor&& v) {
    v("drift_deg", drift_deg, "root mean square rotation that drift adds in one minute, degrees");
    v("drift_mm", drift_mm, "root mean square translation that drift adds in one minute, mm");
    v("bursts_per_hour", bursts_per_hour, "body movements per hour");
    v("burst_s", burst_s, "mean duration of a body movement, s");
    v("burst_deg_per_s", burst_deg_per_s, "root mean square angular speed during a body movement, degrees/s");
    v("burst_mm_per_s", burst_mm_per_s, "root mean square speed during a body movement, mm/s");
    v("startles_per_hour", startles_per_hour, "sudden movements (within a second) per hour");
    v("startle_deg", startle_deg, "mean rotation of a sudden movement, degrees");
    v("startle_mm", startle_mm, "mean translation of a sudden movement, mm");
    v("startle_return", startle_return, "share of sudden movements after which the head goes back");
    v("breathing_mm", breathing_mm, "amplitude of the mother's breathing where the head is, mm");
    v("breathing_period_s", breathing_period_s, "period of the mother's breathing, s");
    v("confinement_mm", confinement_mm, "translation stays within so much of its start, mm");
    v("neck_mm", neck_mm, "distance of the point about which the head turns from its centre, mm");
  }
};

/// Names of the motion classes, from little to much motion: none, mild, moderate, severe.
const std::vector<std::string>& motion_classes();

/// @throws std::invalid_argument naming the class and those that there are
MotionOptions motion_class(const std::string& name);

/// The head's way through one scan, continuous in time.
class HeadTrajectory {
 public:
  /// @param duration_s > 0; later times get the last pose
  /// @throws std::invalid_argument naming the option that is out of range
  HeadTrajectory(const MotionOptions& options, double duration_s, RandomStream random);

  /// T_start_head at time t: head coordinates (the brain's axes, its own centre) into those of time 0, mm.
  Pose at(double time_s) const;

  /// Speed at time t, mm/s: how fast the points 40 mm from the head's centre move (root mean square over directions).
  double speed(double time_s) const;

 private:
  struct Sample {
    Eigen::Quaterniond rotation;
    Eigen::Vector3d translation;
  };
  std::vector<Sample> samples_;
};

/// Root mean square distance over the sphere of `radius_mm` between its points under a and under b, mm.
double sphere_distance(const Pose& a, const Pose& b, double radius_mm = 40.);

}  // namespace svort
