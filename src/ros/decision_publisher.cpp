#include "svort_ros/ros/decision_publisher.h"

#include <sensor_msgs/image_encodings.h>
#include <sensor_msgs/point_cloud2_iterator.h>

#include <algorithm>
#include <cmath>
#include <opencv2/imgcodecs.hpp>

#include "svort_ros/io/decision_files.h"
#include "svort_ros/ros/conversions.h"
#include "svort_ros/ros/names.h"

namespace svort_ros {
namespace {

constexpr double kMetres = 1e-3;  // per mm

std_msgs::Header header_of(std::int64_t stamp_ns, const std::string& frame) {
  std_msgs::Header header;
  header.stamp = to_ros_time(stamp_ns);
  header.frame_id = frame;
  return header;
}

std_msgs::Header header_of(const svort::Estimate& estimate, const std::string& frame) {
  return header_of(estimate.slices.empty() ? 0 : estimate.slices.back().info.stamp_ns, frame);
}

geometry_msgs::Vector3 to_vector(const Eigen::Vector3d& v) {
  geometry_msgs::Vector3 message;
  message.x = v.x();
  message.y = v.y();
  message.z = v.z();
  return message;
}

geometry_msgs::Point to_point(const Eigen::Vector3d& position_mm) {
  geometry_msgs::Point message;
  message.x = kMetres * position_mm.x();
  message.y = kMetres * position_mm.y();
  message.z = kMetres * position_mm.z();
  return message;
}

std_msgs::ColorRGBA colour(double red, double green, double blue, double alpha = 1.) {
  std_msgs::ColorRGBA rgba;
  rgba.r = static_cast<float>(red);
  rgba.g = static_cast<float>(green);
  rgba.b = static_cast<float>(blue);
  rgba.a = static_cast<float>(alpha);
  return rgba;
}

/// Red, yellow, green.
std_msgs::ColorRGBA quality_colour(double score) {
  const double t = std::clamp(score, 0., 1.);
  return colour(std::min(1., 2. - 2. * t), std::min(1., 2. * t), 0.1, 0.8);
}

visualization_msgs::Marker make_marker(const std_msgs::Header& header, const std::string& ns, int type,
                                       double width_mm) {
  visualization_msgs::Marker marker;
  marker.header = header;
  marker.ns = ns;
  marker.type = type;
  marker.action = visualization_msgs::Marker::ADD;
  marker.pose.orientation.w = 1.;
  marker.scale.x = kMetres * width_mm;
  marker.color = colour(1., 1., 1.);
  return marker;
}

visualization_msgs::Marker delete_all(const std_msgs::Header& header) {
  visualization_msgs::Marker marker;
  marker.header = header;
  marker.action = visualization_msgs::Marker::DELETEALL;
  return marker;
}

/// The four sides of a rectangle in the plane of a slice.
void add_rectangle(visualization_msgs::Marker* marker, const svort::Pose& T_brain_slice, const Eigen::Vector2d& low,
                   const Eigen::Vector2d& high, const std_msgs::ColorRGBA& shade) {
  const Eigen::Vector2d corners[] = {low, {high.x(), low.y()}, high, {low.x(), high.y()}};
  for (std::size_t i = 0; i < 4; ++i)
    for (const std::size_t k : {i, (i + 1) % 4}) {
      marker->points.push_back(to_point(T_brain_slice * Eigen::Vector3d(corners[k].x(), corners[k].y(), 0.)));
      marker->colors.push_back(shade);
    }
}

}  // namespace

HeadMotion to_msg(const svort::MotionReport& motion, const svort::Estimate& estimate,
                  const std::string& scanner_frame) {
  HeadMotion message;
  message.header = header_of(estimate, scanner_frame);
  message.scan_id = estimate.scan_id;
  message.revision = estimate.revision;
  message.head_radius = kMetres * motion.head_radius_mm;
  message.motion_class = static_cast<std::uint8_t>(motion.motion);
  message.window_displacement = kMetres * motion.window_displacement_mm;
  const svort::HeadMotion* now = motion.now();
  if (!now) return message;
  const svort::HeadMotion& reference = motion.slices[motion.reference];
  message.header.stamp = to_ros_time(now->stamp_ns);
  message.reference_stack = reference.stack;
  message.reference_index = reference.index;
  message.reference_stamp = to_ros_time(reference.stamp_ns);
  message.shift = to_vector(kMetres * now->shift_mm);
  message.rotation = to_vector(now->rotation);
  message.displacement = kMetres * now->displacement_mm;
  message.error = kMetres * now->error_mm;
  message.moved = static_cast<std::uint8_t>(now->moved);
  message.framewise = kMetres * now->framewise_mm;
  message.speed = kMetres * now->speed_mm_s;
  return message;
}

SequenceQuality to_msg(const std::vector<svort::SliceQuality>& slices, double accept, const svort::Estimate& estimate,
                       const std::string& brain_frame) {
  SequenceQuality message;
  message.header = header_of(estimate, brain_frame);
  message.scan_id = estimate.scan_id;
  message.revision = estimate.revision;
  message.accept = accept;
  for (const svort::SliceQuality& slice : slices) {
    SliceQuality quality;
    quality.stack = slice.stack;
    quality.index = slice.index;
    quality.stamp = to_ros_time(slice.stamp_ns);
    quality.score = static_cast<float>(slice.score);
    quality.image_score = static_cast<float>(slice.image_score);
    quality.first_score = static_cast<float>(slice.first_score);
    quality.accepted = static_cast<std::uint8_t>(slice.score >= accept);
    for (const svort::QualityReason reason : slice.reasons) quality.reasons.emplace_back(svort::to_string(reason));
    message.slices.push_back(quality);
  }
  return message;
}

Coverage to_msg(const svort::CoverageMap& coverage, const svort::Completion& completion,
                const svort::Estimate& estimate, const std::string& brain_frame) {
  Coverage message;
  message.header = header_of(estimate, brain_frame);
  message.scan_id = estimate.scan_id;
  message.revision = estimate.revision;
  message.brain_volume = 1e-9 * coverage.brain_mm3;
  message.mean_score = coverage.mean_score;
  message.seen_well = coverage.seen_well;
  message.complete = coverage.complete;
  message.orientations = coverage.mean_orientations;
  message.slices_left = static_cast<std::uint32_t>(completion.slices);
  message.seconds_left = completion.seconds;
  message.expected_quality = completion.yield;
  for (const svort::CoverageGap& gap : coverage.gaps) {
    message.gaps.push_back(to_point(gap.centre));
    message.gap_widths.push_back(kMetres * gap.width_mm);
    message.gap_volumes.push_back(1e-6 * gap.volume_ml);
  }
  return message;
}

ReacquisitionPlan to_msg(const svort::ReacquisitionPlanner& planner, bool dry_run, const svort::Estimate& estimate,
                         const std::string& scanner_frame) {
  ReacquisitionPlan message;
  message.header = header_of(estimate, scanner_frame);
  message.scan_id = estimate.scan_id;
  message.revision = estimate.revision;
  message.dry_run = static_cast<std::uint8_t>(dry_run);
  message.budget = planner.budget_left_s();
  for (const svort::ReacquisitionRequest& request : planner.waiting()) {
    ReacquisitionRequest wish;
    wish.id = request.id;
    wish.rank = request.rank;
    wish.state = static_cast<std::uint8_t>(request.state);
    wish.asked = to_ros_time(request.asked_ns);
    wish.again = static_cast<std::uint8_t>(request.again);
    wish.stack = request.stack;
    wish.index = request.index;
    wish.reasons = request.reasons;
    wish.brain_from_slice = to_pose_msg(request.T_brain_slice);
    wish.scanner_from_slice = to_pose_msg(request.T_scanner_slice);
    wish.thickness = kMetres * request.thickness_mm;
    wish.gain = request.gain;
    wish.cost = request.cost_s;
    message.requests.push_back(wish);
  }
  return message;
}

nav_msgs::Path to_path(const svort::MotionReport& motion, const std::string& scanner_frame) {
  nav_msgs::Path path;
  path.header = header_of(motion.slices.empty() ? 0 : motion.slices.back().stamp_ns, scanner_frame);
  for (const svort::HeadMotion& slice : motion.slices) {
    if (!std::isfinite(slice.error_mm)) continue;
    geometry_msgs::PoseStamped pose;
    pose.header = header_of(slice.stamp_ns, scanner_frame);
    pose.pose = to_pose_msg(slice.T_scanner_brain);
    path.poses.push_back(pose);
  }
  return path;
}

visualization_msgs::MarkerArray to_motion_markers(const svort::MotionReport& motion, const std::string& scanner_frame) {
  visualization_msgs::MarkerArray markers;
  const std_msgs::Header header = header_of(motion.slices.empty() ? 0 : motion.slices.back().stamp_ns, scanner_frame);
  markers.markers.push_back(delete_all(header));
  const svort::HeadMotion* now = motion.now();
  if (!now) return markers;
  const auto arrow = [&](const std::string& ns, int id, const Eigen::Vector3d& from, const Eigen::Vector3d& to,
                         double width_mm, const std_msgs::ColorRGBA& shade) {
    if ((to - from).norm() < 0.05) return;  // too short to have a direction
    visualization_msgs::Marker marker = make_marker(header, ns, visualization_msgs::Marker::ARROW, width_mm);
    marker.id = id;
    marker.scale.y = 2. * marker.scale.x;
    marker.points = {to_point(from), to_point(to)};
    marker.color = shade;
    markers.markers.push_back(marker);
  };
  const svort::HeadMotion* before = nullptr;
  int id = 0;
  for (const svort::HeadMotion& slice : motion.slices) {
    if (!std::isfinite(slice.error_mm)) continue;
    if (before)
      arrow("steps", id++, before->T_scanner_brain.translation(), slice.T_scanner_brain.translation(), 0.6,
            colour(0.4, 0.7, 1., 0.8));
    before = &slice;
  }
  const svort::HeadMotion& reference = motion.slices[motion.reference];
  arrow("since_reference", 0, reference.T_scanner_brain.translation(), now->T_scanner_brain.translation(), 2.,
        now->moved ? colour(1., 0.4, 0.1) : colour(0.6, 0.6, 0.6));
  return markers;
}

visualization_msgs::MarkerArray to_quality_markers(const svort::Estimate& estimate,
                                                   const svort::QualityMonitor& quality,
                                                   const std::string& brain_frame) {
  visualization_msgs::MarkerArray markers;
  visualization_msgs::Marker lines =
      make_marker(header_of(estimate, brain_frame), "quality", visualization_msgs::Marker::LINE_LIST, 0.5);
  for (std::size_t i = 0; i < std::min(estimate.slices.size(), quality.size()); ++i) {
    const svort::SliceBlocks& blocks = quality.blocks(i);
    Eigen::Vector2d low = Eigen::Vector2d::Constant(1e9), high = -low;
    for (int row = 0; row < blocks.size; ++row)
      for (int column = 0; column < blocks.size; ++column)
        if (blocks.brain[static_cast<std::size_t>(row * blocks.size + column)]) {
          low = low.cwiseMin(blocks.centre(column, row).head<2>());
          high = high.cwiseMax(blocks.centre(column, row).head<2>());
        }
    if (low.x() > high.x()) continue;
    add_rectangle(&lines, estimate.slices[i].T_brain_slice, low, high, quality_colour(quality.slices()[i].score));
  }
  if (lines.points.empty()) lines.action = visualization_msgs::Marker::DELETE;
  markers.markers.push_back(lines);
  return markers;
}

sensor_msgs::PointCloud2 to_coverage_cloud(const svort::CoverageMap& coverage, const std_msgs::Header& header) {
  sensor_msgs::PointCloud2 cloud;
  cloud.header = header;
  cloud.is_dense = true;
  sensor_msgs::PointCloud2Modifier modifier(cloud);
  modifier.setPointCloud2Fields(4, "x", 1, sensor_msgs::PointField::FLOAT32, "y", 1, sensor_msgs::PointField::FLOAT32,
                                "z", 1, sensor_msgs::PointField::FLOAT32, "intensity", 1,
                                sensor_msgs::PointField::FLOAT32);
  modifier.resize(coverage.places);
  if (coverage.empty()) return cloud;  // an iterator needs a first point
  sensor_msgs::PointCloud2Iterator<float> point(cloud, "x");
  const Eigen::Vector3i& size = coverage.grid.size;
  for (int k = 0; k < size.z(); ++k)
    for (int j = 0; j < size.y(); ++j)
      for (int i = 0; i < size.x(); ++i) {
        const std::size_t at = coverage.grid.offset(i, j, k);
        if (!coverage.brain[at]) continue;
        const Eigen::Vector3d position = coverage.grid.position({double(i), double(j), double(k)});
        for (int axis = 0; axis < 3; ++axis) point[axis] = static_cast<float>(kMetres * position[axis]);
        point[3] = coverage.score[at];
        ++point;
      }
  return cloud;
}

visualization_msgs::MarkerArray to_plan_markers(const std::vector<svort::ReacquisitionRequest>& waiting,
                                                const svort::CoverageMap& coverage, double head_radius_mm,
                                                const std_msgs::Header& header) {
  visualization_msgs::MarkerArray markers;
  markers.markers.push_back(delete_all(header));
  visualization_msgs::Marker lines = make_marker(header, "planned", visualization_msgs::Marker::LINE_LIST, 1.2);
  int id = 0;
  for (const svort::ReacquisitionRequest& request : waiting) {
    // Around the brain, whatever the centre of the prescription.
    const Eigen::Vector3d centre = request.T_brain_slice.inverse() * coverage.grid.T_frame_grid.translation();
    const Eigen::Vector2d half = Eigen::Vector2d::Constant(head_radius_mm + 8.);
    const std_msgs::ColorRGBA shade = request.rank == 1 ? colour(1., 0.2, 0.9) : colour(0.8, 0.4, 1., 0.7);
    add_rectangle(&lines, request.T_brain_slice, centre.head<2>() - half, centre.head<2>() + half, shade);
    visualization_msgs::Marker label = make_marker(header, "rank", visualization_msgs::Marker::TEXT_VIEW_FACING, 0.);
    label.id = id++;
    label.scale.z = kMetres * 6.;
    label.text = std::to_string(request.rank);
    label.color = shade;
    label.pose.position =
        to_point(request.T_brain_slice * Eigen::Vector3d(centre.x() + half.x() + 4., centre.y() + half.y() + 4., 0.));
    markers.markers.push_back(label);
  }
  if (!lines.points.empty()) markers.markers.push_back(lines);
  return markers;
}

sensor_msgs::Image to_motion_plot(const svort::MotionReport& motion, const std_msgs::Header& header) {
  const std::string png = svort::motion_png(motion);
  const cv::Mat picture = cv::imdecode(std::vector<unsigned char>(png.begin(), png.end()), cv::IMREAD_COLOR);
  sensor_msgs::Image message;
  message.header = header;
  message.height = static_cast<std::uint32_t>(picture.rows);
  message.width = static_cast<std::uint32_t>(picture.cols);
  message.encoding = sensor_msgs::image_encodings::BGR8;
  message.step = 3 * message.width;
  message.data.assign(picture.data, picture.data + std::size_t{message.step} * message.height);
  return message;
}

DecisionPublisher::DecisionPublisher(ros::NodeHandle nh, const NodeOptions& options,
                                     const std::function<void()>& on_connect)
    : options_(options),
      motion_(nh.advertise<HeadMotion>(kHeadMotionTopic, 10, true)),
      quality_(nh.advertise<SequenceQuality>(kSliceQualityTopic, 10, true)),
      coverage_(nh.advertise<Coverage>(kCoverageTopic, 10, true)),
      plan_(nh.advertise<ReacquisitionPlan>(kReacquisitionTopic, 10, true)) {
  const ros::SubscriberStatusCallback connected = [on_connect](const ros::SingleSubscriberPublisher&) { on_connect(); };
  coverage_volume_ = nh.advertise<Volume>(kCoverageVolumeTopic, 2, connected);
  path_ = nh.advertise<nav_msgs::Path>(kHeadPathTopic, 2, connected);
  motion_markers_ = nh.advertise<visualization_msgs::MarkerArray>(kHeadMotionMarkersTopic, 2, connected);
  quality_markers_ = nh.advertise<visualization_msgs::MarkerArray>(kQualityMarkersTopic, 2, connected);
  coverage_cloud_ = nh.advertise<sensor_msgs::PointCloud2>(kCoverageCloudTopic, 2, connected);
  plan_markers_ = nh.advertise<visualization_msgs::MarkerArray>(kPlannedSlicesTopic, 2, connected);
  plot_ = nh.advertise<sensor_msgs::Image>(kMotionPlotTopic, 2, connected);
}

void DecisionPublisher::publish(const svort::DecisionEngine& engine, const svort::LivePipeline& pipeline,
                                std::uint64_t revision_offset) {
  const svort::Estimate& estimate = pipeline.estimate();
  const auto send = [revision_offset](const ros::Publisher& publisher, auto message) {
    message.revision += revision_offset;
    publisher.publish(message);
  };
  send(motion_, to_msg(engine.motion(), estimate, options_.scanner_frame));
  send(quality_, to_msg(engine.quality(), engine.options().quality.accept, estimate, options_.brain_frame));
  send(coverage_, to_msg(engine.coverage(), engine.planner().completion(), estimate, options_.brain_frame));
  send(plan_, to_msg(engine.planner(), engine.options().reacquisition.dry_run, estimate, options_.scanner_frame));
  publish_pictures(engine, pipeline);
}

void DecisionPublisher::publish_pictures(const svort::DecisionEngine& engine, const svort::LivePipeline& pipeline) {
  if (engine.records().empty()) return;
  const svort::Estimate& estimate = pipeline.estimate();
  const std_msgs::Header in_brain = header_of(estimate, options_.brain_frame);
  const auto send = [](const ros::Publisher& publisher, const auto& make) {
    if (publisher.getNumSubscribers() > 0) publisher.publish(make());
  };
  send(path_, [&] { return to_path(engine.motion(), options_.scanner_frame); });
  send(motion_markers_, [&] { return to_motion_markers(engine.motion(), options_.scanner_frame); });
  send(quality_markers_, [&] { return to_quality_markers(estimate, engine.quality_monitor(), options_.brain_frame); });
  send(plot_, [&] { return to_motion_plot(engine.motion(), header_of(estimate, options_.scanner_frame)); });
  send(coverage_cloud_, [&] { return to_coverage_cloud(engine.coverage(), in_brain); });
  send(plan_markers_, [&] {
    return to_plan_markers(engine.planner().waiting(), engine.coverage(), engine.motion().head_radius_mm, in_brain);
  });
  if (!engine.coverage().empty())
    send(coverage_volume_, [&] {
      return to_msg(engine.coverage().score_volume(), VolumeEncoding::exact, estimate, options_.brain_frame);
    });
}

void DecisionPublisher::clear(const svort::LivePipeline& pipeline, std::uint64_t revision_offset) {
  const svort::DecisionEngine nothing{svort::DecisionOptions()};
  publish(nothing, pipeline, revision_offset);
  const std_msgs::Header in_brain = header_of(0, options_.brain_frame);
  visualization_msgs::MarkerArray remove;
  remove.markers.push_back(delete_all(in_brain));
  for (const ros::Publisher* publisher : {&motion_markers_, &quality_markers_, &plan_markers_})
    publisher->publish(remove);
  coverage_cloud_.publish(to_coverage_cloud(svort::CoverageMap(), in_brain));
}

}  // namespace svort_ros
