#include "svort_ros/live/network_estimator.h"

#include <gtest/gtest.h>

#include <cstdlib>
#include <filesystem>
#include <map>
#include <memory>
#include <string>
#include <vector>

#include "io/scratch.h"
#include "network/small_networks.h"
#include "svort_ros/geometry/rigid_transform.h"
#include "svort_ros/live/live_pipeline.h"
#include "svort_ros/live/network_input.h"
#include "svort_ros/network/deterministic_weights.h"
#include "synthetic_scan.h"

namespace svort {
namespace {

using svort_test::synthetic_scan;
using svort_test::SyntheticScanOptions;

/// Answers the transforms that it is given, moved by `change`.
class EchoNetwork : public PoseNetwork {
 public:
  std::vector<NetworkStep> run(const NetworkInput& input, const NetworkGrid& /*grid*/, const NetworkRun& run) override {
    last = input;
    formulation = run.formulation;
    NetworkStep step;
    step.transforms = compose_transforms(change.expand({input.transforms.size(0), 3, 4}), input.transforms);
    step.weights = torch::full({input.transforms.size(0)}, 0.5F);
    return {step};
  }
  torch::Tensor change = axisangle_to_matrix(torch::tensor({{.3F, -.2F, .1F, 4.F, 5.F, 6.F}}));
  NetworkInput last;
  AcquisitionFormulation formulation = AcquisitionFormulation::fast;
};

EstimatorOptions small_options() {
  EstimatorOptions options;
  options.method = "network";
  options.volume_resolution_mm = 4.;
  options.volume_size_mm = 96.;
  options.network.volume_resolution_mm = 4.;
  return options;
}

SliceSequence sequence_of(const std::vector<Slice>& slices) {
  SliceSequence sequence;
  for (const Slice& slice : slices) EXPECT_TRUE(is_kept(sequence.add(slice).status));
  return sequence;
}

double distance(const Pose& a, const Pose& b) { return (a.matrix() - b.matrix()).cwiseAbs().maxCoeff(); }

/// float32 transforms of about 100 mm keep 1e-5 mm; a few are composed.
constexpr double kRounding = 1e-3;

class EchoEstimator : public ::testing::TestWithParam<bool> {
 protected:
  EchoEstimator() : slices(synthetic_scan()) {}
  /// Feeds all slices, as LivePipeline does.
  void feed(NetworkEstimator& estimator, SliceSequence& sequence) const {
    for (const Slice& slice : slices) {
      ASSERT_TRUE(is_kept(sequence.add(slice).status));
      estimator.add(sequence);
    }
  }
  NetworkInstance network() { return {"echo", {}, echo, GetParam()}; }

  std::vector<Slice> slices;
  std::shared_ptr<EchoNetwork> echo = std::make_shared<EchoNetwork>();
};
INSTANTIATE_TEST_SUITE_P(Frames, EchoEstimator, ::testing::Bool(),
                         [](const auto& test) { return test.param ? "common" : "own"; });

// Whatever window, crop and frame the network sees: within a stack, its answer is the scanner's geometry, moved as one.
TEST_P(EchoEstimator, AnswersComeBackToTheSlicesTheyBelongTo) {
  NetworkEstimator estimator(small_options(), network(), {});
  SliceSequence sequence;
  feed(estimator, sequence);
  for (const SliceEstimate& slice : estimator.estimate().slices) EXPECT_EQ(slice.status, PoseStatus::nominal);
  estimator.finalise(sequence, nullptr);
  const auto& estimates = estimator.estimate().slices;
  ASSERT_EQ(estimates.size(), slices.size());
  EXPECT_EQ(estimator.estimate().encoded, slices.size());
  std::map<int, const SliceEstimate*> first;
  for (const SliceEstimate& slice : estimates) {
    EXPECT_EQ(slice.status, PoseStatus::network);
    EXPECT_EQ(slice.weight, 0.5);
    EXPECT_LT(distance(slice.T_scanner_brain * slice.T_brain_slice, slice.info.T_scanner_slice), 1e-9);
    const int group = GetParam() ? 0 : slice.info.stack;
    const SliceEstimate& reference = *first.emplace(group, &slice).first->second;
    EXPECT_LT(distance(reference.T_brain_slice.inverse() * slice.T_brain_slice,
                       reference.info.T_scanner_slice.inverse() * slice.info.T_scanner_slice),
              kRounding);
  }
}

TEST_P(EchoEstimator, TheVolumeFollowsThePoses) {
  NetworkEstimator estimator(small_options(), network(), {});
  SliceSequence sequence;
  feed(estimator, sequence);
  estimator.finalise(sequence, nullptr);
  // A rigid move of all slices moves the brain out of the grid's centre but not out of itself.
  if (GetParam()) {
    for (const SliceEstimate& slice : estimator.estimate().slices) EXPECT_GT(slice.ncc, 0.9);
  }
  EXPECT_TRUE(estimator.estimate().final);
  EXPECT_FALSE(estimator.volume().empty());
}

TEST_P(EchoEstimator, TheNetworkHasAForwardModelOfItsOwn) {
  EstimatorOptions options = small_options();
  ASSERT_EQ(options.formulation, "fast");
  {
    NetworkEstimator estimator(options, network(), {});
    SliceSequence sequence;
    feed(estimator, sequence);
    estimator.finalise(sequence, nullptr);
    EXPECT_EQ(echo->formulation, AcquisitionFormulation::exact) << "as the networks were trained";
  }
  options.network.formulation = "fast";
  NetworkEstimator estimator(options, network(), {});
  SliceSequence sequence;
  feed(estimator, sequence);
  estimator.finalise(sequence, nullptr);
  EXPECT_EQ(echo->formulation, AcquisitionFormulation::fast);
}

TEST_P(EchoEstimator, RunsCausallyAtEveryArrival) {
  EstimatorOptions options = small_options();
  options.network.when = "every_arrival";
  NetworkEstimator estimator(options, network(), {});
  SliceSequence sequence;
  std::size_t length = 0;
  for (const Slice& slice : slices) {
    sequence.add(slice);
    estimator.add(sequence);
    EXPECT_EQ(echo->last.slices.size(0), static_cast<std::int64_t>(++length));
    EXPECT_EQ(estimator.estimate().slices.back().status, PoseStatus::network);
  }
  EXPECT_EQ(estimator.estimate().frame_revision, 1U) << "the brain frame changes once, to the network's";
}

TEST_P(EchoEstimator, ASliceAfterTheEndMakesAllPosesNominalAgain) {
  NetworkEstimator estimator(small_options(), network(), {});
  SliceSequence sequence;
  const Slice last = slices.back();
  slices.pop_back();
  feed(estimator, sequence);
  estimator.finalise(sequence, nullptr);
  const auto frames = estimator.estimate().frame_revision;
  ASSERT_TRUE(is_kept(sequence.add(last).status));
  estimator.add(sequence);
  EXPECT_GT(estimator.estimate().frame_revision, frames);
  for (const SliceEstimate& slice : estimator.estimate().slices) {
    EXPECT_EQ(slice.status, PoseStatus::nominal);
    EXPECT_EQ(slice.weight, 1.);
    EXPECT_LT(distance(slice.T_scanner_brain * slice.T_brain_slice, slice.info.T_scanner_slice), 1e-9);
  }
}

TEST(NetworkInput, OwnFramesAreStacksAroundTheirOrigin) {
  const SyntheticScanOptions scan;
  const SequenceInput prepared = network_input(sequence_of(synthetic_scan(scan)), false);
  const NetworkInput& input = prepared.input;
  ASSERT_EQ(input.slices.sizes(), (torch::IntArrayRef{24, 1, 128, 128}));
  EXPECT_FALSE(input.common_frame);
  EXPECT_NEAR(input.thickness_mm, scan.thickness_mm, 1e-9);
  // Rotation: none. In plane: what rounding the window to pixels left. Along the normal: around zero.
  const torch::Tensor rotation = input.transforms.slice(2, 0, 3);
  EXPECT_LT((rotation - torch::eye(3)).abs().max().item<double>(), 1e-5);
  const torch::Tensor t = input.transforms.select(2, 3);
  EXPECT_LE(t.slice(1, 0, 2).abs().max().item<double>(), 0.5 + 1e-4);
  for (int stack = 0; stack < scan.stacks; ++stack) {
    const torch::Tensor of_stack = input.positions.select(1, 1) == stack;
    EXPECT_EQ(of_stack.sum().item<int>(), scan.slices_per_stack);
    const torch::Tensor z = t.select(1, 2).masked_select(of_stack);
    EXPECT_LT(z.mean().abs().item<double>(), 1e-3);
    const torch::Tensor index = input.positions.select(1, 0).masked_select(of_stack);
    EXPECT_EQ(index.min().item<float>(), -4.F);
    EXPECT_EQ(index.max().item<float>(), 3.F);
    EXPECT_LT((z - (index + 0.5) * scan.thickness_mm).abs().max().item<double>(), 1e-3);
    // The stack's 0.99 quantile is 1.
    const torch::Tensor pixels = input.slices.index({of_stack});
    const torch::Tensor positive = pixels.masked_select(pixels > 0);
    EXPECT_NEAR((positive > 1.).to(torch::kFloat32).mean().item<double>(), 0.01, 0.002);
  }
}

TEST(NetworkInput, TheCommonFrameIsTheScannersAroundTheBrain) {
  const std::vector<Slice> slices = synthetic_scan();
  const SliceSequence sequence = sequence_of(slices);
  const SequenceInput prepared = network_input(sequence, true);
  EXPECT_TRUE(prepared.input.common_frame);
  for (std::size_t i = 0; i < slices.size(); ++i) {
    const auto row = static_cast<std::int64_t>(i);
    Pose nominal = pose_from_tensor(prepared.input.transforms[row]) * prepared.T_slice_window[i].inverse();
    nominal.translation() += sequence.brain_roi().centre();
    EXPECT_LT(distance(nominal, sequence.slices()[i]->info.T_scanner_slice), kRounding);
    EXPECT_EQ(prepared.input.slice_counts[row].item<std::int64_t>(), 8);
  }
  EXPECT_NEAR(prepared.input.times[1].item<double>(), SyntheticScanOptions().tr_s, 1e-5);
}

TEST(NetworkInput, AnEmptySequenceIsAnError) {
  EXPECT_THROW(network_input(SliceSequence(), true), std::invalid_argument);
}

/// From a file of weights to poses, through the pipeline.
class NetworkMethod : public Scratch {
 protected:
  void SetUp() override {
    const NetworkInstance network = make_network("v2", small_svort_options());
    fill_deterministically(*network.module);
    save_network(path("v2.pt"), network, {{"untrained", "for a test"}});
    options_.estimator = small_options();
    options_.estimator.network.weights = path("v2.pt").string();
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

TEST_F(NetworkMethod, RunsTheNetworkOfTheFileAndSaysThatItIsUntrained) {
  LivePipeline pipeline(options_), again(options_);
  for (const Slice& slice : synthetic_scan()) {
    ASSERT_TRUE(is_kept(pipeline.add(slice).status));
    again.add(slice);
    again.update_volume();
  }
  ASSERT_TRUE(pipeline.finalise());
  again.finalise();
  for (std::size_t i = 0; i < pipeline.estimate().slices.size(); ++i) {
    const SliceEstimate& slice = pipeline.estimate().slices[i];
    EXPECT_EQ(slice.status, PoseStatus::network);
    EXPECT_TRUE(is_rigid(slice.T_brain_slice));
    EXPECT_EQ(slice.T_brain_slice.matrix(), again.estimate().slices[i].T_brain_slice.matrix());
  }
  const EstimatorNotes notes = pipeline.notes();
  EXPECT_EQ(notes.network, "v2");
  EXPECT_EQ(notes.weights_sha256.size(), 64U);
  ASSERT_EQ(notes.warnings.size(), 1U);
  EXPECT_NE(notes.warnings[0].find("UNTRAINED"), std::string::npos);
}

TEST_F(NetworkMethod, NamesTheOptionThatIsWrong) {
  options_.estimator.network.name = "v1";
  EXPECT_NE(error().find("estimator.network.name is 'v1'"), std::string::npos) << error();
  options_.estimator.network.name = "v2";
  EXPECT_EQ(error(), "");
  options_.estimator.network.when = "sometimes";
  EXPECT_NE(error().find("estimator.network.when is 'sometimes'"), std::string::npos) << error();
  options_.estimator.network.when = "scan_end";
  options_.estimator.network.iterations = -1;
  EXPECT_NE(error().find("estimator.network.iterations is -1"), std::string::npos) << error();
  options_.estimator.network.iterations = 0;
  options_.estimator.network.volume_resolution_mm = 0.;
  EXPECT_NE(error().find("estimator.network.volume_resolution_mm is 0"), std::string::npos) << error();
  options_.estimator.network.volume_resolution_mm = 4.;
  options_.estimator.network.formulation = "rough";
  EXPECT_NE(error().find("estimator.network.formulation: "), std::string::npos) << error();
  options_.estimator.network.formulation = "exact";
  options_.estimator.network.weights = path("none.pt").string();
  EXPECT_NE(error().find("none.pt: cannot be read"), std::string::npos) << error();
  options_.estimator.network.weights.clear();
  EXPECT_NE(error().find("estimator.network.weights is empty"), std::string::npos) << error();
}

}  // namespace
}  // namespace svort
