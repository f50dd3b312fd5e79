#include "svort_ros/simulation/scanner.h"

#include <algorithm>
#include <array>
#include <cmath>
#include <sstream>
#include <stdexcept>

#include "purposes.h"
#include "svort_ros/acquisition/slice.h"

namespace svort {
namespace {

constexpr double kDegree = M_PI / 180.;

template <class Value>
void require(bool ok, const char* option, const Value& value, const std::string& limit) {
  if (ok) return;
  std::ostringstream text;
  text << "scanner." << option << " is " << value << ", must be " << limit;
  throw std::invalid_argument(text.str());
}

template <class Value>
void check_range(const char* low_name, Value low, const char* high_name, Value high, Value least, Value most) {
  const auto text = [](Value value) {
    std::ostringstream stream;
    stream << value;
    return stream.str();
  };
  require(low >= least && low <= most, low_name, low, "in " + text(least) + " .. " + text(most));
  require(high >= low && high <= most, high_name, high, "in " + text(low) + " (" + low_name + ") .. " + text(most));
}

/// Slice axes in the brain's axes (LPS) for the three standard planes.
Eigen::Matrix3d plane_axes(int plane) {
  Eigen::Matrix3d axes;
  switch (plane) {
    case 0:  // axial: columns to the left, rows to posterior
      axes.setIdentity();
      break;
    case 1:  // coronal: columns to the left, rows to inferior
      axes.col(0) = Eigen::Vector3d::UnitX();
      axes.col(1) = -Eigen::Vector3d::UnitZ();
      axes.col(2) = Eigen::Vector3d::UnitY();
      break;
    default:  // sagittal: columns to posterior, rows to inferior
      axes.col(0) = Eigen::Vector3d::UnitY();
      axes.col(1) = -Eigen::Vector3d::UnitZ();
      axes.col(2) = -Eigen::Vector3d::UnitX();
  }
  return axes;
}

Eigen::Matrix3d turn(const Eigen::Vector3d& rotation) {
  const double angle = rotation.norm();
  if (angle < 1e-12) return Eigen::Matrix3d::Identity();
  return Eigen::AngleAxisd(angle, rotation / angle).toRotationMatrix();
}

Pose translation(const Eigen::Vector3d& offset) {
  Pose pose = Pose::Identity();
  pose.translation() = offset;
  return pose;
}

}  // namespace

void check(const ScannerOptions& options) {
  require(options.protocol == "scanner" || options.protocol == "uniform", "protocol", "'" + options.protocol + "'",
          "scanner or uniform");
  check_range("stacks_min", options.stacks_min, "stacks_max", options.stacks_max, 1, 100);
  check_range("slices_min", options.slices_min, "slices_max", options.slices_max, 1, 1000);
  check_range("thickness_min_mm", options.thickness_min_mm, "thickness_max_mm", options.thickness_max_mm, 0.1, 100.);
  check_range("interleave_min", options.interleave_min, "interleave_max", options.interleave_max, 1, 1000);
  check_range("tr_min_s", options.tr_min_s, "tr_max_s", options.tr_max_s, 0.01, 1000.);
  require(options.spare_slices >= 0, "spare_slices", options.spare_slices, "at least 0");
  require(options.prefix_slices_min >= 1, "prefix_slices_min", options.prefix_slices_min, "at least 1");
  const auto in = [](double value, double least, double most) { return value >= least && value <= most; };
  require(in(options.gap_max, 0., 10.), "gap_max", options.gap_max, "in 0 .. 10");
  require(in(options.pause_max_s, 0., 1000.), "pause_max_s", options.pause_max_s, "in 0 .. 1000");
  require(in(options.tilt_deg, 0., 180.), "tilt_deg", options.tilt_deg, "in 0 .. 180");
  require(in(options.offset_mm, 0., 1000.), "offset_mm", options.offset_mm, "in 0 .. 1000");
  require(in(options.displaced_mm, 0., 1000.), "displaced_mm", options.displaced_mm, "in 0 .. 1000");
  require(in(options.planned_share, 0., 1.), "planned_share", options.planned_share, "in 0 .. 1");
  require(in(options.reversed_share, 0., 1.), "reversed_share", options.reversed_share, "in 0 .. 1");
  require(in(options.prefix_share, 0., 1.), "prefix_share", options.prefix_share, "in 0 .. 1");
}

ScanPlan plan_scan(const ScannerOptions& options, const MotionOptions& motion, const BrainExtent& brain,
                   std::uint64_t seed, std::uint64_t scan) {
  check(options);
  RandomStream random(seed, scan, purpose::kScanner);
  ScanPlan plan;
  plan.stacks = random.integer(options.stacks_min, options.stacks_max);
  plan.thickness_mm = random.uniform(options.thickness_min_mm, options.thickness_max_mm);
  plan.spacing_mm = plan.thickness_mm * (1. + random.uniform(0., options.gap_max));
  plan.tr_s = random.uniform(options.tr_min_s, options.tr_max_s);
  plan.interleave = random.integer(options.interleave_min, options.interleave_max);

  const double longest = plan.stacks * (options.slices_max * plan.tr_s + options.pause_max_s);
  const HeadTrajectory trajectory(motion, longest, RandomStream(seed, scan, purpose::kMotion));
  // The head's centre is the origin of the trajectory, and of the scanner when the scan begins.
  Pose T_scanner_start = Pose::Identity();
  T_scanner_start.linear() = random.rotation();
  const auto T_scanner_head = [&](double time) { return Pose(T_scanner_start * trajectory.at(time)); };
  const Pose T_head_brain = translation(-brain.centre);

  const bool planned = random.chance(options.planned_share);
  std::array<int, 3> planes{0, 1, 2};
  for (int i = 2; i > 0; --i)
    std::swap(planes[static_cast<std::size_t>(i)], planes[static_cast<std::size_t>(random.integer(0, i))]);

  double time = 0.;
  for (int stack = 0; stack < plan.stacks; ++stack) {
    if (stack > 0) time += random.uniform(0., options.pause_max_s);
    const Pose T_scanner_planned = T_scanner_head(time);
    Pose T_scanner_stack = Pose::Identity();
    const Eigen::Vector3d tilt = random.normal3(options.tilt_deg * kDegree);
    const int quarter_turns = random.integer(0, 3);
    const Eigen::Matrix3d any = random.rotation();
    if (options.protocol == "uniform") {
      T_scanner_stack.linear() = any;
    } else {
      Eigen::Matrix3d axes = Eigen::Matrix3d::Identity();
      if (planned) axes = T_scanner_planned.linear();
      T_scanner_stack.linear() = axes * plane_axes(planes[static_cast<std::size_t>(stack % 3)]) *
                                 turn(0.5 * M_PI * quarter_turns * Eigen::Vector3d::UnitZ()) * turn(tilt);
    }
    T_scanner_stack.translation() = T_scanner_planned.translation() + random.normal3(options.offset_mm);

    // How far an ellipsoid of the brain's size reaches along the stack's normal.
    const Eigen::Vector3d normal = T_scanner_planned.linear().transpose() * T_scanner_stack.linear().col(2);
    const double reach = brain.half_size.cwiseProduct(normal).norm();
    const int covering =
        static_cast<int>(std::ceil(2. * reach / plan.spacing_mm)) + random.integer(0, options.spare_slices);
    const int count = std::clamp(covering, options.slices_min, options.slices_max);
    const double direction = random.chance(options.reversed_share) ? -1. : 1.;

    for (const int index : interleaved_order(count, plan.interleave)) {
      PlannedSlice slice;
      slice.stack = stack;
      slice.index = index;
      slice.slices_in_stack = count;
      slice.time_s = time;
      slice.T_stack_slice.translation().z() = direction * (index - 0.5 * (count - 1)) * plan.spacing_mm;
      slice.T_scanner_slice = T_scanner_stack * slice.T_stack_slice;
      const Pose T_scanner_now = T_scanner_head(time);
      slice.T_scanner_brain = T_scanner_now * T_head_brain;
      slice.head_speed = trajectory.speed(time);
      slice.head_displacement = sphere_distance(T_scanner_planned, T_scanner_now);
      slice.displaced = slice.head_displacement > options.displaced_mm;
      plan.acquired.push_back(slice);
      time += plan.tr_s;
    }
  }
  plan.slices = plan.acquired.size();

  // A cut leaves some slices that surely show brain, not only the empty ones at the end of a stack.
  int least = 0;
  for (int sure = 0; least < static_cast<int>(plan.slices) && sure < options.prefix_slices_min; ++least) {
    const PlannedSlice& slice = plan.acquired[static_cast<std::size_t>(least)];
    const Pose T_slice_brain = slice.T_brain_slice().inverse();
    const Eigen::Vector3d normal = T_slice_brain.linear().transpose().col(2);
    const double reach = brain.half_size.cwiseProduct(normal).norm();
    if (std::abs((T_slice_brain * brain.centre).z()) < 0.6 * reach) ++sure;
  }
  const bool cut = random.chance(options.prefix_share);
  const int kept = random.integer(least, static_cast<int>(plan.slices));
  if (cut) plan.acquired.resize(static_cast<std::size_t>(kept));
  return plan;
}

}  // namespace svort
