#include "svort_ros/live/network_guide.h"

#include <gtest/gtest.h>
#include <torch/types.h>

#include <filesystem>
#include <string>

#include "moving_scan.h"
#include "network/small_networks.h"
#include "svort_ros/geometry/rigid_fit.h"
#include "svort_ros/live/registration_estimator.h"
#include "svort_ros/network/deterministic_weights.h"

namespace svort {
namespace {

using svort_test::moving_scan;
using svort_test::MovingScan;
using svort_test::quick_options;

NetworkInstance small_live() {
  const NetworkInstance network = make_network("live", {{"input_px", std::int64_t{48}},
                                                        {"width", std::int64_t{8}},
                                                        {"dim", std::int64_t{24}},
                                                        {"heads", std::int64_t{2}},
                                                        {"layers", std::int64_t{1}},
                                                        {"hidden", std::int64_t{32}},
                                                        {"frame_width", std::int64_t{8}}});
  fill_deterministically(*network.module);
  return network;
}

void expect_same(const std::vector<Pose>& a, const std::vector<Pose>& b) {
  ASSERT_EQ(a.size(), b.size());
  for (std::size_t i = 0; i < a.size(); ++i) EXPECT_EQ(a[i].matrix(), b[i].matrix()) << i;
}

TEST(NetworkGuide, EncodesASliceOnceAndSaysTheSameEveryTime) {
  const MovingScan scan = moving_scan(2);
  SliceSequence sequence(quick_options().sequence);
  NetworkGuide growing(small_live(), {});
  std::vector<Pose> placed;
  std::size_t kept = 0;
  for (const Slice& slice : scan.slices) {
    if (!is_kept(sequence.add(slice).status)) continue;
    placed = growing.place(sequence);
    EXPECT_EQ(growing.take_encoded(), 1U);
    EXPECT_EQ(placed.size(), ++kept);
    for (const Pose& pose : placed) EXPECT_TRUE(is_rigid(pose));
  }
  NetworkGuide at_once(small_live(), {});
  expect_same(at_once.place(sequence), placed);
  EXPECT_EQ(at_once.take_encoded(), kept);
  growing.find_frame(sequence, placed);
  EXPECT_EQ(growing.take_encoded(), 0U);
  EXPECT_THROW(growing.find_frame(sequence, {Pose::Identity()}), std::invalid_argument);
}

TEST(NetworkGuide, TheFrameFollowsWhereTheSlicesAreSaidToLie) {
  const MovingScan scan = moving_scan(2);
  SliceSequence sequence(quick_options().sequence);
  std::vector<Pose> poses;
  for (std::size_t i = 0; i < scan.slices.size(); ++i)
    if (is_kept(sequence.add(scan.slices[i]).status))
      poses.push_back(scan.truth[i] * sequence.newest_arrival()->T_slice_crop);
  NetworkGuide guide(small_live(), {});
  const NetworkGuide::Frame frame = guide.find_frame(sequence, poses);
  EXPECT_GE(frame.agreement, 0.);
  EXPECT_LE(frame.agreement, 1.);
  // Where the whole lies along the axes says nothing about the brain.
  const Pose shift(Eigen::Translation3d(30., -20., 10.));
  for (Pose& pose : poses) pose = shift * pose;
  const NetworkGuide::Frame shifted = guide.find_frame(sequence, poses);
  EXPECT_LT(plane_distance(shifted.T_canonical_brain * shift, frame.T_canonical_brain, 40.), 1e-2);
}

TEST(NetworkGuide, OneThatKnowsNothingDoesNoHarm) {
  const MovingScan scan = moving_scan(3);
  const auto error_mm = [&](std::unique_ptr<NetworkGuide> guide, std::vector<Pose>* causal) {
    const PipelineOptions options = quick_options();
    SliceSequence sequence(options.sequence);
    RegistrationEstimator estimator(options.estimator, {}, nullptr, std::move(guide));
    std::vector<Pose> truth;
    for (std::size_t i = 0; i < scan.slices.size(); ++i) {
      if (!is_kept(sequence.add(scan.slices[i]).status)) continue;
      estimator.add(sequence);
      causal->push_back(estimator.estimate().slices.back().T_brain_slice);
      truth.push_back(scan.truth[i]);
    }
    estimator.finalise(sequence, nullptr);
    std::vector<Pose> found;
    for (const SliceEstimate& slice : estimator.estimate().slices) found.push_back(slice.T_brain_slice);
    const Pose T_truth_found = fit_planes(found, truth, 40.);
    double sum = 0.;
    for (std::size_t i = 0; i < found.size(); ++i)
      sum += plane_distance(T_truth_found * found[i], truth[i], 40.) / static_cast<double>(found.size());
    return sum;
  };
  std::vector<Pose> alone, guided, again;
  const double without = error_mm(nullptr, &alone);
  const double with = error_mm(std::make_unique<NetworkGuide>(small_live(), Checkpoint()), &guided);
  EXPECT_LT(without, 2.);
  EXPECT_LT(with, without + 0.3);
  error_mm(std::make_unique<NetworkGuide>(small_live(), Checkpoint()), &again);
  expect_same(again, guided);
}

TEST(NetworkGuide, NamesTheOptionThatIsWrong) {
  const auto error = [](const NetworkEstimatorOptions& options) -> std::string {
    try {
      const NetworkGuide guide(options);
    } catch (const std::exception& thrown) {
      return thrown.what();
    }
    return "";
  };
  NetworkEstimatorOptions options;
  EXPECT_NE(error(options).find("estimator.network.weights is empty; estimator.network.guide"), std::string::npos);
  options.weights = "/nowhere/live.pt";
  EXPECT_NE(error(options).find("/nowhere/live.pt"), std::string::npos);
  options.device = "cuda";
  EXPECT_NE(error(options).find("estimator.network.device is 'cuda'"), std::string::npos);
  options.device = "abacus";
  EXPECT_NE(error(options).find("'abacus'"), std::string::npos);
  try {
    const NetworkGuide guide(make_network("v2", small_svort_options()), {});
    ADD_FAILURE() << "version 2 was taken";
  } catch (const std::invalid_argument& thrown) {
    EXPECT_NE(std::string(thrown.what()).find("the network is 'v2'"), std::string::npos);
  }
}

TEST(NetworkGuide, TellsWhichNetworkItIsAndThatItIsUntrained) {
  Checkpoint about;
  about.sha256 = "abc";
  about.provenance["untrained"] = "for a test";
  const NetworkGuide guide(small_live(), about);
  EXPECT_EQ(guide.notes().network, "live");
  EXPECT_EQ(guide.notes().weights_sha256, "abc");
  ASSERT_EQ(guide.notes().warnings.size(), 1U);
}

}  // namespace
}  // namespace svort
