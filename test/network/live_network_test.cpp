#include "svort_ros/network/live_network.h"

#include <gtest/gtest.h>
#include <torch/types.h>

#include <cmath>
#include <string>

#include "registration/registration_fixture.h"
#include "svort_ros/acquisition/point_spread_function.h"
#include "svort_ros/geometry/rigid_transform.h"
#include "svort_ros/metrics/pose_error.h"

namespace {

using svort::LiveNetwork;
using svort::LiveNetworkOptions;
using svort::NetworkInput;

// Large enough to have every part, small enough to be quick.
LiveNetworkOptions small() {
  LiveNetworkOptions options;
  options.width = 8;
  options.dim = 24;
  options.heads = 2;
  options.layers = 2;
  options.hidden = 32;
  return options;
}

// n slices of one blob each, at random places.
NetworkInput random_input(std::int64_t n, std::uint64_t seed = 1) {
  torch::manual_seed(static_cast<std::int64_t>(seed));
  NetworkInput input;
  const torch::Tensor axis = torch::linspace(-1., 1., 64);
  const torch::Tensor blob = ((axis.view({1, 64}).square() + axis.view({64, 1}).square()) < 0.4).to(torch::kFloat32);
  input.slices = torch::rand({n, 1, 64, 64}) * blob;
  input.transforms =
      svort::axisangle_to_matrix(torch::randn({n, 6}) * torch::tensor({.5F, .5F, .5F, 10.F, 10.F, 10.F}));
  const torch::Tensor index = torch::arange(n);
  input.positions = torch::stack({(index % 20 - 10).to(torch::kFloat32), (index / 20).to(torch::kFloat32)}, 1);
  input.slice_counts = torch::full({n}, 20, torch::kInt64);
  input.times = index.to(torch::kFloat32) * 1.2;
  input.slice_resolution_mm = 2.;
  return input;
}

svort::LivePulls random_pulls(std::int64_t n) {
  return {0.3 * torch::randn({n, svort::kLivePulls, 9}), torch::rand({n, svort::kLivePulls + 1})};
}

// A moving head of test/registration, as a network sees it; truth is in the frame of the prescription.
struct MovingHead {
  NetworkInput input;
  torch::Tensor truth;
};
MovingHead moving_head() {
  const svort_test::SimulatedScan scan = svort_test::simulated_scan({});
  MovingHead result;
  std::vector<torch::Tensor> nominal, truth;
  std::vector<float> stack, time;
  for (std::size_t i = 0; i < scan.truth.size(); ++i) {
    nominal.push_back(svort::tensor_from_pose(scan.input.T_world_slice[i]));
    truth.push_back(svort::tensor_from_pose(scan.truth[i]));
    stack.push_back(static_cast<float>(scan.input.stack[i]));
    time.push_back(static_cast<float>(scan.input.time_s[i]));
  }
  const auto n = static_cast<std::int64_t>(scan.truth.size());
  result.input.slices = scan.input.slices;
  result.input.transforms = torch::cat(nominal);
  result.input.positions = torch::stack({torch::zeros({n}), torch::tensor(stack)}, 1);
  result.input.slice_counts = torch::full({n}, 16, torch::kInt64);
  result.input.times = torch::tensor(time);
  result.input.slice_resolution_mm = 2.;
  result.truth = torch::cat(truth);
  return result;
}

NetworkInput rows(const NetworkInput& input, const torch::Tensor& index) {
  NetworkInput result = input;
  for (auto member : {&NetworkInput::slices, &NetworkInput::transforms, &NetworkInput::positions,
                      &NetworkInput::slice_counts, &NetworkInput::times}) {
    result.*member = (input.*member).index_select(0, index);
  }
  return result;
}

// Random weights everywhere, also where training starts from 0.
void randomise(LiveNetwork& network) {
  const torch::NoGradGuard no_grad;
  torch::manual_seed(5);
  for (auto& parameter : network.named_parameters()) {
    if (parameter.key().find("norm.weight") != std::string::npos) {
      parameter.value().uniform_(0.5, 1.5);
    } else {
      parameter.value().normal_(0., 0.1);
    }
  }
}

// Sums over many slices are grouped in other ways for other batch sizes: rounding of float32.
constexpr double kRounding = 2e-5;

TEST(LiveNetwork, DefaultsAreWithinTheLimitsOnSize) {
  LiveNetworkOptions options;
  options.frame_width = 256;
  const LiveNetwork network(options);
  std::int64_t count = 0;
  for (const torch::Tensor& parameter : network.parameters()) count += parameter.numel();
  EXPECT_LE(count, 8000000);
  EXPECT_GE(count, 1000000);
  EXPECT_LE(2 * count, std::int64_t{16} << 20);  // bytes in half precision
}

TEST(LiveNetwork, FeaturesOfASliceDependOnThatSliceAlone) {
  const torch::NoGradGuard no_grad;
  LiveNetwork network(small());
  randomise(network);
  const NetworkInput input = random_input(7);
  const torch::Tensor together = network.encode(input.slices, 2.);
  for (std::int64_t i = 0; i < 7; ++i) {
    const torch::Tensor alone = network.encode(input.slices.slice(0, i, i + 1), 2.);
    EXPECT_TRUE(torch::allclose(alone[0], together[i], kRounding, kRounding)) << "slice " << i;
  }
  EXPECT_TRUE(torch::equal(network.encode(input.slices, 2.), together));
}

TEST(LiveNetwork, TheUnitOfIntensityDoesNotMatter) {
  const torch::NoGradGuard no_grad;
  LiveNetwork network(small());
  randomise(network);
  const NetworkInput input = random_input(3);
  EXPECT_TRUE(torch::allclose(network.encode(7. * input.slices, 2.), network.encode(input.slices, 2.), 1e-4, 1e-4));
}

TEST(LiveNetwork, CachedFeaturesGiveThePoseOfAGrowingScan) {
  const torch::NoGradGuard no_grad;
  LiveNetwork network(small());
  randomise(network);
  const NetworkInput input = random_input(9);
  const torch::Tensor cached = network.encode(input.slices, 2.);
  for (const std::int64_t n : {1, 4, 9}) {
    const NetworkInput prefix = rows(input, torch::arange(n));
    const auto fresh = network.attend(network.encode(prefix.slices, 2.), prefix);
    const auto reused = network.attend(cached.slice(0, 0, n), prefix);
    EXPECT_TRUE(torch::allclose(reused.points, fresh.points, kRounding, kRounding));
  }
}

TEST(LiveNetwork, TheOrderInWhichSlicesAreListedDoesNotMatter) {
  const torch::NoGradGuard no_grad;
  LiveNetwork network(small());
  randomise(network);
  const NetworkInput input = random_input(10);
  const torch::Tensor order = torch::tensor({3, 1, 9, 0, 2, 8, 7, 4, 6, 5}, torch::kInt64);
  const NetworkInput shuffled = rows(input, order);
  const auto first = network.attend(network.encode(input.slices, 2.), input);
  const auto other = network.attend(network.encode(shuffled.slices, 2.), shuffled);
  for (const auto member : {&svort::LiveOutput::points, &svort::LiveOutput::mirrored, &svort::LiveOutput::log_scale,
                            &svort::LiveOutput::quality}) {
    EXPECT_TRUE(torch::allclose((other.*member), (first.*member).index_select(0, order), kRounding, kRounding));
  }
}

TEST(LiveNetwork, ScansOfOneBatchDoNotSeeEachOther) {
  const torch::NoGradGuard no_grad;
  LiveNetwork network(small());
  randomise(network);
  const NetworkInput all = random_input(12);
  const torch::Tensor features = network.encode(all.slices, 2.);
  const std::vector<std::int64_t> lengths = {5, 1, 6};
  std::vector<torch::Tensor> attention;
  const auto together = network.attend(features, all, lengths, &attention);
  std::int64_t begin = 0;
  for (const std::int64_t length : lengths) {
    const torch::Tensor index = torch::arange(begin, begin + length);
    const auto alone = network.attend(features.index_select(0, index), rows(all, index));
    EXPECT_TRUE(torch::allclose(together.points.index_select(0, index), alone.points, kRounding, kRounding));
    begin += length;
  }
  ASSERT_EQ(attention.size(), 2U);  // layers
  EXPECT_EQ(attention[0].sizes(), (std::vector<std::int64_t>{3, 2, 6, 6}));
  EXPECT_EQ(attention[0][1].slice(-1, 1, 6).abs().max().item<float>(), 0.F);  // nobody looks at the padding
  EXPECT_TRUE(torch::allclose(attention[1].sum(-1), torch::ones({3, 2, 6})));
  EXPECT_THROW(network.attend(features, all, {5, 6}), std::invalid_argument);
}

TEST(LiveNetwork, GradientsReachEveryParameter) {
  LiveNetwork network(small());
  randomise(network);
  const NetworkInput input = random_input(6);
  const auto first = network.attend(network.encode(input.slices, 2.), input);
  const auto shared = network.update(torch::rand({6, svort::kLiveSimulatedChannels, 64, 64}), random_pulls(6), input);
  (first.points.square().sum() + first.mirrored.square().sum() + first.log_scale.square().sum() +
   first.quality.square().sum() + shared.points.square().sum() + shared.log_scale.square().sum() +
   shared.quality.square().sum())
      .backward();
  for (const auto& parameter : network.named_parameters()) {
    ASSERT_TRUE(parameter.value().grad().defined()) << parameter.key();
    EXPECT_GT(parameter.value().grad().abs().max().item<float>(), 0.F) << parameter.key();
  }
}

TEST(LiveNetwork, HalfPrecisionConvolutionsSayNearlyTheSameAndHaveGradients) {
  LiveNetwork network(small());
  randomise(network);
  const NetworkInput input = random_input(6);
  const torch::Tensor exact = network.encode(input.slices, 2.).detach();
  network.set_precision(torch::kBFloat16);
  const torch::Tensor rounded = network.encode(input.slices, 2.);
  EXPECT_EQ(rounded.scalar_type(), torch::kFloat32);
  // bfloat16 has 8 bits: 0.4 % per operation, over a dozen of them.
  EXPECT_LT((rounded - exact).norm().item<float>(), 0.05 * exact.norm().item<float>());
  EXPECT_GT((rounded - exact).norm().item<float>(), 0.F);
  rounded.sum().backward();
  EXPECT_GT(network.parameters()[0].grad().abs().max().item<float>(), 0.F);
}

TEST(LiveNetwork, RunsOnOneSliceAndOn450) {
  LiveNetwork network(small());
  randomise(network);
  for (const std::int64_t n : {1, 450}) {
    svort::NetworkRun run;
    run.iterations = 2;
    run.formulation = svort::AcquisitionFormulation::fast;
    const auto steps = network.run(random_input(n), {{32, 32, 32}, 4.}, run);
    ASSERT_EQ(steps.size(), 2U);
    for (const auto& step : steps) {
      EXPECT_EQ(step.points.sizes(), (std::vector<std::int64_t>{n, 9}));
      EXPECT_EQ(step.weights.sizes(), (std::vector<std::int64_t>{n}));
      const torch::Tensor rotation = step.transforms.slice(2, 0, 3);
      EXPECT_TRUE(torch::allclose(torch::matmul(rotation.transpose(1, 2), rotation), torch::eye(3).expand({n, 3, 3}),
                                  1e-4, 1e-4));
      EXPECT_TRUE(step.transforms.isfinite().all().item<bool>());
    }
    EXPECT_EQ(steps.back().volume.sizes(), (std::vector<std::int64_t>{32, 32, 32}));
    EXPECT_GT(steps.back().volume.max().item<float>(), 0.F);
  }
}

TEST(LiveNetwork, AblationsAreWhatTheirNamesSay) {
  const torch::NoGradGuard no_grad;
  const NetworkInput input = random_input(5);
  NetworkInput elsewhere = input;
  elsewhere.transforms = random_input(5, 2).transforms;

  LiveNetworkOptions options = small();
  LiveNetwork with_position(options);
  options.positional_embedding = false;
  LiveNetwork without_position(options);
  randomise(with_position);
  randomise(without_position);
  const auto points_at = [](LiveNetwork& network, const NetworkInput& at) {
    return network.attend(network.encode(at.slices, 2.), at).points;
  };
  EXPECT_TRUE(torch::equal(points_at(without_position, input), points_at(without_position, elsewhere)));
  EXPECT_FALSE(torch::allclose(points_at(with_position, input), points_at(with_position, elsewhere)));

  svort::NetworkRun run;
  for (const int k : {1, 2, 3}) {
    run.iterations = k;
    EXPECT_EQ(with_position.run(input, {{32, 32, 32}, 4.}, run).size(), static_cast<std::size_t>(k));
  }
  options = small();
  options.volume_conditioned = false;
  LiveNetwork blind(options);
  randomise(blind);
  run.iterations = 2;
  EXPECT_FALSE(torch::allclose(blind.run(input, {{32, 32, 32}, 4.}, run)[1].points,
                               with_position.run(input, {{32, 32, 32}, 4.}, run)[1].points));
  options = small();
  options.pulls = false;
  LiveNetwork unpulled(options);
  EXPECT_FALSE(unpulled.named_parameters().contains("shared_pulls.weight"));
  const auto untrained = unpulled.run(input, {{32, 32, 32}, 4.}, run);
  const svort::PoseErrors moved =
      svort::relative_pose_errors(untrained[1].transforms, untrained[0].transforms, svort::live_anchor_frame(options));
  EXPECT_LT(moved.ed.max().item<double>(), 0.01) << "without pulls slices stay, but for the frame";
}

TEST(LiveNetwork, AnUpdateThatNamesTheWayToTheTruthGoesThere) {
  const LiveNetworkOptions options;
  torch::manual_seed(8);
  const torch::Tensor here = svort::axisangle_to_matrix(torch::randn({6, 6}));
  const torch::Tensor truth = svort::compose_transforms(here, svort::axisangle_to_matrix(0.2 * torch::randn({6, 6})));
  const svort::AnchorFrame frame = svort::live_anchor_frame(options);
  const torch::Tensor rest = svort::anchor_points_from_matrix(torch::eye(4).slice(0, 0, 3).unsqueeze(0), frame);
  const torch::Tensor way =
      (svort::anchor_points_from_matrix(svort::compose_transforms(svort::inverse_transform(here), truth), frame) -
       rest) /
      svort::kLiveUpdateUnitMm;
  EXPECT_TRUE(torch::allclose(svort::apply_live_update(here, way, options), truth, 1e-4, 1e-3));
  EXPECT_TRUE(torch::allclose(svort::apply_live_update(here, torch::zeros({6, 9}), options), here, 1e-4, 1e-3));
}

TEST(LiveNetwork, AnUntrainedUpdateGoesWhereImagesPull) {
  const torch::NoGradGuard no_grad;
  const MovingHead head = moving_head();
  LiveNetwork network;
  const torch::Tensor reduced = network.reduce(head.input.slices, 2.);
  const svort::LivePulls pulls = svort::pull_live_slices(reduced, head.input, network.options());
  const std::int64_t n = head.truth.size(0);
  ASSERT_EQ(pulls.points.sizes(), (std::vector<std::int64_t>{n, svort::kLivePulls, 9}));
  ASSERT_EQ(pulls.correlation.sizes(), (std::vector<std::int64_t>{n, svort::kLivePulls + 1}));
  EXPECT_GT(pulls.correlation.select(1, 2).mean().item<float>(), pulls.correlation.select(1, 0).mean().item<float>());
  const svort::AnchorFrame frame = svort::live_anchor_frame(network.options());
  const auto error = [&](const torch::Tensor& transforms) {
    return svort::relative_pose_errors(transforms, head.truth, frame).ed.mean().item<double>();
  };
  const torch::Tensor views = svort::simulate_live_channels(reduced, head.input.transforms, network.options(), 3.,
                                                            svort::AcquisitionFormulation::fast);
  const auto after = [&](const svort::LivePulls& told) {
    return error(svort::apply_live_update(head.input.transforms, network.update(views, told, head.input).points,
                                          network.options()));
  };
  const double before = error(head.input.transforms);
  EXPECT_GT(before, 1.);
  EXPECT_LT(after(pulls), 0.6 * before);
  EXPECT_NEAR(after({}), before, 1e-3) << "not told of pulls, it stays";
  // What the whole has drifted by is taken out.
  const torch::Tensor moved =
      svort::apply_live_update(head.input.transforms, pulls.points.select(1, svort::kLivePulls - 1), network.options());
  const auto centre = [](const torch::Tensor& transforms) {
    return svort::transform_points(transforms, torch::zeros({transforms.size(0), 3})).mean(0);
  };
  EXPECT_LT((centre(moved) - centre(head.input.transforms)).norm().item<float>(), 0.5F);
}

TEST(LiveNetwork, PullsDoNotDependOnTheFrame) {
  const torch::NoGradGuard no_grad;
  MovingHead head = moving_head();
  const LiveNetwork network;
  const torch::Tensor reduced = network.reduce(head.input.slices, 2.);
  const svort::LivePulls here = svort::pull_live_slices(reduced, head.input, network.options());
  const torch::Tensor turn = svort::axisangle_to_matrix(torch::tensor({{0.9F, -0.4F, 1.2F, 1.F, 2.F, -1.F}}));
  head.input.transforms = svort::compose_transforms(turn.expand_as(head.input.transforms), head.input.transforms);
  const svort::LivePulls turned = svort::pull_live_slices(reduced, head.input, network.options());
  // The grid of voxels lies elsewhere in the brain: 10 mm is 1.
  EXPECT_LT((turned.points - here.points).abs().mean().item<float>(), 0.03F);
  EXPECT_GT(here.points.abs().mean().item<float>(), 0.03F);
}

TEST(LiveNetwork, SimulatedChannelsShowTheVolumeAndItsSlopeAlongTheNormal) {
  // A stack of slices that get brighter along their normal, in any orientation.
  const LiveNetworkOptions options;
  constexpr std::int64_t kSlices = 21;
  torch::Tensor axisangle = torch::tensor({0.4F, -0.8F, 0.3F, 0.F, 0.F, 0.F}).repeat({kSlices, 1});
  torch::Tensor slices = torch::zeros({kSlices, 1, 64, 64});
  for (std::int64_t i = 0; i < kSlices; ++i) {
    axisangle[i][5] = 2. * static_cast<double>(i - 10);
    slices[i].slice(1, 16, 48).slice(2, 16, 48) = 1. + 0.02 * static_cast<double>(i);
  }
  const torch::Tensor seen = svort::simulate_live_channels(slices, svort::axisangle_to_matrix(axisangle), options, 3.,
                                                           svort::AcquisitionFormulation::fast);
  ASSERT_EQ(seen.sizes(), (std::vector<std::int64_t>{kSlices, svort::kLiveSimulatedChannels, 64, 64}));
  const auto middle = [&seen](int channel) {
    return seen[10][channel].slice(0, 26, 38).slice(1, 26, 38).mean().item<double>();
  };
  EXPECT_NEAR(middle(0), 1.2, 0.01);
  EXPECT_NEAR(middle(1), 0.01 * 2. * svort::kLiveNormalStepMm, 0.01);  // 0.01 per mm, from one step behind to one ahead
  EXPECT_EQ(seen.select(1, 0).masked_select(slices.select(1, 0) == 0).abs().max().item<float>(), 0.F);
}

// Slices of one brain, axis by axis, through a lopsided blob of an ellipsoid: (x, y, z) mm of the canonical frame.
NetworkInput lopsided_brain() {
  NetworkInput input = random_input(30);
  torch::Tensor axisangle = torch::zeros({30, 6});
  for (std::int64_t i = 0; i < 30; ++i) {
    axisangle[i][i / 10] = i < 10 ? 0. : 0.5 * M_PI;  // about x for the first ten: it is 0; then y, z
    axisangle[i][5] = 6. * (static_cast<double>(i % 10) - 4.5);
  }
  input.transforms = svort::axisangle_to_matrix(axisangle);
  const torch::Tensor axis = (torch::arange(64) - 31.5) * 2.;
  const std::vector<torch::Tensor> yx = torch::meshgrid({axis, axis}, "ij");
  const torch::Tensor pixels =
      torch::stack({yx[1], yx[0], torch::zeros_like(yx[0])}, 2).view({1, -1, 3}).to(torch::kFloat32);
  const torch::Tensor at = svort::transform_points(input.transforms, pixels.expand({30, -1, 3}));
  const torch::Tensor x = at.select(2, 0), y = at.select(2, 1), z = at.select(2, 2);
  const torch::Tensor brain = (x / 30.).square() + (y / 40.).square() + (z / 25.).square() < 1.;
  const torch::Tensor bright = (x - 10.).square() + (y - 15.).square() + (z - 5.).square() < 100.;
  input.slices = (brain.to(torch::kFloat32) * (1. + bright)).to(torch::kFloat32).view({30, 1, 64, 64});
  return input;
}

LiveNetworkOptions with_frame_network() {
  LiveNetworkOptions options = small();
  options.frame_width = 8;
  return options;
}

TEST(LiveNetwork, AVolumesVoxelsLieWhereItsSlicesDo) {
  const NetworkInput input = lopsided_brain();
  const torch::Tensor volume =
      svort::live_volume(input.slices, input.transforms, with_frame_network(), 3., svort::AcquisitionFormulation::fast);
  ASSERT_EQ(volume.sizes(), (std::vector<std::int64_t>{64, 64, 64}));
  // The bright ball, weighted by how much brighter than brain it is; voxels of 2 mm, the middle in the middle.
  const torch::Tensor bright = (volume - 1.2).clamp_min(0.);
  const torch::Tensor axis = (torch::arange(64, torch::kFloat32) - 31.5) * 2.;
  const auto middle = [&](std::int64_t keep) {
    std::vector<std::int64_t> others;
    for (std::int64_t k = 0; k < 3; ++k)
      if (k != keep) others.push_back(k);
    return ((bright.sum(others) * axis).sum() / bright.sum()).item<float>();
  };
  EXPECT_NEAR(middle(2), 10., 1.);
  EXPECT_NEAR(middle(1), 15., 1.);
  EXPECT_NEAR(middle(0), 5., 1.);
}

TEST(LiveNetwork, TheFrameNetworkSeesBrightnessAgainstTheMeanAndWhereBrainIs) {
  torch::Tensor volumes = torch::zeros({2, 1, 64, 64, 64});
  volumes[0][0].slice(0, 16, 48).slice(1, 16, 48).slice(2, 16, 47) = 3.;
  volumes[0][0].slice(0, 16, 48).slice(1, 16, 32).slice(2, 16, 47) = 1.;
  const torch::Tensor view = svort::live_frame_view(volumes);
  ASSERT_EQ(view.sizes(), (std::vector<std::int64_t>{2, 2, 32, 32, 32}));
  EXPECT_FLOAT_EQ(view[0][0][16][20][16].item<float>(), 0.5F);   // 3 where the mean is 2
  EXPECT_FLOAT_EQ(view[0][0][16][10][16].item<float>(), -0.5F);  // 1
  EXPECT_FLOAT_EQ(view[0][0][16][20][23].item<float>(), 0.25F);  // half brain, half none
  EXPECT_FLOAT_EQ(view[0][1][16][20][23].item<float>(), 0.5F);
  EXPECT_FLOAT_EQ(view[0][1][16][20][24].item<float>(), 0.F);
  EXPECT_TRUE(torch::allclose(svort::live_frame_view(7. * volumes), view)) << "whatever the scanner's unit";
  EXPECT_EQ(view[1].abs().max().item<float>(), 0.F) << "nothing, without brain";
}

TEST(LiveNetwork, PointsThatAgreeOnAMotionMoveTheFrameByIt) {
  const torch::Tensor points = svort::live_frame_points();
  ASSERT_EQ(points.sizes(), (std::vector<std::int64_t>{svort::kLiveFramePoints, 3}));
  EXPECT_EQ(points.mean(0).abs().max().item<float>(), 0.F);
  const torch::Tensor motions =
      svort::axisangle_to_matrix(torch::tensor({{0.2F, -0.1F, 0.3F, 4.F, -7.F, 2.F}, {0.F, 0.F, 0.F, 0.F, 0.F, 0.F}}));
  const torch::Tensor movement =
      (svort::transform_points(motions, points.expand({2, -1, -1})) - points) / svort::kLiveUpdateUnitMm;
  EXPECT_TRUE(torch::allclose(svort::frame_motions(movement), motions, 1e-3, 1e-3));
}

TEST(LiveNetwork, TheFrameNetworkCorrectsWhatTheVotesSay) {
  const torch::NoGradGuard no_grad;
  const NetworkInput input = lopsided_brain();
  const auto frame_of = [&](const LiveNetworkOptions& options, bool speaks) {
    LiveNetwork network(options);
    randomise(network);
    // The same first network, whatever else there is.
    LiveNetwork plain(small());
    randomise(plain);
    auto own = network.named_parameters();
    for (const auto& entry : plain.named_parameters()) own[entry.key()].copy_(entry.value());
    if (!speaks && options.frame_width > 0) {
      own["frame_network.out.weight"].zero_();
      own["frame_network.out.bias"].zero_();
    }
    return network.find_frame(network.encode(input.slices, 2.), network.reduce(input.slices, 2.), input);
  };
  LiveNetworkOptions options = with_frame_network();
  const svort::LiveFrame voted = frame_of(small(), true);
  EXPECT_TRUE(torch::allclose(frame_of(options, false).motion, voted.motion, 1e-4, 1e-3))
      << "untrained, it says nothing";
  options.frame_steps = 2;
  const svort::LiveFrame corrected = frame_of(options, true);
  EXPECT_FALSE(torch::allclose(corrected.motion, voted.motion, 1e-2, 1e-1));
  EXPECT_EQ(corrected.agreement, voted.agreement);
  options.frame_steps = 0;
  EXPECT_TRUE(torch::equal(frame_of(options, true).motion, voted.motion));
  // A step sees the brain where the steps before have brought it.
  options.frame_steps = 1;
  const svort::LiveFrame once = frame_of(options, true);
  EXPECT_FALSE(torch::allclose(once.motion, corrected.motion, 1e-2, 1e-1));

  LiveNetwork without(small());
  EXPECT_FALSE(without.has_frame_network());
  EXPECT_THROW(without.look_at_frames(torch::zeros({1, 2, 32, 32, 32})), std::logic_error);
  LiveNetwork with(with_frame_network());
  EXPECT_TRUE(with.has_frame_network());
  EXPECT_THROW(with.look_at_frames(torch::zeros({1, 2, 32, 32, 64})), std::invalid_argument);
  EXPECT_THROW(with.look_at_frames(torch::zeros({1, 1, 32, 32, 32})), std::invalid_argument);
  randomise(with);
  const torch::Tensor said =
      with.look_at_frames(torch::stack({torch::zeros({2, 32, 32, 32}), torch::rand({2, 32, 32, 32})}));
  EXPECT_EQ(said[0].abs().max().item<float>(), 0.F) << "of a volume without brain it says nothing";
  EXPECT_GT(said[1].abs().max().item<float>(), 0.F);
}

TEST(LiveNetwork, AveragesWholePixelsAndRejectsWhatDoesNotFit) {
  LiveNetwork network(small());
  const torch::Tensor fine = torch::rand({2, 1, 128, 128});
  const torch::Tensor coarse = network.reduce(fine, 1.);
  ASSERT_EQ(coarse.sizes(), (std::vector<std::int64_t>{2, 1, 64, 64}));
  EXPECT_NEAR(coarse[1][0][3][5].item<float>(), fine[1][0].slice(0, 6, 8).slice(1, 10, 12).mean().item<float>(), 1e-6);
  EXPECT_THROW(network.reduce(torch::rand({2, 1, 100, 100}), 1.), std::invalid_argument);
  EXPECT_THROW(network.reduce(fine, 1.3), std::invalid_argument);
  EXPECT_THROW(network.reduce(torch::rand({2, 128, 128}), 1.), std::invalid_argument);

  const auto rejects = [](const char* name, const std::function<void(LiveNetworkOptions&)>& change) {
    LiveNetworkOptions options = small();
    change(options);
    try {
      const LiveNetwork made(options);
      ADD_FAILURE() << name << " was accepted";
    } catch (const std::invalid_argument& error) {
      EXPECT_NE(std::string(error.what()).find(name), std::string::npos) << error.what();
    }
  };
  rejects("input_px", [](auto& o) { o.input_px = 60; });
  rejects("width", [](auto& o) { o.width = 12; });
  rejects("heads", [](auto& o) { o.heads = 5; });
  rejects("layers", [](auto& o) { o.layers = 0; });
  rejects("iterations", [](auto& o) { o.iterations = 0; });
  rejects("frame_width", [](auto& o) { o.frame_width = -1; });
  rejects("frame_steps", [](auto& o) { o.frame_steps = -1; });
}

}  // namespace
