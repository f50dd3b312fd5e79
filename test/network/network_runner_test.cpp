#include "svort_ros/network/network_runner.h"

#include <gtest/gtest.h>
#include <torch/cuda.h>

#include <fstream>
#include <limits>
#include <memory>
#include <stdexcept>

#include "network/small_networks.h"
#include "svort_ros/network/deterministic_weights.h"
#include "svort_ros/network/stage_clock.h"

namespace svort {
namespace {

/// Answers its only parameter, and fails as often as told.
class FailingNetwork : public PoseNetwork {
 public:
  FailingNetwork() { weight = register_parameter("weight", torch::full({1}, 7.F)); }
  std::vector<NetworkStep> run(const NetworkInput& input, const NetworkGrid& /*grid*/,
                               const NetworkRun& /*run*/) override {
    ++runs;
    if (failures > 0) {
      --failures;
      TORCH_CHECK(false, message);
    }
    if (bad_input) throw std::invalid_argument("slices are wrong");
    NetworkStep step;
    step.transforms = input.transforms;
    step.weights = weight.detach().clone();
    return {step};
  }

  torch::Tensor weight;
  int failures = 0;
  int runs = 0;
  bool bad_input = false;
  std::string message = "CUDA out of memory. Tried to allocate 20.00 MiB\nmore lines";
};

RunnerOptions with_device(const std::string& device) {
  RunnerOptions options;
  options.device = device;
  return options;
}

// In these tests the processor stands in for the accelerator: what matters is what happens when it fails.
TEST(NetworkRunner, AFailingAcceleratorIsLeftForTheCpu) {
  const auto network = std::make_shared<FailingNetwork>();
  NetworkRunner runner({"failing", {}, network, true}, RunnerOptions(), torch::kCPU);
  EXPECT_EQ(runner.run(small_scan(2), small_grid(), {}).size(), 1U);
  EXPECT_EQ(runner.diagnostic(), "");
  network->failures = 1;
  const auto steps = runner.run(small_scan(2), small_grid(), {});
  ASSERT_EQ(steps.size(), 1U);
  EXPECT_EQ(steps[0].weights.item<float>(), 7.F) << "the weights must come back from the host's copy";
  EXPECT_EQ(network->runs, 3);
  EXPECT_NE(runner.diagnostic().find("out of memory"), std::string::npos) << runner.diagnostic();
  EXPECT_EQ(runner.diagnostic().find('\n'), std::string::npos);
  EXPECT_EQ(runner.device(), "cpu");
  runner.run(small_scan(2), small_grid(), {});
  EXPECT_EQ(network->runs, 4);
}

TEST(NetworkRunner, AFailureOnTheCpuIsAnError) {
  const auto network = std::make_shared<FailingNetwork>();
  NetworkRunner runner({"failing", {}, network, true}, RunnerOptions(), torch::kCPU);
  network->failures = 2;
  EXPECT_THROW(runner.run(small_scan(2), small_grid(), {}), c10::Error);
  NetworkRunner plain({"failing", {}, network, true}, with_device("cpu"));
  network->failures = 1;
  EXPECT_THROW(plain.run(small_scan(2), small_grid(), {}), c10::Error);
  EXPECT_EQ(plain.diagnostic(), "");
}

TEST(NetworkRunner, WrongInputIsNoReasonToLeaveTheAccelerator) {
  const auto network = std::make_shared<FailingNetwork>();
  NetworkRunner runner({"failing", {}, network, true}, RunnerOptions(), torch::kCPU);
  network->bad_input = true;
  EXPECT_THROW(runner.run(small_scan(2), small_grid(), {}), std::invalid_argument);
  EXPECT_EQ(network->runs, 1);
  EXPECT_EQ(runner.diagnostic(), "");
}

TEST(NetworkRunner, NamesTheOptionThatIsWrong) {
  const NetworkInstance network{"failing", {}, std::make_shared<FailingNetwork>(), true};
  EXPECT_THROW(NetworkRunner(network, with_device("gpu")), std::invalid_argument);
  RunnerOptions options;
  options.precision = "float64";
  EXPECT_THROW(NetworkRunner(network, options), std::invalid_argument);
  if (!torch::cuda::is_available()) {
    EXPECT_THROW(NetworkRunner(network, with_device("cuda")), std::invalid_argument);
    EXPECT_EQ(NetworkRunner(network, with_device("auto")).device(), "cpu");
  }
}

/// The smallest of its kind that still has every part.
NetworkInstance smallest(const std::string& name) {
  OptionValues options;
  if (name == "v1" || name == "v2") options = small_svort_options();
  if (name == "live")
    options = {{"width", std::int64_t{8}},
               {"dim", std::int64_t{24}},
               {"heads", std::int64_t{2}},
               {"layers", std::int64_t{2}},
               {"hidden", std::int64_t{32}}};
  if (name == "svrnet" || name == "planeinvol") options = {{"width", std::int64_t{8}}, {"dim", std::int64_t{16}}};
  torch::manual_seed(5);
  NetworkInstance made = make_network(name, options);
  fill_deterministically(*made.module);
  return made;
}

class SmallNetwork : public ::testing::TestWithParam<const char*> {
 protected:
  NetworkInstance network() const { return smallest(GetParam()); }
};
INSTANTIATE_TEST_SUITE_P(Svort, SmallNetwork, ::testing::Values("v1", "v2"));

TEST_P(SmallNetwork, RunsAnyNumberOfSlicesAndRepeatsItself) {
  NetworkRunner runner(network(), with_device("cpu"));
  for (const std::int64_t n : {1, 2, 7}) {
    // Larger slices: batch statistics need more than one value per channel even of a single slice.
    const NetworkInput input = small_scan(n, 64);
    const auto first = runner.run(input, small_grid(), {}), again = runner.run(input, small_grid(), {});
    ASSERT_EQ(first.size(), GetParam() == std::string("v1") ? 3U : 4U);
    for (std::size_t k = 0; k < first.size(); ++k) {
      EXPECT_EQ(first[k].points.sizes(), (torch::IntArrayRef{n, 9}));
      EXPECT_EQ(first[k].transforms.sizes(), (torch::IntArrayRef{n, 3, 4}));
      EXPECT_EQ(first[k].volume.sizes(), (torch::IntArrayRef{24, 24, 24}));
      // A softmax over the slices, times their number.
      EXPECT_NEAR(first[k].weights.mean().item<double>(), 1., 1e-5);
      EXPECT_TRUE(torch::equal(first[k].points, again[k].points));
      EXPECT_TRUE(torch::equal(first[k].volume, again[k].volume));
      EXPECT_FALSE(first[k].points.requires_grad());
    }
    EXPECT_TRUE(torch::isfinite(first.back().transforms).all().item<bool>());
  }
}

TEST_P(SmallNetwork, ReportsTheTimeOfEachStage) {
  NetworkRunner runner(network(), with_device("cpu"));
  StageClock clock;
  NetworkRun run;
  run.iterations = 2;
  run.clock = &clock;
  EXPECT_EQ(runner.run(small_scan(4), small_grid(), run).size(), 2U);
  for (const char* stage : {"encoder", "transformer", "forward_model", "adjoint", "conjugate_gradients"}) {
    ASSERT_EQ(clock.milliseconds().count(stage), 1U) << stage;
    EXPECT_GT(clock.milliseconds().at(stage), 0.) << stage;
  }
}

// bfloat16 has 8 bits: 0.4 % of what a layer computes. The updates are some 10 mm here; half a millimetre is 5 % of
// that.
TEST_P(SmallNetwork, CoarserPrecisionStaysClose) {
  const NetworkInput input = small_scan(6);
  NetworkRun run;
  run.iterations = 1;
  RunnerOptions coarse = with_device("cpu");
  coarse.precision = "bfloat16";
  const auto exact = NetworkRunner(network(), with_device("cpu")).run(input, small_grid(), run);
  const auto rounded = NetworkRunner(network(), coarse).run(input, small_grid(), run);
  const double error = (exact[0].points - rounded[0].points).abs().max().item<double>();
  EXPECT_LT(error, 0.5);
  EXPECT_GT(error, 0.) << "the option has no effect";
  EXPECT_EQ(rounded[0].points.scalar_type(), torch::kFloat32);
}

TEST_P(SmallNetwork, NamesTheTensorThatDoesNotFit) {
  NetworkRunner runner(network(), with_device("cpu"));
  const auto error = [&](const NetworkInput& input, const NetworkRun& run) -> std::string {
    try {
      runner.run(input, small_grid(), run);
    } catch (const std::invalid_argument& thrown) {
      return thrown.what();
    }
    return "";
  };
  NetworkInput input = small_scan(3);
  input.positions = torch::zeros({2, 2});
  EXPECT_NE(error(input, {}).find("positions is 2 x 2, expected 3 x 2"), std::string::npos) << error(input, {});
  input = small_scan(3);
  input.slices[1][0][4][4] = std::numeric_limits<float>::infinity();
  EXPECT_NE(error(input, {}).find("slices holds NaN or infinity"), std::string::npos);
  input = small_scan(3);
  input.transforms = torch::Tensor();
  EXPECT_NE(error(input, {}).find("transforms is undefined"), std::string::npos);
  NetworkRun run;
  run.iterations = 4;
  if (GetParam() == std::string("v1")) {
    EXPECT_NE(error(small_scan(3), run).find("version 1 has 3 pose networks, iteration 4 needs another"),
              std::string::npos);
  }
}

double resident_mb() {
  std::ifstream status("/proc/self/status");
  for (std::string line; std::getline(status, line);) {
    if (line.rfind("VmRSS:", 0) == 0) return std::stod(line.substr(6)) / 1024.;
  }
  return 0.;
}

class EveryNetwork : public ::testing::TestWithParam<std::string> {};
INSTANTIATE_TEST_SUITE_P(Names, EveryNetwork, ::testing::ValuesIn(network_names()));

// The allocator settles within the first runs; afterwards a leak of one slice's tokens (16 kB) per run would show.
TEST_P(EveryNetwork, DoesNotGrowInAThousandRuns) {
#ifdef __SANITIZE_ADDRESS__
  GTEST_SKIP() << "AddressSanitizer keeps what was freed for a while, so the process grows";
#endif
  NetworkRunner runner(smallest(GetParam()), with_device("cpu"));
  NetworkInput input = small_scan(3, GetParam() == "v1" || GetParam() == "v2" ? 16 : 64);
  input.slice_resolution_mm = 2.;
  const NetworkGrid grid{{12, 12, 12}, 2.};
  NetworkRun run;
  run.iterations = GetParam() == "svrnet" || GetParam() == "planeinvol" ? 1 : 2;
  for (int i = 0; i < 100; ++i) runner.run(input, grid, run);
  const double before = resident_mb();
  ASSERT_GT(before, 0.);
  for (int i = 0; i < 1000; ++i) runner.run(input, grid, run);
  EXPECT_LT(resident_mb() - before, 8.);
}

}  // namespace
}  // namespace svort
