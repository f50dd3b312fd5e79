#include "svort_ros/ros/conversions.h"

#include <sensor_msgs/image_encodings.h>
#include <sensor_msgs/point_cloud2_iterator.h>

#include <algorithm>
#include <boost/endian/conversion.hpp>
#include <cmath>
#include <limits>
#include <sstream>
#include <stdexcept>
#include <vector>

namespace svort_ros {
namespace {

constexpr double kMillimetresPerMetre = 1000.;
constexpr std::int64_t kNanosecondsPerSecond = 1'000'000'000;
constexpr std::uint32_t kLargestImage = 65535;  // pixels along an axis; keeps every product far from overflow

double to_metres(double millimetres) { return millimetres / kMillimetresPerMetre; }
double to_millimetres(double metres) { return metres * kMillimetresPerMetre; }

std_msgs::Header make_header(std::int64_t stamp_ns, const std::string& frame_id) {
  std_msgs::Header header;
  header.stamp = to_ros_time(stamp_ns);
  header.frame_id = frame_id;
  return header;
}

template <class T>
T load(const std::uint8_t* bytes, bool big_endian) {
  return big_endian ? boost::endian::endian_load<T, sizeof(T), boost::endian::order::big>(bytes)
                    : boost::endian::endian_load<T, sizeof(T), boost::endian::order::little>(bytes);
}

/// Throws unless the data holds exactly height rows of `step` bytes, each at least width pixels long.
void check_layout(const sensor_msgs::Image& image, std::size_t bytes_per_pixel, const char* what) {
  std::ostringstream problem;
  if (image.width == 0 || image.height == 0 || image.width > kLargestImage || image.height > kLargestImage) {
    problem << what << " has " << image.width << " x " << image.height << " pixels; allowed are 1 to " << kLargestImage
            << " along each axis";
  } else if (image.step < image.width * bytes_per_pixel) {
    problem << what << " has rows of " << image.step << " bytes; " << image.width << " pixels of " << image.encoding
            << " need " << image.width * bytes_per_pixel;
  } else if (const std::uint64_t expected = std::uint64_t{image.step} * image.height; image.data.size() != expected) {
    problem << what << " holds " << image.data.size() << " bytes; " << image.height << " rows of " << image.step
            << " bytes make " << expected;
  } else {
    return;
  }
  throw std::invalid_argument(problem.str());
}

template <class Stored, class Value>
std::vector<Value> decode(const sensor_msgs::Image& image, const char* what) {
  check_layout(image, sizeof(Stored), what);
  std::vector<Value> values;
  values.reserve(std::size_t{image.width} * image.height);
  for (std::size_t row = 0; row < image.height; ++row) {
    const std::uint8_t* bytes = image.data.data() + row * image.step;
    for (std::size_t column = 0; column < image.width; ++column, bytes += sizeof(Stored))
      values.push_back(static_cast<Value>(load<Stored>(bytes, image.is_bigendian != 0)));
  }
  return values;
}

std::vector<float> decode_pixels(const sensor_msgs::Image& image) {
  namespace encodings = sensor_msgs::image_encodings;
  const std::string& encoding = image.encoding;
  if (encoding == encodings::TYPE_32FC1) return decode<float, float>(image, "image");
  if (encoding == encodings::TYPE_64FC1) return decode<double, float>(image, "image");
  if (encoding == encodings::TYPE_16UC1 || encoding == encodings::MONO16)
    return decode<std::uint16_t, float>(image, "image");
  if (encoding == encodings::TYPE_16SC1) return decode<std::int16_t, float>(image, "image");
  if (encoding == encodings::TYPE_8UC1 || encoding == encodings::MONO8)
    return decode<std::uint8_t, float>(image, "image");
  throw std::invalid_argument("image encoding is '" + encoding +
                              "'; known are 32FC1, 64FC1, 16UC1, mono16, 16SC1, 8UC1 and mono8");
}

std::vector<std::uint8_t> decode_mask(const sensor_msgs::Image& mask, const sensor_msgs::Image& image) {
  namespace encodings = sensor_msgs::image_encodings;
  if (mask.width == 0 && mask.height == 0 && mask.data.empty()) return {};
  if (mask.encoding != encodings::TYPE_8UC1 && mask.encoding != encodings::MONO8)
    throw std::invalid_argument("mask encoding is '" + mask.encoding + "'; known are 8UC1 and mono8");
  if (mask.width != image.width || mask.height != image.height) {
    std::ostringstream problem;
    problem << "mask has " << mask.width << " x " << mask.height << " pixels, the image " << image.width << " x "
            << image.height;
    throw std::invalid_argument(problem.str());
  }
  return decode<std::uint8_t, std::uint8_t>(mask, "mask");
}

}  // namespace

geometry_msgs::Pose to_pose_msg(const svort::Pose& pose_mm) {
  const Eigen::Quaterniond q = Eigen::Quaterniond(pose_mm.rotation()).normalized();
  geometry_msgs::Pose message;
  message.position.x = to_metres(pose_mm.translation().x());
  message.position.y = to_metres(pose_mm.translation().y());
  message.position.z = to_metres(pose_mm.translation().z());
  message.orientation.x = q.x();
  message.orientation.y = q.y();
  message.orientation.z = q.z();
  message.orientation.w = q.w();
  return message;
}

geometry_msgs::Transform to_transform_msg(const svort::Pose& pose_mm) {
  const geometry_msgs::Pose pose = to_pose_msg(pose_mm);
  geometry_msgs::Transform message;
  message.translation.x = pose.position.x;
  message.translation.y = pose.position.y;
  message.translation.z = pose.position.z;
  message.rotation = pose.orientation;
  return message;
}

svort::Pose from_msg(const geometry_msgs::Pose& pose_m) {
  const Eigen::Vector3d position(pose_m.position.x, pose_m.position.y, pose_m.position.z);
  const Eigen::Quaterniond q(pose_m.orientation.w, pose_m.orientation.x, pose_m.orientation.y, pose_m.orientation.z);
  if (!position.allFinite()) throw std::invalid_argument("position is not finite");
  if (!(std::abs(q.norm() - 1.) <= 1e-3)) {  // catches NaN too
    std::ostringstream problem;
    problem << "quaternion has length " << q.norm() << "; allowed is 1 within 0.001";
    throw std::invalid_argument(problem.str());
  }
  svort::Pose pose = svort::Pose::Identity();
  pose.linear() = q.normalized().toRotationMatrix();
  pose.translation() = position.unaryExpr(&to_millimetres);
  return pose;
}

ros::Time to_ros_time(std::int64_t stamp_ns) {
  const std::int64_t seconds = stamp_ns / kNanosecondsPerSecond;
  if (stamp_ns < 0 || seconds > std::numeric_limits<std::uint32_t>::max())
    throw std::invalid_argument("a time of " + std::to_string(stamp_ns) + " ns does not fit into ros::Time");
  return {static_cast<std::uint32_t>(seconds), static_cast<std::uint32_t>(stamp_ns % kNanosecondsPerSecond)};
}

SliceFromMessage from_msg(const Slice& message) {
  SliceFromMessage result;
  svort::SliceInfo& info = result.slice.info;
  info.scan_id = message.scan_id;
  info.stack = message.stack;
  info.index = message.index;
  info.slices_in_stack = message.slices_in_stack;
  info.stamp_ns = static_cast<std::int64_t>(message.header.stamp.toNSec());
  info.pixel_spacing = {to_millimetres(message.pixel_spacing_x), to_millimetres(message.pixel_spacing_y)};
  info.thickness = to_millimetres(message.thickness);
  try {
    result.slice.pixels = decode_pixels(message.image);
    info.columns = static_cast<int>(message.image.width);
    info.rows = static_cast<int>(message.image.height);
    result.slice.mask = decode_mask(message.mask, message.image);
  } catch (const std::invalid_argument& error) {
    result.reason = svort::describe(info) + ": " + error.what();
    return result;
  }
  try {
    info.T_scanner_slice = from_msg(message.nominal_pose);
  } catch (const std::invalid_argument& error) {
    result.status = svort::ArrivalStatus::bad_geometry;
    result.reason = svort::describe(info) + ": nominal pose: " + error.what();
    return result;
  }
  result.ok = true;
  result.status = svort::ArrivalStatus::accepted;
  return result;
}

Slice to_msg(const svort::Slice& slice, const std::string& frame_id) {
  namespace encodings = sensor_msgs::image_encodings;
  const svort::SliceInfo& info = slice.info;
  Slice message;
  message.header = make_header(info.stamp_ns, frame_id);
  message.scan_id = info.scan_id;
  message.stack = info.stack;
  message.index = info.index;
  message.slices_in_stack = info.slices_in_stack;
  message.nominal_pose = to_pose_msg(info.T_scanner_slice);
  message.pixel_spacing_x = to_metres(info.pixel_spacing.x());
  message.pixel_spacing_y = to_metres(info.pixel_spacing.y());
  message.thickness = to_metres(info.thickness);

  const auto columns = static_cast<std::uint32_t>(info.columns);
  const auto rows = static_cast<std::uint32_t>(info.rows);
  sensor_msgs::Image& image = message.image;
  image.header = message.header;
  image.width = columns;
  image.height = rows;
  image.encoding = encodings::TYPE_32FC1;
  image.step = columns * static_cast<std::uint32_t>(sizeof(float));
  image.data.resize(slice.pixels.size() * sizeof(float));
  for (std::size_t i = 0; i < slice.pixels.size(); ++i)
    boost::endian::endian_store<float, sizeof(float), boost::endian::order::little>(&image.data[i * sizeof(float)],
                                                                                    slice.pixels[i]);
  if (!slice.mask.empty()) {
    sensor_msgs::Image& mask = message.mask;
    mask.header = message.header;
    mask.width = columns;
    mask.height = rows;
    mask.encoding = encodings::MONO8;
    mask.step = columns;
    mask.data = slice.mask;
  }
  return message;
}

std::uint8_t to_status_code(svort::ArrivalStatus status) {
  switch (status) {
    case svort::ArrivalStatus::accepted:
      return SliceStatus::ACCEPTED;
    case svort::ArrivalStatus::out_of_order:
      return SliceStatus::OUT_OF_ORDER;
    case svort::ArrivalStatus::late:
      return SliceStatus::LATE;
    case svort::ArrivalStatus::duplicate:
      return SliceStatus::DUPLICATE;
    case svort::ArrivalStatus::empty_mask:
      return SliceStatus::EMPTY_MASK;
    case svort::ArrivalStatus::bad_image:
      return SliceStatus::BAD_IMAGE;
    case svort::ArrivalStatus::bad_geometry:
      return SliceStatus::BAD_GEOMETRY;
    case svort::ArrivalStatus::inconsistent_stack:
      return SliceStatus::INCONSISTENT_STACK;
    case svort::ArrivalStatus::excess_slice:
      return SliceStatus::EXCESS_SLICE;
    case svort::ArrivalStatus::ended_scan:
      return SliceStatus::ENDED_SCAN;
  }
  throw std::logic_error("unknown ArrivalStatus");
}

SequenceEstimate to_msg(const svort::Estimate& estimate, const std::string& scanner_frame,
                        const std::string& brain_frame) {
  SequenceEstimate message;
  message.header = make_header(estimate.slices.empty() ? 0 : estimate.slices.back().info.stamp_ns, brain_frame);
  message.scan_id = estimate.scan_id;
  message.revision = estimate.revision;
  message.frame_revision = estimate.frame_revision;
  message.scanner_frame = scanner_frame;
  message.agreement = estimate.agreement;
  message.final = estimate.final;
  message.slices.reserve(estimate.slices.size());
  for (const svort::SliceEstimate& slice : estimate.slices) {
    SlicePose pose;
    pose.stack = slice.info.stack;
    pose.index = slice.info.index;
    pose.stamp = to_ros_time(slice.info.stamp_ns);
    pose.brain_from_slice = to_pose_msg(slice.T_brain_slice);
    pose.scanner_from_brain = to_pose_msg(slice.T_scanner_brain);
    pose.weight = static_cast<float>(slice.weight);
    pose.ncc = static_cast<float>(slice.ncc);
    pose.radius_95 = static_cast<float>(1e-3 * slice.radius_95_mm);
    switch (slice.status) {  // a new status must be given a code here
      case svort::PoseStatus::nominal:
        pose.status = SlicePose::NOMINAL;
        break;
      case svort::PoseStatus::network:
        pose.status = SlicePose::NETWORK;
        break;
      case svort::PoseStatus::predicted:
        pose.status = SlicePose::PREDICTED;
        break;
      case svort::PoseStatus::registered:
        pose.status = SlicePose::REGISTERED;
        break;
      case svort::PoseStatus::outlier:
        pose.status = SlicePose::OUTLIER;
        break;
    }
    message.slices.push_back(pose);
  }
  return message;
}

std::string slice_frame(const svort::SliceInfo& info) {
  return "slice_" + std::to_string(info.stack) + "_" + std::to_string(info.index);
}

namespace {

/// Box of voxels, upper end exclusive.
struct VoxelBox {
  Eigen::Vector3i lower = Eigen::Vector3i::Zero();
  Eigen::Vector3i upper = Eigen::Vector3i::Zero();
};

VoxelBox box_around_nonzero(const svort::Volume& volume) {
  const Eigen::Vector3i& size = volume.grid.size;
  VoxelBox box{size, Eigen::Vector3i::Zero()};
  for (int k = 0; k < size.z(); ++k)
    for (int j = 0; j < size.y(); ++j) {
      const float* row = &volume.values[volume.grid.offset(0, j, k)];
      for (int i = 0; i < size.x(); ++i) {
        if (row[i] == 0.F) continue;
        box.lower = box.lower.cwiseMin(Eigen::Vector3i(i, j, k));
        box.upper = box.upper.cwiseMax(Eigen::Vector3i(i + 1, j + 1, k + 1));
      }
    }
  if (box.upper == Eigen::Vector3i::Zero()) box.lower.setZero();
  return box;
}

void write_exact(const svort::Volume& volume, Volume* message) {
  message->encoding = Volume::FLOAT32;
  message->scale = 1.;
  message->offset = 0.;
  message->data.resize(volume.values.size() * sizeof(float));
  for (std::size_t i = 0; i < volume.values.size(); ++i)
    boost::endian::endian_store<float, sizeof(float), boost::endian::order::little>(&message->data[i * sizeof(float)],
                                                                                    volume.values[i]);
}

void write_compact(const svort::Volume& volume, const VoxelBox& box, Volume* message) {
  float smallest = std::numeric_limits<float>::infinity();
  float largest = -smallest;
  const auto for_each_voxel = [&](auto&& visit) {
    for (int k = box.lower.z(); k < box.upper.z(); ++k)
      for (int j = box.lower.y(); j < box.upper.y(); ++j)
        for (int i = box.lower.x(); i < box.upper.x(); ++i) visit(volume.values[volume.grid.offset(i, j, k)]);
  };
  for_each_voxel([&](float value) {
    if (!std::isfinite(value)) throw std::invalid_argument("a volume with NaN or infinity has no compact form");
    smallest = std::min(smallest, value);
    largest = std::max(largest, value);
  });
  const double range = largest > smallest ? static_cast<double>(largest) - static_cast<double>(smallest) : 0.;
  message->encoding = Volume::UINT16;
  message->offset = box.upper == box.lower ? 0. : static_cast<double>(smallest);
  message->scale = range > 0. ? range / 65535. : 1.;
  message->data.reserve(2 * std::size_t{message->size_x} * message->size_y * message->size_z);
  for_each_voxel([&](float value) {
    const double stored = std::round((static_cast<double>(value) - message->offset) / message->scale);
    const auto code = static_cast<unsigned>(std::clamp(stored, 0., 65535.));
    message->data.push_back(static_cast<std::uint8_t>(code & 0xFFU));
    message->data.push_back(static_cast<std::uint8_t>(code >> 8U));
  });
}

}  // namespace

Volume to_msg(const svort::Volume& volume, VolumeEncoding encoding, const svort::Estimate& estimate,
              const std::string& brain_frame) {
  const svort::ImageGrid& grid = volume.grid;
  if (!(grid.spacing.array() == grid.spacing.x()).all())
    throw std::invalid_argument("a Volume message holds cubic voxels only");
  if (volume.values.size() != grid.voxel_count()) throw std::invalid_argument("a volume's values do not fill its grid");

  const VoxelBox box =
      encoding == VolumeEncoding::exact ? VoxelBox{Eigen::Vector3i::Zero(), grid.size} : box_around_nonzero(volume);
  const Eigen::Vector3i size = box.upper - box.lower;
  svort::Pose T_frame_box = grid.T_frame_grid;
  T_frame_box.translation() = grid.position(0.5 * (box.lower + box.upper - Eigen::Vector3i::Ones()).cast<double>());

  Volume message;
  message.header = make_header(estimate.slices.empty() ? 0 : estimate.slices.back().info.stamp_ns, brain_frame);
  message.scan_id = estimate.scan_id;
  message.revision = estimate.revision;
  message.final = estimate.final;
  message.size_x = static_cast<std::uint32_t>(size.x());
  message.size_y = static_cast<std::uint32_t>(size.y());
  message.size_z = static_cast<std::uint32_t>(size.z());
  message.spacing = to_metres(grid.spacing.x());
  message.origin = to_pose_msg(encoding == VolumeEncoding::exact ? grid.T_frame_grid : T_frame_box);
  if (encoding == VolumeEncoding::exact)
    write_exact(volume, &message);
  else
    write_compact(volume, box, &message);
  return message;
}

svort::Volume from_msg(const Volume& message) {
  std::size_t bytes_per_voxel = 0;
  if (message.encoding == Volume::FLOAT32)
    bytes_per_voxel = sizeof(float);
  else if (message.encoding == Volume::UINT16)
    bytes_per_voxel = sizeof(std::uint16_t);
  else
    throw std::invalid_argument("volume encoding " + std::to_string(message.encoding) + " is unknown");
  if (std::max({message.size_x, message.size_y, message.size_z}) > kLargestImage)
    throw std::invalid_argument("a volume has at most " + std::to_string(kLargestImage) + " voxels along an axis");
  const std::uint64_t count = std::uint64_t{message.size_x} * message.size_y * message.size_z;
  if (message.data.size() / bytes_per_voxel != count || message.data.size() % bytes_per_voxel != 0)
    throw std::invalid_argument("a volume of " + std::to_string(count) + " voxels came with " +
                                std::to_string(message.data.size()) + " bytes");
  if (!(message.spacing > 0.) || !std::isfinite(message.spacing))
    throw std::invalid_argument("volume spacing is " + std::to_string(message.spacing) + " m; it must be positive");

  svort::Volume volume;
  volume.grid.size = Eigen::Matrix<std::uint32_t, 3, 1>(message.size_x, message.size_y, message.size_z).cast<int>();
  volume.grid.spacing.setConstant(to_millimetres(message.spacing));
  volume.grid.T_frame_grid = from_msg(message.origin);
  volume.values.reserve(static_cast<std::size_t>(count));
  const std::uint8_t* bytes = message.data.data();
  for (std::uint64_t i = 0; i < count; ++i, bytes += bytes_per_voxel)
    volume.values.push_back(
        message.encoding == Volume::FLOAT32
            ? load<float>(bytes, false)
            : static_cast<float>(message.offset + message.scale * load<std::uint16_t>(bytes, false)));
  return volume;
}

svort::Arrival rejection(const SliceFromMessage& decoded) {
  svort::Arrival arrival;
  arrival.status = decoded.status;
  arrival.reason = decoded.reason;
  return arrival;
}

double reference_intensity(const svort::Volume& volume) {
  if (volume.values.empty()) return 0.;
  const float floor = 1e-3F * *std::max_element(volume.values.begin(), volume.values.end());
  if (!(floor > 0.F)) return 0.;
  std::vector<float> tissue;
  std::copy_if(volume.values.begin(), volume.values.end(), std::back_inserter(tissue),
               [floor](float value) { return value > floor; });
  const auto rank = static_cast<std::ptrdiff_t>(0.99 * static_cast<double>(tissue.size() - 1));
  std::nth_element(tissue.begin(), tissue.begin() + rank, tissue.end());
  return static_cast<double>(tissue[static_cast<std::size_t>(rank)]);
}

svort::Volume coarsen(const svort::Volume& volume, int factor) {
  if (factor < 1) throw std::invalid_argument("coarsen: factor is " + std::to_string(factor) + "; it must be >= 1");
  if (factor == 1) return volume;
  svort::Volume coarse;
  coarse.grid.size = volume.grid.size / factor;
  coarse.grid.spacing = volume.grid.spacing * factor;
  coarse.grid.T_frame_grid = volume.grid.T_frame_grid;
  // The blocks start at voxel 0, so their middle is not the old middle if voxels are left over.
  coarse.grid.T_frame_grid.translation() =
      volume.grid.position(0.5 * (coarse.grid.size * factor - Eigen::Vector3i::Ones()).cast<double>());
  coarse.values.reserve(coarse.grid.voxel_count());
  const float share = 1.F / static_cast<float>(factor * factor * factor);
  for (int k = 0; k < coarse.grid.size.z(); ++k)
    for (int j = 0; j < coarse.grid.size.y(); ++j)
      for (int i = 0; i < coarse.grid.size.x(); ++i) {
        float sum = 0.F;
        for (int dk = 0; dk < factor; ++dk)
          for (int dj = 0; dj < factor; ++dj)
            for (int di = 0; di < factor; ++di)
              sum += volume.values[volume.grid.offset(i * factor + di, j * factor + dj, k * factor + dk)];
        coarse.values.push_back(sum * share);
      }
  return coarse;
}

sensor_msgs::PointCloud2 to_cloud(const svort::Volume& volume, double threshold, const std_msgs::Header& header) {
  const auto limit = static_cast<float>(threshold * reference_intensity(volume));
  const auto is_shown = [limit](float value) { return value > limit && value > 0.F; };

  sensor_msgs::PointCloud2 cloud;
  cloud.header = header;
  cloud.is_dense = true;
  sensor_msgs::PointCloud2Modifier modifier(cloud);
  modifier.setPointCloud2Fields(4, "x", 1, sensor_msgs::PointField::FLOAT32, "y", 1, sensor_msgs::PointField::FLOAT32,
                                "z", 1, sensor_msgs::PointField::FLOAT32, "intensity", 1,
                                sensor_msgs::PointField::FLOAT32);
  modifier.resize(static_cast<std::size_t>(std::count_if(volume.values.begin(), volume.values.end(), is_shown)));
  if (cloud.data.empty()) return cloud;  // an iterator needs a first point
  sensor_msgs::PointCloud2Iterator<float> point(cloud, "x");
  const Eigen::Vector3i& size = volume.grid.size;
  for (int k = 0; k < size.z(); ++k)
    for (int j = 0; j < size.y(); ++j)
      for (int i = 0; i < size.x(); ++i) {
        const float value = volume.values[volume.grid.offset(i, j, k)];
        if (!is_shown(value)) continue;
        const Eigen::Vector3d position = volume.grid.position({double(i), double(j), double(k)});
        for (int axis = 0; axis < 3; ++axis) point[axis] = static_cast<float>(to_metres(position[axis]));
        point[3] = value;
        ++point;
      }
  return cloud;
}

namespace {

std_msgs::ColorRGBA colour(float red, float green, float blue, float alpha = 1.F) {
  std_msgs::ColorRGBA rgba;
  rgba.r = red;
  rgba.g = green;
  rgba.b = blue;
  rgba.a = alpha;
  return rgba;
}

geometry_msgs::Point to_point_msg(const Eigen::Vector3d& position_mm) {
  geometry_msgs::Point point;
  point.x = to_metres(position_mm.x());
  point.y = to_metres(position_mm.y());
  point.z = to_metres(position_mm.z());
  return point;
}

visualization_msgs::Marker make_marker(const std_msgs::Header& header, const std::string& ns, int type,
                                       double scale_mm) {
  visualization_msgs::Marker marker;
  marker.header = header;
  marker.ns = ns;
  marker.type = type;
  marker.action = visualization_msgs::Marker::ADD;
  marker.pose.orientation.w = 1.;
  marker.scale.x = to_metres(scale_mm);
  marker.color = colour(1.F, 1.F, 1.F);
  return marker;
}

/// The part of a slice that is worth a frame: its brain with a margin, or the whole image if nothing was prepared.
struct SliceFrame {
  svort::Pose T_brain_frame = svort::Pose::Identity();
  Eigen::AlignedBox2d box;  ///< mm, in the plane z = 0
};
SliceFrame frame_of(const svort::SliceEstimate& slice, const SliceImage& image) {
  constexpr double kMargin = 8.;  // mm
  SliceFrame frame;
  if (!image.slice) {
    const Eigen::Vector2d size(slice.info.columns, slice.info.rows);
    const Eigen::Vector2d half = 0.5 * slice.info.pixel_spacing.cwiseProduct(size);
    frame.T_brain_frame = slice.T_brain_slice;
    frame.box = Eigen::AlignedBox2d(-half, half);
    return frame;
  }
  const svort::PreparedSlice& prepared = *image.slice;
  const double middle = 0.5 * (prepared.size - 1);
  frame.T_brain_frame = slice.T_brain_slice * prepared.T_slice_crop;
  for (int row = 0; row < prepared.size; ++row)
    for (int column = 0; column < prepared.size; ++column)
      if (prepared.mask[static_cast<std::size_t>(row * prepared.size + column)])
        frame.box.extend(prepared.resolution * Eigen::Vector2d(column - middle, row - middle));
  frame.box.extend(Eigen::Vector2d(frame.box.min().array() - kMargin));
  frame.box.extend(Eigen::Vector2d(frame.box.max().array() + kMargin));
  return frame;
}

visualization_msgs::Marker outline_marker(const SliceFrame& frame, const std_msgs::Header& header) {
  visualization_msgs::Marker marker = make_marker(header, "outline", visualization_msgs::Marker::LINE_STRIP, 0.7);
  marker.color = colour(1.F, 0.75F, 0.1F);
  using Box = Eigen::AlignedBox2d;
  for (const auto corner : {Box::BottomLeft, Box::BottomRight, Box::TopRight, Box::TopLeft, Box::BottomLeft}) {
    const Eigen::Vector2d p = frame.box.corner(corner);
    marker.points.push_back(to_point_msg(frame.T_brain_frame * Eigen::Vector3d(p.x(), p.y(), 0.)));
  }
  return marker;
}

/// "stack 1, slice 4" above the frame's highest corner.
visualization_msgs::Marker label_marker(const svort::SliceEstimate& slice, const SliceFrame& frame,
                                        const std_msgs::Header& header) {
  constexpr double kHeight = 6.;  // mm
  visualization_msgs::Marker marker = make_marker(header, "label", visualization_msgs::Marker::TEXT_VIEW_FACING, 0.);
  marker.color = colour(1.F, 0.75F, 0.1F);
  marker.scale.z = to_metres(kHeight);
  marker.text = "stack " + std::to_string(slice.info.stack) + ", slice " + std::to_string(slice.info.index);
  using Box = Eigen::AlignedBox2d;
  Eigen::Vector3d highest(0., 0., -std::numeric_limits<double>::infinity());
  for (const auto corner : {Box::BottomLeft, Box::BottomRight, Box::TopRight, Box::TopLeft}) {
    const Eigen::Vector2d p = frame.box.corner(corner);
    const Eigen::Vector3d position = frame.T_brain_frame * Eigen::Vector3d(p.x(), p.y(), 0.);
    if (position.z() > highest.z()) highest = position;
  }
  marker.pose.position = to_point_msg(highest + Eigen::Vector3d(0., 0., kHeight));
  return marker;
}

visualization_msgs::Marker axes_marker(const svort::SliceEstimate& slice, const std_msgs::Header& header) {
  constexpr double kLength = 20.;  // mm
  visualization_msgs::Marker marker = make_marker(header, "axes", visualization_msgs::Marker::LINE_LIST, 1.);
  for (int axis = 0; axis < 3; ++axis) {
    marker.points.push_back(to_point_msg(slice.T_brain_slice.translation()));
    marker.points.push_back(to_point_msg(slice.T_brain_slice * (kLength * Eigen::Vector3d::Unit(axis))));
    marker.colors.insert(marker.colors.end(), 2,
                         colour(axis == 0 ? 1.F : 0.F, axis == 1 ? 1.F : 0.F, axis == 2 ? 1.F : 0.F));
  }
  return marker;
}

/// Two triangles between the centres of every four neighbouring brain pixels.
visualization_msgs::Marker plane_marker(const svort::SliceEstimate& slice, const SliceImage& image,
                                        const std_msgs::Header& header) {
  visualization_msgs::Marker marker = make_marker(header, "plane", visualization_msgs::Marker::TRIANGLE_LIST, 1000.);
  marker.scale.y = marker.scale.z = marker.scale.x;  // 1: points are in metres already
  const svort::PreparedSlice& prepared = *image.slice;
  const svort::Pose T_brain_crop = slice.T_brain_slice * prepared.T_slice_crop;
  const int size = prepared.size;
  const auto offset = [size](int column, int row) { return static_cast<std::size_t>(row * size + column); };
  const auto add_vertex = [&](int column, int row) {
    const double middle = 0.5 * (size - 1);
    marker.points.push_back(
        to_point_msg(T_brain_crop * (prepared.resolution * Eigen::Vector3d(column - middle, row - middle, 0.))));
    const double grey = static_cast<double>(prepared.pixels[offset(column, row)]) / image.intensity_scale;
    const auto shade = static_cast<float>(std::clamp(grey, 0., 1.));
    marker.colors.push_back(colour(shade, shade, shade));
  };
  for (int row = 0; row + 1 < size; ++row)
    for (int column = 0; column + 1 < size; ++column) {
      if (!prepared.mask[offset(column, row)] || !prepared.mask[offset(column + 1, row)] ||
          !prepared.mask[offset(column, row + 1)] || !prepared.mask[offset(column + 1, row + 1)])
        continue;
      for (const auto& [dx, dy] : {std::pair{0, 0}, {1, 0}, {1, 1}, {0, 0}, {1, 1}, {0, 1}})
        add_vertex(column + dx, row + dy);
    }
  if (marker.points.empty()) marker.action = visualization_msgs::Marker::DELETE;
  return marker;
}

}  // namespace

visualization_msgs::MarkerArray to_slice_markers(const svort::SliceEstimate& slice, const SliceImage& image,
                                                 const std_msgs::Header& header) {
  visualization_msgs::MarkerArray markers;
  const SliceFrame frame = frame_of(slice, image);
  markers.markers.push_back(outline_marker(frame, header));
  markers.markers.push_back(axes_marker(slice, header));
  markers.markers.push_back(label_marker(slice, frame, header));
  if (image.slice) markers.markers.push_back(plane_marker(slice, image, header));
  return markers;
}

}  // namespace svort_ros
