#include "svort_ros/training/trainer.h"

#include <gtest/gtest.h>
#include <torch/optim/adamw.h>

#include <cmath>
#include <filesystem>
#include <fstream>
#include <limits>
#include <string>

#include "svort_ros/geometry/rigid_transform.h"
#include "svort_ros/training/losses.h"

namespace {

using namespace svort;

// ---------------------------------------------------------------------------------------------------------- losses

TEST(Losses, SmoothL1IsQuadraticThenLinear) {
  const torch::Tensor truth = torch::zeros({2, 9});
  torch::Tensor points = torch::zeros({2, 9});
  points[0] = 0.25;
  points[1] = -2.;
  const torch::Tensor loss = smooth_l1_loss(points, truth, 0.5);
  EXPECT_NEAR(loss[0].item<double>(), 0.25 * 0.25, 1e-6);  // x^2 / (2 beta)
  EXPECT_NEAR(loss[1].item<double>(), 2. - 0.25, 1e-6);    // |x| - beta / 2
}

TEST(Losses, AMirroredAnswerCostsTheMirrorLossNothing) {
  torch::manual_seed(1);
  const torch::Tensor truth = torch::randn({4, 9});
  torch::Tensor mirrored = truth.clone();
  for (const int x : {0, 3, 6}) mirrored.select(1, x) *= -1.;
  EXPECT_LT(mirror_loss(mirrored, truth, 0.5).max().item<float>(), 1e-6F);
  EXPECT_LT(mirror_loss(truth, truth, 0.5).max().item<float>(), 1e-6F);
  EXPECT_GT(smooth_l1_loss(mirrored, truth, 0.5).min().item<float>(), 1e-3F);
  // Neither reading fits if only one point is reflected.
  torch::Tensor torn = truth.clone();
  torn.select(1, 0) *= -1.;
  EXPECT_GT(mirror_loss(torn, truth, 0.5).min().item<float>(), 1e-4F);
}

TEST(Losses, TheScaleThatCostsLeastIsTheErrorItself) {
  const torch::Tensor errors = torch::full({1}, 0.3, torch::requires_grad());
  torch::Tensor log_scale = torch::full({1}, std::log(0.3F), torch::requires_grad());
  scale_loss(errors, log_scale).sum().backward();
  EXPECT_NEAR(log_scale.grad().item<double>(), 0., 1e-6);
  EXPECT_FALSE(errors.grad().defined());
}

TEST(Losses, ThePapersLossIsTheSquaredDistance) {
  EXPECT_NEAR(anchor_loss(torch::full({1, 9}, 3.), torch::zeros({1, 9})).item<double>(), 9., 1e-5);
}

// ---------------------------------------------------------------------------------------------------------- trainer

LiveNetworkOptions small_network() {
  LiveNetworkOptions options;
  options.width = 8;
  options.dim = 24;
  options.heads = 2;
  options.layers = 1;
  options.hidden = 24;
  options.frame_width = 32;
  return options;
}

std::shared_ptr<ScanSimulator> simulator(std::uint64_t seed = 1) {
  static const BrainVolume phantom = [] {
    PhantomOptions options;
    options.resolution_mm = 2.;
    return make_phantom(options);
  }();
  SimulatorOptions options;
  options.anatomies = 1;
  options.scanner.stacks_min = options.scanner.stacks_max = 1;
  return std::make_shared<ScanSimulator>(std::vector<BrainVolume>{phantom}, NetworkGrid{{64, 64, 64}, 2.}, options,
                                         seed);
}

TrainerOptions quick() {
  TrainerOptions options;
  options.scans_per_step = 2;
  options.warmup_steps = 2;
  options.log_steps = 1;
  return options;
}

class TrainerTest : public ::testing::Test {
 protected:
  void SetUp() override {
    const auto* info = ::testing::UnitTest::GetInstance()->current_test_info();
    folder_ = std::filesystem::temp_directory_path() / ("svort_trainer_test_" + std::string(info->name()));
    std::filesystem::remove_all(folder_);
  }
  void TearDown() override { std::filesystem::remove_all(folder_); }

  static std::shared_ptr<LiveRecipe> recipe(double first_share = 0.5, double frame_share = 0., int frame_bank = 2048) {
    torch::manual_seed(7);
    LiveRecipeOptions options;
    options.first_share = first_share;
    options.frame_share = frame_share;
    options.frame_bank = frame_bank;
    return std::make_shared<LiveRecipe>(std::make_shared<LiveNetwork>(small_network()), options, 1);
  }
  std::vector<std::string> lines(const char* file) const {
    std::ifstream stream(folder_ / file);
    std::vector<std::string> result;
    for (std::string line; std::getline(stream, line);) result.push_back(line);
    return result;
  }

  std::filesystem::path folder_;
};

bool same_weights(const Trainer& a, const Trainer& b) {
  const auto left = a.averaged(), right = b.averaged();
  for (std::size_t i = 0; i < left.size(); ++i) {
    if (!torch::equal(left[i].second, right[i].second)) return false;
  }
  return left.size() == right.size();
}

TEST_F(TrainerTest, AResumedRunEndsWhereAnUninterruptedOneDoes) {
  // The frame network draws from the volumes of earlier scans: from all of them, or from the last.
  for (const auto& [frame_share, frame_bank] : {std::pair(0., 2048), std::pair(1., 2048), std::pair(1., 10)}) {
    SCOPED_TRACE("frame_share " + std::to_string(frame_share) + ", frame_bank " + std::to_string(frame_bank));
    const auto make = [share = frame_share, bank = frame_bank] { return recipe(0.5, share, bank); };
    const std::filesystem::path folder = folder_ / (std::to_string(frame_share) + "_" + std::to_string(frame_bank));
    Trainer whole(make(), {simulator()}, nullptr, quick(), folder / "whole");
    for (int i = 0; i < 6; ++i) whole.step();
    TrainerOptions ahead = quick();
    ahead.prefetch = true;
    Trainer first(make(), {simulator()}, nullptr, ahead, folder / "parts");
    for (int i = 0; i < 3; ++i) first.step();
    EXPECT_FALSE(same_weights(first, whole));
    first.save();
    Trainer second(make(), {simulator()}, nullptr, quick(), folder / "parts");
    second.resume();
    EXPECT_EQ(second.progress().step, 3);
    EXPECT_EQ(second.progress().scans, 6);
    for (int i = 0; i < 3; ++i) second.step();
    EXPECT_TRUE(same_weights(second, whole));
  }
}

TEST_F(TrainerTest, ABankOfVolumesThatDoesNotFitIsRefused) {
  Trainer trainer(recipe(0.5, 1., 10), {simulator()}, nullptr, quick(), folder_);
  for (int i = 0; i < 3; ++i) trainer.step();
  trainer.save();
  Trainer wider(recipe(0.5, 1., 11), {simulator()}, nullptr, quick(), folder_);
  try {
    wider.resume();
    FAIL() << "resumed with another bank";
  } catch (const std::runtime_error& error) {
    EXPECT_NE(std::string(error.what()).find("recipe.frame_bank 11"), std::string::npos) << error.what();
  }
  EXPECT_THROW(recipe(0.5, 1., 10)->remember({{"banked", torch::zeros({1})}}), std::runtime_error);  // without volumes
  AnchorRecipe knows_no_bank(std::make_shared<PlaneInVol>(BaselineOptions()));
  EXPECT_THROW(knows_no_bank.remember({{"banked", torch::zeros({1})}}), std::runtime_error);
}

TEST_F(TrainerTest, BothNetworksLearnAFixedBatch) {
  for (const double first_share : {1., 0.}) {
    const auto live = recipe(first_share);
    const auto scans = simulator()->simulate(0, 2);
    torch::optim::AdamW optimizer(live->network().parameters(), torch::optim::AdamWOptions(3e-3));
    double before = 0., after = 0.;
    for (int i = 0; i <= 40; ++i) {
      optimizer.zero_grad();
      StepLoss loss = live->loss(scans, 3);  // the same step: the same perturbation
      loss.total.backward();
      optimizer.step();
      after = loss.parts.at(first_share > 0. ? "first_points" : "shared_points");
      if (i == 0) before = after;
    }
    EXPECT_LT(after, 0.6 * before) << "first_share " << first_share;
  }
}

TEST_F(TrainerTest, TheFrameNetworkLearnsAFixedBatch) {
  torch::manual_seed(7);
  LiveRecipeOptions options;
  options.frame_share = 1.;
  options.frame_bank = 4;  // the two volumes of each scan, put there anew every time
  LiveRecipe recipe(std::make_shared<LiveNetwork>(small_network()), options, 1);
  const auto scans = simulator()->simulate(0, 2);
  torch::optim::AdamW optimizer(recipe.network().parameters(), torch::optim::AdamWOptions(3e-3));
  std::map<std::string, double> before, after;
  for (int i = 0; i <= 40; ++i) {
    optimizer.zero_grad();
    StepLoss loss = recipe.loss(scans, 3);
    loss.total.backward();
    optimizer.step();
    after = loss.parts;
    if (i == 0) before = after;
  }
  EXPECT_GT(before.at("frame_start"), 0.1);
  EXPECT_NEAR(before.at("frame_left"), before.at("frame_start"), 1e-3);  // it begins by leaving frames as they are
  EXPECT_EQ(after.at("frame_start"), before.at("frame_start"));
  EXPECT_LT(after.at("frame_points"), 0.6 * before.at("frame_points"));
  EXPECT_LT(after.at("frame_left"), 0.6 * before.at("frame_left"));
  for (const auto& parameter : recipe.network().named_parameters()) {
    EXPECT_EQ(parameter.value().grad().defined(), parameter.key().rfind("frame_", 0) == 0) << parameter.key();
  }
  // Without a frame network there is nothing to train.
  LiveNetworkOptions without = small_network();
  without.frame_width = 0;
  EXPECT_THROW(LiveRecipe(std::make_shared<LiveNetwork>(without), options, 1), std::invalid_argument);
}

TEST_F(TrainerTest, AVolumeMovedAsOneIsTheVolumeOfSlicesThatMoved) {
  const SimulatedScan scan = simulator()->simulate(0, 1).front();
  LiveNetwork network(small_network());
  const torch::Tensor slices = network.reduce(scan.input.slices, scan.input.slice_resolution_mm);
  const auto view = [&](const torch::Tensor& poses) {
    return live_frame_view(
        live_volume(slices, poses, network.options(), scan.input.thickness_mm, AcquisitionFormulation::fast)
            .unsqueeze(0)
            .unsqueeze(0));
  };
  const torch::Tensor motions =
      axisangle_to_matrix(torch::tensor({{0.3F, -0.1F, 0.2F, 4.F, -7.F, 2.F}, {-0.1F, 0.2F, 0.1F, 0.F, 3.F, -8.F}}));
  const double half_width = 0.5 * network.options().input_px * network.options().input_resolution_mm;
  const torch::Tensor still = view(scan.truth),
                      moved = moved_as_one(still.expand({2, -1, -1, -1, -1}), motions, half_width);
  ASSERT_EQ(moved.size(0), 2);
  for (std::int64_t m = 0; m < 2; ++m) {
    const torch::Tensor exact =
        view(compose_transforms(motions.slice(0, m, m + 1).expand_as(scan.truth), scan.truth))[0];
    const double off = (moved[m] - exact).norm().item<double>();
    EXPECT_LT(off, 0.3 * (still[0] - exact).norm().item<double>()) << m;
    EXPECT_LT(off, 0.3 * exact.norm().item<double>()) << m;
  }
}

TEST_F(TrainerTest, FramesThatNothingDisturbsAreRight) {
  LiveRecipeOptions options;
  options.frame_share = 1.;
  options.perturb_deg = options.perturb_mm = options.frame_deg = options.frame_mm = 0.;
  const auto scans = simulator()->simulate(0, 1);
  const auto start = [&] {
    torch::manual_seed(7);
    LiveRecipe recipe(std::make_shared<LiveNetwork>(small_network()), options, 1);
    return recipe.loss(scans, 0).parts.at("frame_start");
  };
  EXPECT_LT(start(), 1e-4);
  options.frame_mm = 10.;
  EXPECT_GT(start(), 1e-2);
}

TEST_F(TrainerTest, TheBaselinesLearnAFixedBatch) {
  BaselineOptions options;
  options.width = 8;
  options.dim = 16;
  const auto scans = simulator()->simulate(0, 2);
  for (const bool alone : {false, true}) {
    torch::manual_seed(2);
    std::shared_ptr<AnchorRegressor> network = std::make_shared<PlaneInVol>(options);
    if (alone) network = std::make_shared<SvrNet>(options);
    AnchorRecipe recipe(network);
    torch::optim::AdamW optimizer(recipe.network().parameters(), torch::optim::AdamWOptions(3e-3));
    double before = 0., after = 0.;
    for (int i = 0; i <= 20; ++i) {
      optimizer.zero_grad();
      StepLoss loss = recipe.loss(scans, 0);
      loss.total.backward();
      optimizer.step();
      after = loss.parts.at("points");
      if (i == 0) before = after;
    }
    EXPECT_LT(after, 0.6 * before) << recipe.network().name();
  }
}

// Version 1, with networks that are small enough for a test.
std::shared_ptr<SvortV1> small_v1() {
  torch::manual_seed(3);
  SvortOptions options;
  options.iterations = 2;
  options.encoder_depth = options.quality_depth = 18;
  options.encoder_width = 4;
  options.features = options.quality_features = 44;  // four for each coordinate
  options.heads = options.quality_heads = 2;
  options.hidden = options.quality_hidden = 32;
  options.layers = options.later_layers = options.quality_layers = 1;
  return std::make_shared<SvortV1>(options);
}

const NetworkGrid kGrid = {{64, 64, 64}, 2.};  // of simulator()

TEST_F(TrainerTest, VersionOneLearnsAFixedScan) {
  const auto scans = simulator()->simulate(0, 1);
  const auto learn = [&](const PaperRecipeOptions& options, double rate, int steps) {
    PaperRecipe recipe(small_v1(), options, kGrid);
    torch::optim::AdamW optimizer(recipe.network().parameters(), torch::optim::AdamWOptions(rate));
    std::pair<std::map<std::string, double>, std::map<std::string, double>> before_and_after;
    for (int i = 0; i <= steps; ++i) {
      optimizer.zero_grad();
      StepLoss loss = recipe.loss(scans, 0);
      loss.total.backward();
      optimizer.step();
      (i == 0 ? before_and_after.first : before_and_after.second) = loss.parts;
    }
    return before_and_after;
  };
  // Faster than the paper's rate: the answers are in mm, and have to go tens of them in a few steps.
  const auto [before, after] = learn({}, 3e-2, 30);
  EXPECT_LT(after.at("points"), 0.6 * before.at("points"));
  EXPECT_LT(after.at("last_points"), 0.6 * before.at("start_points"));
  // The volume alone: poses stay where they are, and the weights of the slices are all that can be learnt.
  PaperRecipeOptions volume_alone;
  volume_alone.point_weight = 0.;
  const auto [even, weighted] = learn(volume_alone, 3e-3, 10);
  EXPECT_NEAR(weighted.at("points"), even.at("points"), 1e-3 * even.at("points"));  // but for AdamW's weight decay
  EXPECT_LT(weighted.at("volume"), even.at("volume"));
}

TEST_F(TrainerTest, TheVolumesLossTrainsTheQualityNetworkAndNothingElseDoes) {
  const auto scans = simulator()->simulate(0, 1);
  const auto gradients = [&](double points, double volume) {
    const auto network = small_v1();
    PaperRecipeOptions options;
    options.point_weight = points;
    options.volume_weight = volume;
    PaperRecipe recipe(network, options, kGrid);
    recipe.loss(scans, 0).total.backward();
    std::pair<double, double> sums{0., 0.};  // pose networks, quality network
    for (const auto& parameter : network->named_parameters()) {
      if (!parameter.value().grad().defined()) continue;
      const bool quality = parameter.key().rfind("srrnet", 0) == 0;
      (quality ? sums.second : sums.first) += parameter.value().grad().abs().sum().item<double>();
    }
    return sums;
  };
  const auto from_volume = gradients(0., 1.), from_points = gradients(1., 0.);
  EXPECT_EQ(from_volume.first, 0.);
  EXPECT_GT(from_volume.second, 0.);
  EXPECT_GT(from_points.first, 0.);
  EXPECT_EQ(from_points.second, 0.);
}

TEST_F(TrainerTest, AStepThatTakesItsScansOneByOneIsTheirMean) {
  const auto network = small_v1();
  const auto recipe = std::make_shared<PaperRecipe>(network, PaperRecipeOptions(), kGrid);
  const auto scans = simulator()->simulate(0, 2);
  const double first = recipe->loss({scans[0]}, 0).parts.at("points");
  const double second = recipe->loss({scans[1]}, 0).parts.at("points");
  EXPECT_NE(first, second);
  Trainer trainer(recipe, {simulator()}, nullptr, quick(), folder_);
  const auto said = trainer.step();
  // The trainer's scans are simulated together, which changes them by rounding.
  EXPECT_NEAR(said.at("points"), 0.5 * (first + second), 1e-3 * first);
  EXPECT_EQ(trainer.progress().scans, 2);
}

TEST_F(TrainerTest, MixedPrecisionIsRefusedOnTheCpu) {
  TrainerOptions options;
  options.device = "cpu";
  EXPECT_EQ(training_device(options), torch::Device(torch::kCPU));
  EXPECT_EQ(training_precision(options, torch::kCPU), torch::kFloat32);
  options.precision = "bfloat16";
  const auto message = [](const auto& action) -> std::string {
    try {
      action();
    } catch (const std::invalid_argument& error) {
      return error.what();
    }
    return "";
  };
  EXPECT_EQ(message([&] { training_precision(options, torch::kCPU); }),
            "trainer.precision is 'bfloat16': mixed precision is for GPUs; on the CPU it is slower than float32");
  EXPECT_EQ(training_precision(options, torch::Device(torch::kCUDA, 0)), torch::kBFloat16);
  options.precision = "float8";
  EXPECT_NE(message([&] { training_precision(options, torch::kCPU); }).find("'float8'"), std::string::npos);
  options.device = "tpu";
  EXPECT_NE(message([&] { training_device(options); }).find("'tpu'"), std::string::npos);
}

TEST_F(TrainerTest, WarmStartsAreTheTruthIfNothingPerturbsThem) {
  torch::manual_seed(7);
  LiveRecipeOptions options;
  options.first_share = options.placed_share = options.second_update_share = 0.;
  options.perturb_deg = options.perturb_mm = options.global_deg = options.global_mm = 0.;
  LiveRecipe still(std::make_shared<LiveNetwork>(small_network()), options, 1);
  const auto scans = simulator()->simulate(0, 1);
  EXPECT_LT(still.loss(scans, 0).parts.at("shared_start"), 1e-6);
  // Where the whole lies is not the shared network's to say.
  options.global_deg = 20.;
  options.global_mm = 10.;
  LiveRecipe elsewhere(std::make_shared<LiveNetwork>(small_network()), options, 1);
  EXPECT_LT(elsewhere.loss(scans, 0).parts.at("shared_start"), 1e-6);
  options.perturb_mm = 6.;
  LiveRecipe moving(std::make_shared<LiveNetwork>(small_network()), options, 1);
  EXPECT_GT(moving.loss(scans, 0).parts.at("shared_start"), 1e-3);
}

// Reports a loss that is not finite at one step.
class Treacherous : public TrainingRecipe {
 public:
  Treacherous(std::shared_ptr<TrainingRecipe> honest, std::uint64_t step) : honest_(std::move(honest)), step_(step) {}
  PoseNetwork& network() override { return honest_->network(); }
  std::vector<std::string> parts() const override { return honest_->parts(); }
  StepLoss loss(const std::vector<SimulatedScan>& scans, std::uint64_t step) override {
    StepLoss loss = honest_->loss(scans, step);
    if (step == step_) loss.total = loss.total * std::numeric_limits<double>::quiet_NaN();
    return loss;
  }

 private:
  std::shared_ptr<TrainingRecipe> honest_;
  std::uint64_t step_;
};

TEST_F(TrainerTest, AStepThatIsNotFiniteIsSkippedAndCounted) {
  Trainer trainer(std::make_shared<Treacherous>(recipe(), 1), {simulator()}, nullptr, quick(), folder_);
  EXPECT_FALSE(trainer.step().empty());
  const auto before = trainer.averaged();
  EXPECT_TRUE(trainer.step().empty());
  EXPECT_EQ(trainer.progress().skipped, 1);
  const auto after = trainer.averaged();
  for (std::size_t i = 0; i < before.size(); ++i) EXPECT_TRUE(torch::equal(before[i].second, after[i].second));
  EXPECT_FALSE(trainer.step().empty());
  EXPECT_EQ(trainer.progress().step, 3);
}

TEST_F(TrainerTest, TheLearningRateFollowsItsSchedule) {
  TrainerOptions options = quick();
  options.learning_rate = 1e-3;
  options.warmup_steps = 10;
  options.schedule = "linear";
  options.decay_from_step = 100;
  options.total_steps = 200;
  const Trainer linear(recipe(), {simulator()}, nullptr, options, folder_);
  EXPECT_NEAR(linear.learning_rate(0), 1e-4, 1e-9);
  EXPECT_NEAR(linear.learning_rate(50), 1e-3, 1e-9);
  EXPECT_NEAR(linear.learning_rate(150), 5e-4, 1e-9);
  EXPECT_NEAR(linear.learning_rate(200), 0., 1e-9);
  options.schedule = "cosine";
  const Trainer cosine(recipe(), {simulator()}, nullptr, options, folder_);
  EXPECT_NEAR(cosine.learning_rate(125), 1e-3 * 0.5 * (1. + std::cos(M_PI / 4.)), 1e-9);
}

TEST_F(TrainerTest, RunWritesLogsAndStateAndStopsWhenAsked) {
  TrainerOptions options = quick();
  options.validation_scans = 1;
  int asked = 0;
  Trainer::Hooks hooks;
  hooks.stop = [&asked] { return ++asked > 3; };
  {
    Trainer trainer(recipe(), {simulator()}, simulator(9), options, folder_);
    trainer.run(hooks, 0.);
    EXPECT_EQ(trainer.progress().step, 3);
  }
  EXPECT_EQ(lines("training.csv").size(), 4U);  // a header and a row per step
  // A row beyond the state, as a crash leaves it, goes when training continues.
  std::ofstream(folder_ / "training.csv", std::ios::app) << "9,18,0,1,1,1,,,,,,,,\n";
  options.total_steps = 5;
  Trainer again(recipe(), {simulator()}, simulator(9), options, folder_);
  again.resume();
  again.run({}, 0.);
  EXPECT_EQ(again.progress().step, 5);
  const auto rows = lines("training.csv");
  ASSERT_EQ(rows.size(), 6U);
  EXPECT_EQ(rows.back().substr(0, 2), "5,");
  EXPECT_EQ(lines("validation.csv").size(), 1U + 3U);  // a header and a row per iteration of the network
}

TEST_F(TrainerTest, ValidationMeasuresTheNetworksSteps) {
  Trainer trainer(recipe(), {simulator()}, simulator(9), quick(), folder_);
  const ValidationResult result = trainer.validate();
  ASSERT_EQ(result.ed_mm.size(), 3U);
  EXPECT_GT(result.nominal_relative_ed_mm, 0.);
  for (std::size_t k = 0; k < 3; ++k) {
    EXPECT_GT(result.ed_mm[k], result.relative_ed_mm[k]);
    EXPECT_LE(result.gd_rad[k], M_PI);
  }
}

TEST_F(TrainerTest, StartsFromWeightsOfANetworkThatHasChangedSinceAndGoesOnWithOtherScans) {
  const auto start = recipe();
  std::map<std::string, torch::Tensor> weights;
  for (const auto& parameter : start->network().named_parameters())
    weights[parameter.key()] = parameter.value().detach() + 1.;
  weights.erase("shared_pulls.weight");
  weights["shared_head.bias"] = torch::zeros({3});
  Trainer trainer(recipe(1.), {simulator()}, nullptr, quick(), folder_);
  const auto random = trainer.averaged();
  EXPECT_EQ(trainer.start_from(weights, 100), (std::vector<std::string>{"shared_head.bias", "shared_pulls.weight"}));
  const auto taken = trainer.averaged();
  for (std::size_t i = 0; i < taken.size(); ++i) {
    const bool anew = taken[i].first == "shared_head.bias" || taken[i].first == "shared_pulls.weight";
    EXPECT_TRUE(torch::equal(taken[i].second, anew ? random[i].second : weights[taken[i].first])) << taken[i].first;
  }
  // Scan 100 and the next are what it learns from, also after it has been stopped.
  Trainer same(recipe(1.), {simulator()}, nullptr, quick(), folder_ / "same");
  same.start_from(weights, 100);
  Trainer from_the_first(recipe(1.), {simulator()}, nullptr, quick(), folder_ / "first");
  from_the_first.start_from(weights, 0);
  same.step();
  same.save();
  Trainer resumed(recipe(1.), {simulator()}, nullptr, quick(), folder_ / "same");
  resumed.resume();
  resumed.step();
  for (int i = 0; i < 2; ++i) {
    trainer.step();
    from_the_first.step();
  }
  EXPECT_TRUE(same_weights(resumed, trainer));
  EXPECT_FALSE(same_weights(from_the_first, trainer));
  weights["first_head.bias"].fill_(std::numeric_limits<float>::quiet_NaN());
  EXPECT_THROW(trainer.start_from(weights), std::runtime_error);
  EXPECT_THROW(trainer.start_from({{"another", torch::zeros({2})}}), std::runtime_error);
}

TEST_F(TrainerTest, RejectsWhatDoesNotFit) {
  EXPECT_THROW(Trainer(recipe(), {}, nullptr, quick(), folder_), std::invalid_argument);
  TrainerOptions options = quick();
  options.schedule = "quadratic";
  EXPECT_THROW(Trainer(recipe(), {simulator()}, nullptr, options, folder_), std::invalid_argument);
  Trainer trainer(recipe(), {simulator()}, nullptr, quick(), folder_);
  EXPECT_THROW(trainer.resume(), std::runtime_error);  // nothing there
  trainer.save();
  options = quick();
  options.seed = 2;
  Trainer other(recipe(), {simulator()}, nullptr, options, folder_);
  EXPECT_THROW(other.resume(), std::runtime_error);  // another seed
  std::ofstream(folder_ / "state.pt") << "not a state";
  EXPECT_THROW(trainer.resume(), std::runtime_error);
  EXPECT_THROW(trainer.start_from({}), std::runtime_error);
}

}  // namespace
