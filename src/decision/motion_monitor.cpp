#include "svort_ros/decision/motion_monitor.h"

#include <algorithm>
#include <cmath>

#include "checks.h"

namespace svort {
namespace {

constexpr double kUsualRadiusMm = 40.;  // of docs/simulation.md, while the brain's volume is unknown
constexpr std::size_t kFewestOfAStack = 3;
constexpr double kGoodStackShare = 0.75;
constexpr double kNever = std::numeric_limits<double>::infinity();

bool is_outlier(const SliceEstimate& slice) { return slice.weight <= 0. || slice.status == PoseStatus::outlier; }

/// The slice that motion is counted from: the one in the middle of the poses of the first good stack, as the first
/// slices of a scan are often the worst placed; or the first good one of a chosen time on.
std::size_t reference_of(const std::vector<SliceEstimate>& slices, double radius, const MotionMonitorOptions& options) {
  if (options.reference_s >= 0.) {
    const auto from_ns = slices.front().info.stamp_ns + static_cast<std::int64_t>(options.reference_s * 1e9);
    for (std::size_t i = 0; i < slices.size(); ++i)
      if (slices[i].info.stamp_ns >= from_ns && !is_outlier(slices[i])) return i;
    return 0;  // not there yet
  }
  for (std::size_t first = 0; first < slices.size(); ++first) {
    if (is_outlier(slices[first])) continue;
    std::vector<std::size_t> good;
    std::size_t count = 0;
    for (std::size_t i = 0; i < slices.size(); ++i)
      if (slices[i].info.stack == slices[first].info.stack) {
        ++count;
        if (!is_outlier(slices[i])) good.push_back(i);
      }
    if (count < kFewestOfAStack || static_cast<double>(good.size()) < kGoodStackShare * static_cast<double>(count))
      continue;
    std::size_t reference = first;
    double least = std::numeric_limits<double>::infinity();
    for (const std::size_t i : good) {
      double sum = 0.;
      for (const std::size_t k : good)
        sum += sphere_displacement(slices[i].T_scanner_brain, slices[k].T_scanner_brain, radius);
      if (sum < least * (1. - 1e-9)) {  // of equals the first
        least = sum;
        reference = i;
      }
    }
    return reference;
  }
  return 0;
}

double error_of(const SliceEstimate& slice, const MotionMonitorOptions& options) {
  if (is_outlier(slice)) return kNever;
  return std::isfinite(slice.radius_95_mm) ? slice.radius_95_mm : options.assumed_error_mm;
}

/// Rotation and shift of the brain's centre from a to b, in scanner axes.
void motion_between(const Pose& a, const Pose& b, Eigen::Vector3d* shift, Eigen::Vector3d* rotation) {
  *shift = b.translation() - a.translation();
  const Eigen::AngleAxisd turn(Eigen::Matrix3d(b.linear() * a.linear().transpose()));
  *rotation = turn.angle() * turn.axis();
}

}  // namespace

const char* to_string(MotionClass motion) {
  switch (motion) {
    case MotionClass::none:
      return "none";
    case MotionClass::mild:
      return "mild";
    case MotionClass::moderate:
      return "moderate";
    case MotionClass::severe:
      return "severe";
  }
  return "unknown";
}

void validate(const MotionMonitorOptions& o) {
  const OptionCheck check("decision.motion.");
  check(o.head_radius_mm >= 0. && o.head_radius_mm <= 200., "head_radius_mm", o.head_radius_mm, "from 0 to 200 mm");
  check(std::isfinite(o.reference_s), "reference_s", o.reference_s, "finite");
  check(o.assumed_error_mm >= 0. && o.assumed_error_mm <= 100., "assumed_error_mm", o.assumed_error_mm,
        "from 0 to 100 mm");
  check(o.speed_window_s > 0. && o.speed_window_s <= 1000., "speed_window_s", o.speed_window_s, "in (0, 1000] s");
  check(o.window_s > 0. && o.window_s <= 1e5, "window_s", o.window_s, "in (0, 100000] s");
  check(o.mild_mm > 0., "mild_mm", o.mild_mm, "positive");
  check(o.moderate_mm > o.mild_mm, "moderate_mm", o.moderate_mm, "above mild_mm");
  check(o.severe_mm > o.moderate_mm && std::isfinite(o.severe_mm), "severe_mm", o.severe_mm, "above moderate_mm");
}

double sphere_displacement(const Pose& a, const Pose& b, double radius_mm) {
  // Over the sphere, E|(Ra - Rb) x + d|^2 = |Ra - Rb|_F^2 radius^2 / 3 + |d|^2.
  const double turned = (a.linear() - b.linear()).squaredNorm() * radius_mm * radius_mm / 3.;
  return std::sqrt(turned + (a.translation() - b.translation()).squaredNorm());
}

const HeadMotion* MotionReport::now() const {
  for (std::size_t i = slices.size(); i-- > 0;)
    if (std::isfinite(slices[i].error_mm)) return &slices[i];
  return slices.empty() ? nullptr : &slices.back();
}

MotionReport measure_motion(const Estimate& estimate, double brain_volume_mm3, const MotionMonitorOptions& options) {
  MotionReport report;
  report.head_radius_mm = options.head_radius_mm;
  if (report.head_radius_mm <= 0.)
    report.head_radius_mm = brain_volume_mm3 > 0. ? std::cbrt(0.75 * brain_volume_mm3 / M_PI) : kUsualRadiusMm;
  const std::vector<SliceEstimate>& slices = estimate.slices;
  if (slices.empty()) return report;
  const double radius = report.head_radius_mm;
  report.reference = reference_of(slices, radius, options);
  const SliceEstimate& reference = slices[report.reference];
  const double reference_error = error_of(reference, options);

  const SliceEstimate* before = nullptr;  // newest slice so far that is no outlier
  for (std::size_t i = 0; i < slices.size(); ++i) {
    const SliceEstimate& slice = slices[i];
    HeadMotion motion;
    motion.stack = slice.info.stack;
    motion.index = slice.info.index;
    motion.stamp_ns = slice.info.stamp_ns;
    motion.T_scanner_brain = slice.T_scanner_brain;
    motion_between(reference.T_scanner_brain, slice.T_scanner_brain, &motion.shift_mm, &motion.rotation);
    motion.displacement_mm = sphere_displacement(reference.T_scanner_brain, slice.T_scanner_brain, radius);
    motion.error_mm = i == report.reference ? 0. : std::hypot(error_of(slice, options), reference_error);
    motion.moved = motion.displacement_mm > motion.error_mm;
    if (before && !is_outlier(slice)) {
      Eigen::Vector3d shift, rotation;
      motion_between(before->T_scanner_brain, slice.T_scanner_brain, &shift, &rotation);
      motion.framewise_mm = shift.lpNorm<1>() + radius * rotation.lpNorm<1>();
    }
    if (!is_outlier(slice)) {
      // The latest slice that is at least a window old; poses closer in time differ by little but their errors.
      for (std::size_t k = i; k-- > 0;) {
        const double elapsed_s = 1e-9 * static_cast<double>(slice.info.stamp_ns - slices[k].info.stamp_ns);
        if (elapsed_s < options.speed_window_s || is_outlier(slices[k])) continue;
        const double moved = sphere_displacement(slices[k].T_scanner_brain, slice.T_scanner_brain, radius);
        if (moved > std::hypot(error_of(slice, options), error_of(slices[k], options)))
          motion.speed_mm_s = moved / elapsed_s;
        break;
      }
      before = &slice;
    }
    report.slices.push_back(motion);
  }

  // Motion class: against the pose in the middle of the window, as docs/simulation.md has it.
  const std::int64_t from_ns = slices.back().info.stamp_ns - static_cast<std::int64_t>(options.window_s * 1e9);
  std::vector<std::size_t> window;
  for (std::size_t i = 0; i < slices.size(); ++i)
    if (slices[i].info.stamp_ns >= from_ns && !is_outlier(slices[i])) window.push_back(i);
  if (window.empty()) return report;
  const SliceEstimate& middle = slices[window[window.size() / 2]];
  double sum = 0.;
  for (const std::size_t i : window) {
    const double moved = sphere_displacement(middle.T_scanner_brain, slices[i].T_scanner_brain, radius);
    if (moved > std::hypot(error_of(slices[i], options), error_of(middle, options))) sum += moved;
  }
  report.window_displacement_mm = sum / static_cast<double>(window.size());
  if (report.window_displacement_mm >= options.severe_mm)
    report.motion = MotionClass::severe;
  else if (report.window_displacement_mm >= options.moderate_mm)
    report.motion = MotionClass::moderate;
  else if (report.window_displacement_mm >= options.mild_mm)
    report.motion = MotionClass::mild;
  return report;
}

}  // namespace svort
