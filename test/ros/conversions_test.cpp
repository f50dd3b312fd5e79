#include "svort_ros/ros/conversions.h"

#include <gtest/gtest.h>
#include <sensor_msgs/image_encodings.h>
#include <sensor_msgs/point_cloud2_iterator.h>

#include <algorithm>
#include <cmath>
#include <cstring>
#include <limits>
#include <vector>

#include "ros/synthetic_scan.h"

namespace svort_ros {
namespace {

svort::Pose some_pose() {
  svort::Pose pose = svort::Pose::Identity();
  pose.linear() = Eigen::AngleAxisd(1.1, Eigen::Vector3d(1., -2., .5).normalized()).toRotationMatrix();
  pose.translation() = Eigen::Vector3d(12.5, -340.25, 7.125);
  return pose;
}

svort::Slice some_slice() { return svort_test::synthetic_scan().at(3); }

/// Bytes of the values in the wanted order, rows of `step` bytes whose padding is full of a value that would show.
template <class Stored>
sensor_msgs::Image make_image(const std::vector<Stored>& values, std::uint32_t width, const std::string& encoding,
                              bool big_endian, std::uint32_t padding) {
  sensor_msgs::Image image;
  image.width = width;
  image.height = static_cast<std::uint32_t>(values.size()) / width;
  image.encoding = encoding;
  image.is_bigendian = static_cast<std::uint8_t>(big_endian);
  image.step = width * static_cast<std::uint32_t>(sizeof(Stored)) + padding;
  for (std::size_t i = 0; i < values.size(); ++i) {
    std::uint8_t bytes[sizeof(Stored)];
    std::memcpy(bytes, &values[i], sizeof(Stored));  // this machine is little-endian
    if (big_endian) std::reverse(std::begin(bytes), std::end(bytes));
    image.data.insert(image.data.end(), std::begin(bytes), std::end(bytes));
    if ((i + 1) % width == 0) image.data.insert(image.data.end(), padding, 0xAB);
  }
  return image;
}

Slice message_with(const sensor_msgs::Image& image) {
  Slice message = to_msg(some_slice(), "scanner");
  message.image = image;
  message.mask = sensor_msgs::Image();
  return message;
}

TEST(PoseConversion, IsInMetresAndComesBack) {
  const geometry_msgs::Pose message = to_pose_msg(some_pose());
  EXPECT_DOUBLE_EQ(message.position.x, 0.0125);
  EXPECT_DOUBLE_EQ(message.position.y, -0.34025);
  EXPECT_TRUE(from_msg(message).isApprox(some_pose(), 1e-14));

  const geometry_msgs::Transform transform = to_transform_msg(some_pose());
  EXPECT_DOUBLE_EQ(transform.translation.z, 0.007125);
  EXPECT_DOUBLE_EQ(transform.rotation.w, message.orientation.w);
}

TEST(PoseConversion, RejectsWhatIsNoPose) {
  geometry_msgs::Pose message = to_pose_msg(some_pose());
  message.orientation.w += 0.1;
  EXPECT_THROW(from_msg(message), std::invalid_argument);
  message.orientation = geometry_msgs::Quaternion();  // all zero, as left by a forgetful sender
  EXPECT_THROW(from_msg(message), std::invalid_argument);
  message = to_pose_msg(some_pose());
  message.orientation.x = std::numeric_limits<double>::quiet_NaN();
  EXPECT_THROW(from_msg(message), std::invalid_argument);
  message = to_pose_msg(some_pose());
  message.position.y = std::numeric_limits<double>::infinity();
  EXPECT_THROW(from_msg(message), std::invalid_argument);
}

TEST(PoseConversion, NormalisesASlightlyRoundedQuaternion) {
  geometry_msgs::Pose message = to_pose_msg(some_pose());
  message.orientation.w *= 1.0005;
  message.orientation.x *= 1.0005;
  message.orientation.y *= 1.0005;
  message.orientation.z *= 1.0005;
  EXPECT_TRUE(from_msg(message).isApprox(some_pose(), 1e-12));
}

TEST(TimeConversion, IsExact) {
  const std::int64_t stamp_ns = 1'712'345'678'987'654'321;
  EXPECT_EQ(static_cast<std::int64_t>(to_ros_time(stamp_ns).toNSec()), stamp_ns);
  EXPECT_THROW(to_ros_time(-1), std::invalid_argument);
  EXPECT_THROW(to_ros_time(5'000'000'000'000'000'000), std::invalid_argument);
}

TEST(SliceConversion, ComesBackExactly) {
  const svort::Slice slice = some_slice();
  const SliceFromMessage back = from_msg(to_msg(slice, "scanner"));
  ASSERT_TRUE(back.ok) << back.reason;
  EXPECT_EQ(back.slice.pixels, slice.pixels);
  EXPECT_EQ(back.slice.mask, slice.mask);
  const svort::SliceInfo& info = back.slice.info;
  EXPECT_EQ(info.scan_id, slice.info.scan_id);
  EXPECT_EQ(info.stack, slice.info.stack);
  EXPECT_EQ(info.index, slice.info.index);
  EXPECT_EQ(info.slices_in_stack, slice.info.slices_in_stack);
  EXPECT_EQ(info.stamp_ns, slice.info.stamp_ns);
  EXPECT_EQ(info.columns, slice.info.columns);
  EXPECT_EQ(info.rows, slice.info.rows);
  EXPECT_DOUBLE_EQ(info.thickness, slice.info.thickness);
  EXPECT_DOUBLE_EQ(info.pixel_spacing.x(), slice.info.pixel_spacing.x());
  EXPECT_TRUE(info.T_scanner_slice.isApprox(slice.info.T_scanner_slice, 1e-14));
}

TEST(SliceConversion, SliceWithoutMaskHasNone) {
  svort::Slice slice = some_slice();
  slice.mask.clear();
  const SliceFromMessage back = from_msg(to_msg(slice, "scanner"));
  ASSERT_TRUE(back.ok) << back.reason;
  EXPECT_TRUE(back.slice.mask.empty());
}

template <class Stored>
void expect_decoded(const std::vector<Stored>& values, const std::string& encoding) {
  for (const bool big_endian : {false, true})
    for (const std::uint32_t padding : {0U, 5U}) {
      const SliceFromMessage decoded = from_msg(message_with(make_image(values, 3, encoding, big_endian, padding)));
      ASSERT_TRUE(decoded.ok) << decoded.reason;
      EXPECT_EQ(decoded.slice.pixels, std::vector<float>(values.begin(), values.end()))
          << encoding << (big_endian ? " big-endian" : " little-endian") << ", padding " << padding;
      EXPECT_EQ(decoded.slice.info.columns, 3);
      EXPECT_EQ(decoded.slice.info.rows, 2);
    }
}

TEST(ImageDecoding, EveryEncodingInEitherByteOrderWithPaddedRows) {
  expect_decoded<float>({0.F, 1.5F, -3.25F, 1e-20F, 6.5e4F, -1.F}, "32FC1");
  expect_decoded<double>({0., 1.5, -3.25, 1024.125, 65000., -1.}, "64FC1");
  expect_decoded<std::uint16_t>({0, 1, 256, 40000, 65535, 258}, "16UC1");
  expect_decoded<std::uint16_t>({0, 1, 256, 40000, 65535, 258}, "mono16");
  expect_decoded<std::int16_t>({0, 1, -1, 32767, -32768, 258}, "16SC1");
  expect_decoded<std::uint8_t>({0, 1, 2, 127, 128, 255}, "8UC1");
  expect_decoded<std::uint8_t>({0, 1, 2, 127, 128, 255}, "mono8");
}

TEST(ImageDecoding, SaysWhatIsWrongWithAnImage) {
  const std::vector<std::uint16_t> values{1, 2, 3, 4, 5, 6};
  const sensor_msgs::Image good = make_image(values, 3, "16UC1", false, 2);
  ASSERT_TRUE(from_msg(message_with(good)).ok);
  const auto expect_bad = [](const sensor_msgs::Image& image, const std::string& word) {
    const SliceFromMessage decoded = from_msg(message_with(image));
    EXPECT_FALSE(decoded.ok);
    EXPECT_EQ(decoded.status, svort::ArrivalStatus::bad_image);
    EXPECT_NE(decoded.reason.find(word), std::string::npos) << decoded.reason;
    EXPECT_NE(decoded.reason.find("stack 0 slice 6"), std::string::npos) << decoded.reason;
    EXPECT_EQ(decoded.slice.info.index, 6);  // so that the answer can name the slice
  };
  sensor_msgs::Image image = good;
  image.data.pop_back();  // truncated
  expect_bad(image, "15 bytes");
  image = good;
  image.data.push_back(0);
  expect_bad(image, "17 bytes");
  image = good;
  image.step = 5;  // rows overlap
  image.data.resize(10);
  expect_bad(image, "rows of 5 bytes");
  image = good;
  image.width = 0;
  expect_bad(image, "0 x 2");
  image = good;
  image.width = image.height = image.step = std::numeric_limits<std::uint32_t>::max();  // products overflow
  expect_bad(image, "4294967295");
  image = good;
  image.encoding = "rgb8";
  expect_bad(image, "'rgb8'");
  image = good;
  image.data.clear();
  expect_bad(image, "0 bytes");
}

TEST(ImageDecoding, SaysWhatIsWrongWithAMask) {
  const auto expect_bad = [](const Slice& message, const std::string& word) {
    const SliceFromMessage decoded = from_msg(message);
    EXPECT_FALSE(decoded.ok);
    EXPECT_EQ(decoded.status, svort::ArrivalStatus::bad_image);
    EXPECT_NE(decoded.reason.find(word), std::string::npos) << decoded.reason;
  };
  const Slice good = to_msg(some_slice(), "scanner");
  Slice message = good;
  message.mask.encoding = "16UC1";
  expect_bad(message, "mask encoding");
  message = good;
  message.mask.height -= 1;
  expect_bad(message, "48 x 47");
  message = good;
  message.mask.data.pop_back();
  expect_bad(message, "mask holds");
}

TEST(SliceConversion, NonUnitQuaternionIsBadGeometry) {
  Slice message = to_msg(some_slice(), "scanner");
  message.nominal_pose.orientation.w = 3.;
  const SliceFromMessage decoded = from_msg(message);
  EXPECT_FALSE(decoded.ok);
  EXPECT_EQ(decoded.status, svort::ArrivalStatus::bad_geometry);
  EXPECT_NE(decoded.reason.find("quaternion"), std::string::npos) << decoded.reason;
}

svort::Volume some_volume() {
  svort::Volume volume;
  volume.grid.size = {7, 9, 8};
  volume.grid.spacing.setConstant(2.);
  volume.grid.T_frame_grid = some_pose();
  volume.values.assign(volume.grid.voxel_count(), 0.F);
  for (int k = 2; k < 7; ++k)
    for (int j = 1; j < 6; ++j)
      for (int i = 3; i < 6; ++i)
        volume.values[volume.grid.offset(i, j, k)] = 100.F + 7.3F * static_cast<float>(i * j) - static_cast<float>(k);
  return volume;
}

TEST(VolumeConversion, ExactFormComesBackExactly) {
  svort::Estimate estimate;
  estimate.scan_id = "x";
  estimate.revision = 17;
  estimate.slices.resize(2);
  estimate.slices.back().info.stamp_ns = 1'500'000'000;
  const svort::Volume volume = some_volume();
  const Volume message = to_msg(volume, VolumeEncoding::exact, estimate, "fetal_brain");
  EXPECT_EQ(message.revision, 17U);
  EXPECT_EQ(message.header.frame_id, "fetal_brain");
  EXPECT_EQ(message.header.stamp, ros::Time(1, 500'000'000));
  EXPECT_DOUBLE_EQ(message.spacing, 0.002);
  const svort::Volume back = from_msg(message);
  EXPECT_EQ(back.values, volume.values);
  EXPECT_EQ(back.grid.size, volume.grid.size);
  EXPECT_TRUE(back.grid.T_frame_grid.isApprox(volume.grid.T_frame_grid, 1e-14));
}

TEST(VolumeConversion, CompactFormIsCroppedAndWithinItsBound) {
  const svort::Volume volume = some_volume();
  const Volume message = to_msg(volume, VolumeEncoding::compact, svort::Estimate(), "fetal_brain");
  EXPECT_EQ(message.size_x, 3U);
  EXPECT_EQ(message.size_y, 5U);
  EXPECT_EQ(message.size_z, 5U);
  EXPECT_EQ(message.data.size(), 2U * 3U * 5U * 5U);
  const svort::Volume back = from_msg(message);
  double largest_error = 0.;
  std::size_t nonzero = 0;
  for (int k = 0; k < back.grid.size.z(); ++k)
    for (int j = 0; j < back.grid.size.y(); ++j)
      for (int i = 0; i < back.grid.size.x(); ++i) {
        // The same place in the brain must hold the same value.
        const Eigen::Vector3d index = volume.grid.index(back.grid.position({double(i), double(j), double(k)}));
        const Eigen::Vector3i voxel = index.array().round().cast<int>();
        ASSERT_LT((index - voxel.cast<double>()).norm(), 1e-9);
        const float truth = volume.values[volume.grid.offset(voxel.x(), voxel.y(), voxel.z())];
        const double error = std::abs(double(back.values[back.grid.offset(i, j, k)]) - double(truth));
        largest_error = std::max(largest_error, error);
        nonzero += truth != 0.F;
      }
  EXPECT_EQ(nonzero, 3U * 5U * 5U);
  // Half a step, and the rounding of the result to float32.
  EXPECT_LE(largest_error, 0.5 * message.scale + 4e-5);
  EXPECT_GT(message.scale, 0.);
}

TEST(VolumeConversion, CompactFormOfNothingAndOfAConstant) {
  svort::Volume volume = some_volume();
  std::fill(volume.values.begin(), volume.values.end(), 0.F);
  Volume message = to_msg(volume, VolumeEncoding::compact, svort::Estimate(), "b");
  EXPECT_EQ(message.size_x, 0U);
  EXPECT_TRUE(message.data.empty());
  EXPECT_TRUE(from_msg(message).empty());
  std::fill(volume.values.begin(), volume.values.end(), 3.5F);
  message = to_msg(volume, VolumeEncoding::compact, svort::Estimate(), "b");
  EXPECT_EQ(from_msg(message).values, volume.values);
  volume.values[5] = std::numeric_limits<float>::quiet_NaN();
  EXPECT_THROW(to_msg(volume, VolumeEncoding::compact, svort::Estimate(), "b"), std::invalid_argument);
  volume.grid.spacing.x() = 1.;
  EXPECT_THROW(to_msg(volume, VolumeEncoding::exact, svort::Estimate(), "b"), std::invalid_argument);
}

TEST(VolumeConversion, RejectsMessagesThatDoNotFit) {
  const Volume good = to_msg(some_volume(), VolumeEncoding::exact, svort::Estimate(), "b");
  Volume message = good;
  message.data.pop_back();
  EXPECT_THROW(from_msg(message), std::invalid_argument);
  message = good;
  message.size_x = message.size_y = message.size_z = 3'000'000'000U;
  EXPECT_THROW(from_msg(message), std::invalid_argument);
  message = good;
  message.encoding = 7;
  EXPECT_THROW(from_msg(message), std::invalid_argument);
  message = good;
  message.spacing = 0.;
  EXPECT_THROW(from_msg(message), std::invalid_argument);
}

TEST(EstimateConversion, KeepsPosesOrderAndNcc) {
  svort::Estimate estimate;
  estimate.scan_id = "s";
  estimate.revision = 4;
  estimate.frame_revision = 1;
  estimate.final = true;
  for (int i = 0; i < 3; ++i) {
    svort::SliceEstimate slice;
    slice.info.stack = 1;
    slice.info.index = 2 * i;
    slice.info.stamp_ns = 1'000'000'000 + i;
    slice.T_brain_slice = some_pose();
    slice.T_brain_slice.translation().x() += i;
    slice.T_scanner_brain = some_pose().inverse();
    slice.weight = 0.5;
    slice.ncc = i == 0 ? std::numeric_limits<double>::quiet_NaN() : 0.75;
    if (i == 1) slice.radius_95_mm = 1.5;
    estimate.slices.push_back(slice);
  }
  const SequenceEstimate message = to_msg(estimate, "scanner", "fetal_brain");
  EXPECT_EQ(message.revision, 4U);
  EXPECT_EQ(message.frame_revision, 1U);
  EXPECT_TRUE(message.final);
  EXPECT_EQ(message.scanner_frame, "scanner");
  EXPECT_EQ(message.header.stamp, ros::Time(1, 2));
  ASSERT_EQ(message.slices.size(), 3U);
  EXPECT_TRUE(std::isnan(message.slices[0].ncc));
  EXPECT_FLOAT_EQ(message.slices[1].ncc, 0.75F);
  EXPECT_TRUE(std::isnan(message.slices[0].radius_95));
  EXPECT_FLOAT_EQ(message.slices[1].radius_95, 0.0015F);
  EXPECT_FLOAT_EQ(message.slices[1].weight, 0.5F);
  EXPECT_EQ(message.slices[2].index, 4);
  EXPECT_EQ(message.slices[2].status, SlicePose::NOMINAL);
  EXPECT_TRUE(from_msg(message.slices[2].brain_from_slice).isApprox(estimate.slices[2].T_brain_slice, 1e-14));
  EXPECT_TRUE(from_msg(message.slices[2].scanner_from_brain).isApprox(some_pose().inverse(), 1e-14));
}

TEST(StatusConversion, EveryStatusHasItsCode) {
  using svort::ArrivalStatus;
  EXPECT_EQ(to_status_code(ArrivalStatus::accepted), SliceStatus::ACCEPTED);
  EXPECT_EQ(to_status_code(ArrivalStatus::out_of_order), SliceStatus::OUT_OF_ORDER);
  EXPECT_EQ(to_status_code(ArrivalStatus::late), SliceStatus::LATE);
  EXPECT_EQ(to_status_code(ArrivalStatus::duplicate), SliceStatus::DUPLICATE);
  EXPECT_EQ(to_status_code(ArrivalStatus::empty_mask), SliceStatus::EMPTY_MASK);
  EXPECT_EQ(to_status_code(ArrivalStatus::bad_image), SliceStatus::BAD_IMAGE);
  EXPECT_EQ(to_status_code(ArrivalStatus::bad_geometry), SliceStatus::BAD_GEOMETRY);
  EXPECT_EQ(to_status_code(ArrivalStatus::inconsistent_stack), SliceStatus::INCONSISTENT_STACK);
  EXPECT_EQ(to_status_code(ArrivalStatus::excess_slice), SliceStatus::EXCESS_SLICE);
  EXPECT_EQ(to_status_code(ArrivalStatus::ended_scan), SliceStatus::ENDED_SCAN);
}

/// A ball, smooth at its edge: 100 inside, 0 outside, 50 at `radius_mm`.
svort::Volume ball(double radius_mm) {
  svort::Volume volume;
  volume.grid.size = {40, 41, 42};
  volume.grid.spacing.setConstant(1.5);
  volume.grid.T_frame_grid = some_pose();
  for (int k = 0; k < 42; ++k)
    for (int j = 0; j < 41; ++j)
      for (int i = 0; i < 40; ++i) {
        const double r = (volume.grid.position({double(i), double(j), double(k)}) - some_pose().translation()).norm();
        volume.values.push_back(static_cast<float>(100. * std::clamp(0.5 - (r - radius_mm) / 6., 0., 1.)));
      }
  return volume;
}

TEST(Surface, LiesWhereTheIntensityCrossesTheThreshold) {
  const visualization_msgs::Marker marker = to_surface(ball(20.), 0.5, std_msgs::Header());
  EXPECT_EQ(marker.action, visualization_msgs::Marker::ADD);
  ASSERT_GT(marker.points.size(), 1000U);
  EXPECT_EQ(marker.points.size() % 3, 0U);
  double area = 0.;
  for (std::size_t i = 0; i < marker.points.size(); i += 3) {
    Eigen::Vector3d corners[3];
    for (std::size_t c = 0; c < 3; ++c) {
      const geometry_msgs::Point& point = marker.points[i + c];
      corners[c] = 1000. * Eigen::Vector3d(point.x, point.y, point.z) - some_pose().translation();
      EXPECT_NEAR(corners[c].norm(), 20., 0.1);  // the edge is linear in r, voxels are not
    }
    area += 0.5 * (corners[1] - corners[0]).cross(corners[2] - corners[0]).norm();
  }
  EXPECT_NEAR(area, 4. * M_PI * 400., 0.02 * 4. * M_PI * 400.);  // closed, each triangle once
}

TEST(Surface, OfNothingDeletesTheLastOne) {
  svort::Volume volume = ball(20.);
  std::fill(volume.values.begin(), volume.values.end(), 0.F);
  const visualization_msgs::Marker marker = to_surface(volume, 0.5, std_msgs::Header());
  EXPECT_EQ(marker.action, visualization_msgs::Marker::DELETE);
  EXPECT_EQ(to_surface(svort::Volume(), 0.5, std_msgs::Header()).action, visualization_msgs::Marker::DELETE);
}

TEST(Coarsen, KeepsPlacesAndMeans) {
  const svort::Volume fine = ball(20.);
  EXPECT_EQ(coarsen(fine, 1).values, fine.values);
  const svort::Volume coarse = coarsen(fine, 3);
  EXPECT_EQ(coarse.grid.size, Eigen::Vector3i(13, 13, 14));
  // The middle of block (4, 5, 6) is the fine voxel (13, 16, 19).
  EXPECT_TRUE(coarse.grid.position({4., 5., 6.}).isApprox(fine.grid.position({13., 16., 19.}), 1e-12));
  double sum = 0.;
  for (int k = 18; k < 21; ++k)
    for (int j = 15; j < 18; ++j)
      for (int i = 12; i < 15; ++i) sum += double(fine.values[fine.grid.offset(i, j, k)]);
  EXPECT_NEAR(double(coarse.values[coarse.grid.offset(4, 5, 6)]), sum / 27., 1e-4);
  EXPECT_THROW(coarsen(fine, 0), std::invalid_argument);
}

TEST(Cloud, HoldsTheVoxelsAboveTheThresholdInMetres) {
  const svort::Volume volume = ball(20.);
  const auto above = std::count_if(volume.values.begin(), volume.values.end(), [](float v) { return v > 50.F; });
  const sensor_msgs::PointCloud2 cloud = to_cloud(volume, 0.5, std_msgs::Header());
  EXPECT_EQ(cloud.width * cloud.height, static_cast<std::uint32_t>(above));
  sensor_msgs::PointCloud2ConstIterator<float> point(cloud, "x");
  sensor_msgs::PointCloud2ConstIterator<float> intensity(cloud, "intensity");
  for (; point != point.end(); ++point, ++intensity) {
    const Eigen::Vector3d p = 1000. * Eigen::Vector3d(double(point[0]), double(point[1]), double(point[2]));
    EXPECT_LT((p - some_pose().translation()).norm(), 20.001);
    EXPECT_GT(*intensity, 50.F);
  }
  EXPECT_EQ(to_cloud(svort::Volume(), 0.5, std_msgs::Header()).data.size(), 0U);
}

TEST(SliceMarkers, OutlineAndPlaneLieInTheSlice) {
  svort::SliceEstimate slice;
  slice.info = some_slice().info;
  slice.T_brain_slice = some_pose();
  svort::PreparedSlice prepared;
  prepared.size = 4;
  prepared.resolution = 2.;
  prepared.T_slice_crop.translation() = Eigen::Vector3d(5., -3., 0.);
  prepared.pixels = {0, 0, 0, 0, 0, 10, 20, 0, 0, 30, 90, 0, 0, 0, 0, 0};
  prepared.mask = {0, 0, 0, 0, 0, 1, 1, 0, 0, 1, 1, 0, 0, 0, 0, 0};
  const auto markers = to_slice_markers(slice, {&prepared, 40.}, std_msgs::Header()).markers;
  ASSERT_EQ(markers.size(), 4U);
  const auto in_slice = [&](const geometry_msgs::Point& p) -> Eigen::Vector3d {
    return some_pose().inverse() * (1000. * Eigen::Vector3d(p.x, p.y, p.z));
  };
  // Brain pixels (1, 1) to (2, 2) lie 1 mm around the crop's centre; the frame leaves 8 mm.
  EXPECT_TRUE(in_slice(markers[0].points[0]).isApprox(Eigen::Vector3d(-4., -12., 0.), 1e-9));
  EXPECT_TRUE(in_slice(markers[0].points[2]).isApprox(Eigen::Vector3d(14., 6., 0.), 1e-9));
  EXPECT_TRUE(in_slice(markers[1].points[5]).isApprox(Eigen::Vector3d(0., 0., 20.), 1e-9));  // z axis
  EXPECT_EQ(markers[2].text, "stack 0, slice 6");
  ASSERT_EQ(markers[3].points.size(), 6U);  // the one block of four brain pixels
  EXPECT_TRUE(in_slice(markers[3].points[0]).isApprox(Eigen::Vector3d(4., -4., 0.), 1e-9));  // pixel (1, 1)
  EXPECT_FLOAT_EQ(markers[3].colors[0].r, 0.25F);
  EXPECT_FLOAT_EQ(markers[3].colors[2].r, 1.F);  // 90 / 40, clipped

  const auto unprepared = to_slice_markers(slice, {}, std_msgs::Header()).markers;
  ASSERT_EQ(unprepared.size(), 3U);  // no plane
  EXPECT_TRUE(in_slice(unprepared[0].points[0]).isApprox(Eigen::Vector3d(-48., -48., 0.), 1e-9));
  EXPECT_TRUE(in_slice(unprepared[0].points[2]).isApprox(Eigen::Vector3d(48., 48., 0.), 1e-9));
}

TEST(SliceFrame, NamesStackAndIndex) { EXPECT_EQ(slice_frame(some_slice().info), "slice_0_6"); }

}  // namespace
}  // namespace svort_ros
