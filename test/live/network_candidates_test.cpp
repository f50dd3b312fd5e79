#include "svort_ros/live/network_candidates.h"

#include <gtest/gtest.h>

#include <algorithm>
#include <filesystem>
#include <map>
#include <memory>
#include <stdexcept>
#include <string>
#include <utility>
#include <vector>

#include "io/scratch.h"
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

using Key = std::pair<int, int>;
Key key_of(const SliceInfo& info) { return {info.stack, info.index}; }

/// Says where the newest slice is, from the truth, or something else.
class Oracle : public CandidateSource {
 public:
  /// @param T_wrong_truth identity: the truth
  Oracle(const MovingScan& scan, const Pose& T_wrong_truth) : T_wrong_truth_(T_wrong_truth) {
    for (std::size_t i = 0; i < scan.slices.size(); ++i) truth_[key_of(scan.slices[i].info)] = scan.truth[i];
  }
  std::vector<PoseCandidate> propose(const SliceSequence& sequence, std::size_t position,
                                     IncrementalRefinement& engine) override {
    EXPECT_EQ(engine.count(), sequence.slices().size());
    ++calls;
    if (!engine.compares()) return {};
    std::vector<Pose> truth, here;
    for (std::size_t i = 0; i < engine.count(); ++i) {
      if (i == position) continue;
      truth.push_back(truth_of(*sequence.slices()[i]));
      here.push_back(engine.slices()[i].T_brain_slice);
    }
    return {{"oracle", fit_planes(truth, here, 40.) * T_wrong_truth_ * truth_of(*sequence.slices()[position])}};
  }
  void move_frame(const Pose&) override {}
  void reset() override {}
  std::size_t take_encoded() override { return 7; }
  EstimatorNotes notes() const override { return {}; }

  int calls = 0;

 private:
  Pose truth_of(const PreparedSlice& slice) const { return truth_.at(key_of(slice.info)) * slice.T_slice_crop; }

  std::map<Key, Pose> truth_;
  Pose T_wrong_truth_;
};

constexpr std::size_t kJump = 26;  // in the second stack, where slices show much of the head

/// Before slice kJump the head turns and shifts further than registration reaches.
MovingScan jumping_scan() {
  Pose jump = Pose::Identity();
  jump.linear() = Eigen::AngleAxisd(0.7, Eigen::Vector3d(1., 1., -1.).normalized()).toRotationMatrix();
  jump.translation() = Eigen::Vector3d(9., -6., 5.);
  return moving_scan(2, kJump, jump);
}

struct Outcome {
  std::vector<std::string> start;  ///< by arrival
  std::vector<Pose> causal, last, truth;
  std::vector<std::size_t> encoded;
};

Outcome run(RegistrationEstimator& estimator, const MovingScan& scan, std::size_t slices) {
  SliceSequence sequence(quick_options().sequence);
  Outcome outcome;
  for (std::size_t i = 0; i < slices; ++i) {
    if (!is_kept(sequence.add(scan.slices[i]).status)) continue;
    estimator.add(sequence);
    const SliceEstimate& newest = estimator.estimate().slices.back();
    outcome.start.push_back(newest.start);
    outcome.causal.push_back(newest.T_brain_slice);
    outcome.truth.push_back(scan.truth[i]);
    outcome.encoded.push_back(estimator.estimate().encoded);
  }
  for (const SliceEstimate& slice : estimator.estimate().slices) outcome.last.push_back(slice.T_brain_slice);
  return outcome;
}

EstimatorOptions registration() { return quick_options().estimator; }

/// How far the newest slice is from the truth, relative to the others, 28 mm from its centre, mm.
double newest_error_mm(const Outcome& outcome) {
  const std::vector<Pose> truth(outcome.truth.begin(), outcome.truth.end() - 1);
  const std::vector<Pose> here(outcome.last.begin(), outcome.last.end() - 1);
  const Pose expected = fit_planes(truth, here, 40.) * outcome.truth.back();
  const Eigen::Vector3d corner(20., 20., 0.);
  return (expected * corner - outcome.last.back() * corner).norm();
}

TEST(CandidateSource, WinsWhereItIsRightAndThePredictionIsWrong) {
  const MovingScan scan = jumping_scan();
  RegistrationEstimator without(registration(), {});
  auto oracle = std::make_unique<Oracle>(scan, Pose::Identity());
  const Oracle* asked = oracle.get();
  RegistrationEstimator with(registration(), {}, std::move(oracle));
  const Outcome lost = run(without, scan, kJump + 1), found = run(with, scan, kJump + 1);
  ASSERT_EQ(found.truth.back().matrix(), scan.truth[kJump].matrix()) << "the slice after the jump shows the head";
  EXPECT_EQ(asked->calls, static_cast<int>(found.start.size()));
  EXPECT_EQ(found.start.back(), "oracle");
  EXPECT_NE(lost.start.back(), "oracle");
  // A millimetre or two is what registration of one slice to two incomplete stacks leaves.
  EXPECT_LT(newest_error_mm(found), 3.);
  EXPECT_GT(newest_error_mm(lost), 6.);
  for (const std::size_t encoded : found.encoded) EXPECT_EQ(encoded, 7U);
  for (const std::size_t encoded : lost.encoded) EXPECT_EQ(encoded, 0U);
}

TEST(CandidateSource, ChangesNothingWhereItIsWrong) {
  const MovingScan scan = moving_scan(2);
  Pose wrong = Pose::Identity();
  wrong.linear() = Eigen::AngleAxisd(2., Eigen::Vector3d(2., -1., 1.).normalized()).toRotationMatrix();
  RegistrationEstimator without(registration(), {});
  RegistrationEstimator with(registration(), {}, std::make_unique<Oracle>(scan, wrong));
  const Outcome a = run(without, scan, scan.slices.size()), b = run(with, scan, scan.slices.size());
  EXPECT_EQ(a.start, b.start);
  for (std::size_t i = 0; i < a.last.size(); ++i) {
    EXPECT_EQ(a.causal[i].matrix(), b.causal[i].matrix()) << i;
    EXPECT_EQ(a.last[i].matrix(), b.last[i].matrix()) << i;
  }
}

TEST(CandidateSource, NeedsTheIncrementalUpdate) {
  EstimatorOptions options = registration();
  options.update = "full";
  const MovingScan scan = moving_scan(1);
  try {
    RegistrationEstimator estimator(options, {}, std::make_unique<Oracle>(scan, Pose::Identity()));
    FAIL() << "accepted";
  } catch (const std::invalid_argument& error) {
    EXPECT_NE(std::string(error.what()).find("estimator.update is 'full'"), std::string::npos) << error.what();
  }
}

/// The live network with weights that are as good as random, from a file.
class LiveNetworkCandidates : public Scratch {
 protected:
  void SetUp() override {
    save("live", {{"input_px", std::int64_t{48}},
                  {"width", std::int64_t{8}},
                  {"dim", std::int64_t{24}},
                  {"heads", std::int64_t{2}},
                  {"layers", std::int64_t{1}},
                  {"hidden", std::int64_t{32}}});
    options_ = quick_options();
    options_.estimator.network.candidate = true;
    options_.estimator.network.weights = path("live.pt").string();
  }
  void save(const std::string& name, const OptionValues& values) const {
    const NetworkInstance network = make_network(name, values);
    fill_deterministically(*network.module);
    save_network(path(name + ".pt"), network, {{"untrained", "for a test"}});
  }
  std::string error() const {
    try {
      const LivePipeline pipeline(options_);
    } catch (const std::exception& thrown) {
      return thrown.what();
    }
    return "";
  }

  PipelineOptions options_;
};

TEST_F(LiveNetworkCandidates, AreComputedSliceBySliceAndTheSameEveryTime) {
  const MovingScan scan = moving_scan(2);
  options_.estimator.network.cache.refreshed = 5;
  LivePipeline pipeline(options_);
  std::vector<std::vector<Pose>> runs;
  for (int repeat = 0; repeat < 2; ++repeat) {
    std::vector<Pose> causal;
    for (const Slice& slice : scan.slices) {
      if (!is_kept(pipeline.add(slice).status)) continue;
      if (repeat == 1) pipeline.update_volume();
      causal.push_back(pipeline.newest()->T_brain_slice);
      // The slice for the first network, old ones at their places, and the slice at four places, two from each start.
      EXPECT_LE(pipeline.estimate().encoded, 1U + 5U + 4U);
      EXPECT_GE(pipeline.estimate().encoded, 1U);
    }
    EXPECT_GE(pipeline.estimate().encoded, 1U + 4U);
    ASSERT_GT(causal.size(), 20U);
    runs.push_back(causal);
    pipeline.reset();
  }
  for (std::size_t i = 0; i < runs[0].size(); ++i) EXPECT_EQ(runs[0][i].matrix(), runs[1][i].matrix()) << i;
  const EstimatorNotes notes = pipeline.notes();
  EXPECT_EQ(notes.network, "live");
  EXPECT_EQ(notes.weights_sha256.size(), 64U);
  ASSERT_EQ(notes.warnings.size(), 1U);
  EXPECT_NE(notes.warnings[0].find("UNTRAINED"), std::string::npos);
}

TEST_F(LiveNetworkCandidates, NamesTheOptionThatIsWrong) {
  EXPECT_EQ(error(), "");
  NetworkEstimatorOptions& network = options_.estimator.network;
  const NetworkEstimatorOptions right = network;
  network.cache.refreshed = 0;
  EXPECT_NE(error().find("estimator.network.cache: refreshed is 0"), std::string::npos) << error();
  network = right;
  network.iterations = 101;
  EXPECT_NE(error().find("estimator.network.iterations is 101"), std::string::npos) << error();
  network = right;
  network.device = "cuda";
  EXPECT_NE(error().find("estimator.network.device is 'cuda'"), std::string::npos) << error();
  network = right;
  network.device = "abacus";
  EXPECT_NE(error().find("estimator.network.device is 'abacus'"), std::string::npos) << error();
  network = right;
  network.precision = "tf32";
  EXPECT_NE(error().find("estimator.network.precision is 'tf32'"), std::string::npos) << error();
  network = right;
  network.formulation = "rough";
  EXPECT_NE(error().find("estimator.network.formulation: "), std::string::npos) << error();
  network = right;
  network.weights.clear();
  EXPECT_NE(error().find("estimator.network.weights is empty; estimator.network.candidate"), std::string::npos)
      << error();
  save("v2", small_svort_options());
  network.weights = path("v2.pt").string();
  EXPECT_NE(error().find("the network is 'v2'"), std::string::npos) << error();
}

}  // namespace
}  // namespace svort
