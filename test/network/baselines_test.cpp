#include "svort_ros/network/baselines.h"

#include <gtest/gtest.h>
#include <torch/types.h>

#include <memory>
#include <string>

#include "svort_ros/geometry/anchor_points.h"

namespace {

using svort::AnchorRegressor;
using svort::BaselineOptions;
using svort::NetworkInput;

BaselineOptions small() {
  BaselineOptions options;
  options.width = 8;
  options.dim = 16;
  return options;
}

NetworkInput random_input(std::int64_t n) {
  torch::manual_seed(1);
  NetworkInput input;
  input.slices = torch::rand({n, 1, 64, 64});
  input.slice_resolution_mm = 2.;
  return input;
}

NetworkInput rows(const NetworkInput& input, const torch::Tensor& index) {
  NetworkInput result = input;
  result.slices = input.slices.index_select(0, index);
  return result;
}

// Sums over many slices are grouped in other ways for other batch sizes: rounding of float32, in mm.
constexpr double kRounding = 1e-3;

template <class Network>
class Baseline : public ::testing::Test {
 protected:
  void SetUp() override {
    torch::manual_seed(2);
    network_ = std::make_shared<Network>(small());
  }
  std::shared_ptr<AnchorRegressor> network_;
};

using Both = ::testing::Types<svort::SvrNet, svort::PlaneInVol>;
TYPED_TEST_SUITE(Baseline, Both);

TYPED_TEST(Baseline, GivesRigidPosesForOneSliceAndForMany) {
  for (const std::int64_t n : {1, 60}) {
    const auto steps = this->network_->run(random_input(n), {}, {});
    ASSERT_EQ(steps.size(), 1U);
    EXPECT_EQ(steps[0].points.sizes(), (std::vector<std::int64_t>{n, 9}));
    EXPECT_FALSE(steps[0].weights.defined());
    EXPECT_FALSE(steps[0].volume.defined());
    const torch::Tensor rotation = steps[0].transforms.slice(2, 0, 3);
    EXPECT_TRUE(torch::allclose(torch::matmul(rotation.transpose(1, 2), rotation), torch::eye(3).expand({n, 3, 3}),
                                1e-4, 1e-4));
  }
}

TYPED_TEST(Baseline, TheOrderOfSlicesDoesNotMatter) {
  const torch::NoGradGuard no_grad;
  const NetworkInput input = random_input(6);
  const torch::Tensor order = torch::tensor({4, 2, 0, 5, 1, 3}, torch::kInt64);
  EXPECT_TRUE(torch::allclose(this->network_->regress(rows(input, order)),
                              this->network_->regress(input).index_select(0, order), 1e-4, kRounding));
}

TYPED_TEST(Baseline, ScansOfOneBatchDoNotSeeEachOther) {
  const torch::NoGradGuard no_grad;
  const NetworkInput input = random_input(5);
  const torch::Tensor together = this->network_->regress(input, {2, 3});
  EXPECT_TRUE(torch::allclose(together.slice(0, 0, 2), this->network_->regress(rows(input, torch::arange(2))), 1e-4,
                              kRounding));
  EXPECT_TRUE(torch::allclose(together.slice(0, 2, 5), this->network_->regress(rows(input, torch::arange(2, 5))), 1e-4,
                              kRounding));
}

TYPED_TEST(Baseline, GradientsReachEveryParameter) {
  this->network_->regress(random_input(8)).square().sum().backward();
  for (const auto& parameter : this->network_->named_parameters()) {
    ASSERT_TRUE(parameter.value().grad().defined()) << parameter.key();
    EXPECT_GT(parameter.value().grad().abs().max().template item<float>(), 0.F) << parameter.key();
  }
}

TEST(Baselines, OnlyPlaneInVolSeesTheOtherSlices) {
  const torch::NoGradGuard no_grad;
  torch::manual_seed(3);
  svort::SvrNet alone(small());
  svort::PlaneInVol set(small());
  const NetworkInput two = random_input(2), one = rows(two, torch::arange(1));
  EXPECT_TRUE(torch::allclose(alone.regress(two)[0], alone.regress(one)[0], 1e-4, kRounding));
  EXPECT_FALSE(torch::allclose(set.regress(two)[0], set.regress(one)[0], 1e-4, kRounding));
}

TEST(Baselines, RejectWhatDoesNotFit) {
  BaselineOptions options = small();
  options.input_px = 48;
  EXPECT_THROW(svort::SvrNet{options}, std::invalid_argument);
  options = small();
  options.width = 4;
  EXPECT_THROW(svort::PlaneInVol{options}, std::invalid_argument);
  svort::SvrNet network(small());
  NetworkInput input = random_input(2);
  input.slice_resolution_mm = 1.;
  EXPECT_THROW(network.regress(input), std::invalid_argument);
}

}  // namespace
