#include "svort_ros/network/incremental_live_network.h"

#include <gtest/gtest.h>
#include <torch/types.h>

#include <cmath>
#include <memory>
#include <optional>
#include <random>
#include <stdexcept>
#include <vector>

#include "small_networks.h"
#include "svort_ros/geometry/rigid_transform.h"
#include "svort_ros/network/deterministic_weights.h"

namespace svort {
namespace {

constexpr std::int64_t kPixels = 32;  // of 2 mm

LiveNetworkOptions small_options() {
  LiveNetworkOptions options;
  options.input_px = kPixels;
  options.width = 8;
  options.dim = 24;
  options.heads = 2;
  options.layers = 1;
  options.hidden = 32;
  return options;
}

std::shared_ptr<LiveNetwork> small_network(const LiveNetworkOptions& options = small_options()) {
  auto network = std::make_shared<LiveNetwork>(options);
  fill_deterministically(*network);
  return network;
}

/// A shared network that, whatever it sees, moves every slice by so many mm along its normal.
std::shared_ptr<LiveNetwork> network_that_moves(double mm) {
  auto network = small_network();
  const torch::NoGradGuard no_grad;
  for (auto& parameter : network->named_parameters()) {
    if (parameter.key() == "shared_head.weight") parameter.value().zero_();
    if (parameter.key() != "shared_head.bias") continue;
    parameter.value().zero_();
    for (const std::int64_t z : {2, 5, 8}) parameter.value()[z].fill_(mm / kLiveUpdateUnitMm);
  }
  return network;
}

struct Scan {
  NetworkInput input;
  std::vector<Pose> poses;  ///< as they were estimated: near the prescription, in a frame of their own
  torch::Tensor volume;
};

constexpr double kVoxelMm = 2.5;

Scan moving_scan(std::int64_t n) {
  torch::manual_seed(3);
  Scan scan;
  scan.input = small_scan(n, kPixels);
  scan.input.slice_resolution_mm = 2.;
  std::mt19937 random(4);
  std::normal_distribution<double> normal;
  Pose frame = Pose::Identity();
  frame.linear() = Eigen::AngleAxisd(0.7, Eigen::Vector3d(1., -2., 2.) / 3.).toRotationMatrix();
  frame.translation() = Eigen::Vector3d(3., -5., 2.);
  for (std::int64_t i = 0; i < n; ++i) {
    Pose motion = Pose::Identity();
    motion.translation() = Eigen::Vector3d(normal(random), normal(random), normal(random));
    scan.poses.push_back(frame * motion * pose_from_tensor(scan.input.transforms[i]));
  }
  scan.volume = torch::rand({30, 30, 30});
  return scan;
}

NetworkInput first_of(const NetworkInput& input, std::int64_t n) {
  NetworkInput part = input;
  part.slices = torch::Tensor();
  part.transforms = input.transforms.slice(0, 0, n);
  part.positions = input.positions.slice(0, 0, n);
  part.slice_counts = input.slice_counts.slice(0, 0, n);
  part.times = input.times.slice(0, 0, n);
  return part;
}

void insert(IncrementalLiveNetwork& network, const Scan& scan, std::int64_t i) {
  network.insert(network.count(), scan.input.slices[i][0], 2., 3.);
}

Eigen::Matrix4d matrix(const std::optional<Pose>& pose) { return pose.value().matrix(); }

NetworkCacheOptions everything() {
  NetworkCacheOptions options;
  options.stale_mm = options.stale_share = 0.;
  options.refreshed = 10000;
  return options;
}

TEST(IncrementalLiveNetwork, WhatIsKeptIsWhatWouldBeComputedAgain) {
  constexpr std::int64_t kSlices = 9;
  const Scan scan = moving_scan(kSlices);
  const auto module = small_network();
  // Slice by slice, with poses that change all the time.
  IncrementalLiveNetwork growing(module, everything(), AcquisitionFormulation::fast);
  std::mt19937 random(5);
  std::normal_distribution<double> normal;
  for (std::int64_t i = 0; i < kSlices; ++i) {
    insert(growing, scan, i);
    std::vector<Pose> poses(scan.poses.begin(), scan.poses.begin() + i + 1);
    if (i + 1 < kSlices)
      for (Pose& pose : poses) pose.translation().x() += normal(random);
    growing.refresh(static_cast<std::size_t>(i), poses, scan.volume, kVoxelMm);
    if (i > 0) growing.place(static_cast<std::size_t>(i), first_of(scan.input, i + 1), poses, scan.volume, kVoxelMm);
  }
  // All at once, at the end.
  IncrementalLiveNetwork anew(module, everything(), AcquisitionFormulation::fast);
  for (std::int64_t i = 0; i < kSlices; ++i) insert(anew, scan, i);
  anew.refresh(kSlices - 1, scan.poses, scan.volume, kVoxelMm);
  const NetworkPlaces a = growing.place(kSlices - 1, scan.input, scan.poses, scan.volume, kVoxelMm);
  const NetworkPlaces b = anew.place(kSlices - 1, scan.input, scan.poses, scan.volume, kVoxelMm);
  EXPECT_EQ(matrix(a.from_start), matrix(b.from_start));
  EXPECT_EQ(matrix(a.from_first), matrix(b.from_first));
  EXPECT_GT((matrix(a.from_start) - scan.poses.back().matrix()).norm(), 1e-3) << "the network must say something";
}

TEST(IncrementalLiveNetwork, TheFirstNetworkSeesASliceOnce) {
  const Scan scan = moving_scan(6);
  NetworkCacheOptions lasting;
  lasting.stale_mm = lasting.stale_share = 1e6;
  IncrementalLiveNetwork network(small_network(), lasting, AcquisitionFormulation::fast, /*iterations=*/1);
  for (std::int64_t i = 0; i < 6; ++i) {
    insert(network, scan, i);
    EXPECT_EQ(network.take_encoded(), 1U);
  }
  network.refresh(5, scan.poses, scan.volume, kVoxelMm);
  const NetworkPlaces places = network.place(5, scan.input, scan.poses, scan.volume, kVoxelMm);
  EXPECT_EQ(network.take_encoded(), 0U) << "with one iteration there is no shared network";
  EXPECT_FALSE(places.from_start);
  EXPECT_TRUE(places.from_first);
}

TEST(IncrementalLiveNetwork, OnlyWhatMovedIsEncodedInTheVolumeAgain) {
  Scan scan = moving_scan(10);
  NetworkCacheOptions options;
  options.refreshed = 4;
  IncrementalLiveNetwork network(small_network(), options, AcquisitionFormulation::fast);
  for (std::int64_t i = 0; i < 10; ++i) insert(network, scan, i);
  network.take_encoded();
  const auto encoded = [&] {
    network.refresh(9, scan.poses, scan.volume, kVoxelMm);
    return network.take_encoded();
  };
  EXPECT_EQ(encoded(), 4U);
  EXPECT_EQ(encoded(), 4U);
  EXPECT_EQ(encoded(), 1U) << "all but the newest have features now";
  EXPECT_EQ(encoded(), 0U);
  scan.poses[3].translation().x() += 0.9 * options.stale_mm;
  EXPECT_EQ(encoded(), 0U);
  scan.poses[3].translation().x() += 0.2 * options.stale_mm;
  EXPECT_EQ(encoded(), 1U);
  EXPECT_EQ(encoded(), 0U);
  scan.poses[9].translation().x() += 10.;
  EXPECT_EQ(encoded(), 0U) << "the newest has no pose yet";
  // Turns: whose view of the volume changed is found out sooner or later.
  scan.volume = scan.volume.flip(0);
  std::size_t sum = 0;
  for (int turn = 0; turn < 3; ++turn) sum += encoded();
  EXPECT_EQ(sum, 9U);
  // A move of the frame is no motion.
  Pose turned = Pose::Identity();
  turned.linear() = Eigen::AngleAxisd(M_PI / 2., Eigen::Vector3d::UnitZ()).toRotationMatrix();
  network.move_frame(turned);
  for (Pose& pose : scan.poses) pose = turned * pose;
  // x -> y, y -> -x of a cube of voxels, which this rotation maps onto itself.
  scan.volume = scan.volume.transpose(1, 2).flip(2).contiguous();
  for (int turn = 0; turn < 3; ++turn) EXPECT_EQ(encoded(), 0U);
}

TEST(IncrementalLiveNetwork, MovesTheNewestSliceInItsOwnAxesAndTheVolumesFrame) {
  const Scan scan = moving_scan(8);
  LiveNetworkOptions options = small_options();
  ASSERT_EQ(options.iterations, 3);
  IncrementalLiveNetwork network(network_that_moves(5.), everything(), AcquisitionFormulation::fast);
  for (std::int64_t i = 0; i < 8; ++i) insert(network, scan, i);
  network.refresh(7, scan.poses, scan.volume, kVoxelMm);
  const NetworkPlaces places = network.place(7, scan.input, scan.poses, scan.volume, kVoxelMm);
  Pose expected = scan.poses[7];
  expected = expected * Eigen::Translation3d(0., 0., 10.);  // the shared network runs twice
  // float32 transforms of some 10 mm, composed a few times.
  EXPECT_LT((matrix(places.from_start) - expected.matrix()).cwiseAbs().maxCoeff(), 1e-3);
}

TEST(IncrementalLiveNetwork, RunsOnSlicesThatHaveFeatures) {
  const Scan scan = moving_scan(5);
  IncrementalLiveNetwork network(small_network(), everything(), AcquisitionFormulation::fast);
  for (std::int64_t i = 0; i < 5; ++i) insert(network, scan, i);
  const NetworkPlaces places = network.place(2, scan.input, scan.poses, scan.volume, kVoxelMm);
  EXPECT_TRUE(is_rigid(places.from_start.value()));
  EXPECT_TRUE(is_rigid(places.from_first.value()));
}

TEST(IncrementalLiveNetwork, NamesWhatDoesNotFit) {
  const Scan scan = moving_scan(3);
  NetworkCacheOptions options;
  options.refreshed = 0;
  EXPECT_THROW(IncrementalLiveNetwork(small_network(), options, AcquisitionFormulation::fast), std::invalid_argument);
  options = {};
  options.stale_mm = -1.;
  EXPECT_THROW(validate(options), std::invalid_argument);
  options = {};
  options.stale_share = std::nan("");
  EXPECT_THROW(validate(options), std::invalid_argument);
  EXPECT_THROW(IncrementalLiveNetwork(nullptr, {}, AcquisitionFormulation::fast), std::invalid_argument);
  EXPECT_THROW(IncrementalLiveNetwork(small_network(), {}, AcquisitionFormulation::fast, -1), std::invalid_argument);
  IncrementalLiveNetwork network(small_network(), {}, AcquisitionFormulation::fast);
  EXPECT_THROW(network.insert(1, scan.input.slices[0][0], 2., 3.), std::invalid_argument) << "position";
  EXPECT_THROW(network.insert(0, scan.input.slices[0], 2., 3.), std::invalid_argument) << "shape";
  EXPECT_THROW(network.insert(0, scan.input.slices[0][0], 1.5, 3.), std::invalid_argument) << "pixel size";
  EXPECT_EQ(network.count(), 0U);
  insert(network, scan, 0);
  EXPECT_THROW(network.refresh(0, scan.poses, scan.volume, kVoxelMm), std::invalid_argument) << "poses";
  EXPECT_THROW(network.place(0, first_of(scan.input, 1), {scan.poses[0]}, scan.volume, kVoxelMm), std::invalid_argument)
      << "one slice has no others";
}

}  // namespace
}  // namespace svort
