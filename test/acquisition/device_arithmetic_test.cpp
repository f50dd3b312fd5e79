// The functions that the CUDA kernels call for each pixel and voxel, called on the CPU in float32 as the kernels call
// them, against the vectorised operator.

#include <gtest/gtest.h>
#include <torch/types.h>

#include <algorithm>
#include <numeric>
#include <random>
#include <vector>

#include "../../src/acquisition/acquisition_plan.h"
#include "../../src/acquisition/plain_operator.h"
#include "svort_ros/acquisition/point_spread_function.h"
#include "svort_ros/acquisition/slice_acquisition.h"
#include "svort_ros/geometry/rigid_transform.h"

namespace svort {
namespace {

constexpr std::array<std::int64_t, 3> kShape = {27, 30, 29};
constexpr int kHeight = 22, kWidth = 25, kSlices = 7;
// What CUDA results must keep to; the same arithmetic in another order of additions is far below.
constexpr double kTolerance = 1e-4;

double relative_l2(const torch::Tensor& a, const torch::Tensor& b) {
  return ((a - b).norm() / b.norm()).item<double>();
}

class DeviceArithmetic : public testing::TestWithParam<AcquisitionFormulation> {
 protected:
  void SetUp() override {
    torch::manual_seed(4);
    geometry_.transforms = axisangle_to_matrix(
        torch::cat({torch::randn({kSlices, 3}), (torch::rand({kSlices, 3}) * 2 - 1) * 9}, /*dim=*/1));  // stick out
    geometry_.psf = stack_psfs({gaussian_psf({1.25, 1.25, 3.}), gaussian_psf({1.25, 1.25, 2.})});
    geometry_.psf_of_slice = torch::arange(kSlices) % 2;
    geometry_.resolution_ratio = 1.25;
    masks_.slices = torch::rand({kSlices, 1, kHeight, kWidth}) > 0.2;
    volume_ = torch::rand({kShape[0], kShape[1], kShape[2]}) + 0.5;
    slices_ = torch::rand({kSlices, 1, kHeight, kWidth}) + 0.5;
  }
  SliceAcquisition acquisition() const {
    return SliceAcquisition(geometry_, kHeight, kWidth, kShape, GetParam(), masks_);
  }
  AcquisitionGeometry geometry_;
  AcquisitionMasks masks_;
  torch::Tensor volume_, slices_;
};

TEST_P(DeviceArithmetic, AgreesWithTheVectorisedOperator) {
  const SliceAcquisition a = acquisition();
  const PlainOperator<float> linear(a.plan().table(), geometry_.transforms);
  const torch::Tensor weight = linear.weight({}), empty = ~(weight > 0), left_out = ~(weight >= 0.5);
  const torch::Tensor inverse = weight.masked_fill(empty, 1.F).reciprocal().masked_fill(empty, 0.F);
  const torch::Tensor scale = inverse.masked_fill(left_out, 0.F);
  ASSERT_GT(left_out.sum().item<std::int64_t>(), empty.sum().item<std::int64_t>());

  torch::Tensor expected_weight;
  const torch::Tensor seen = linear.gather(linear.blur(volume_)) * inverse;
  EXPECT_LT(relative_l2(seen, a.forward(volume_, &expected_weight)), kTolerance);
  EXPECT_LT((weight - expected_weight).abs().max().item<double>(), kTolerance);
  const torch::Tensor sums = linear.blur(linear.scatter(slices_ * scale));
  EXPECT_LT(relative_l2(sums, a.adjoint(slices_, /*equalize=*/false)), kTolerance);
  const torch::Tensor weights = linear.blur(linear.scatter(scale));
  const torch::Tensor covered = weights > 0.01;
  EXPECT_LT(relative_l2((sums / weights).masked_fill(~covered, 0.F),
                        a.adjoint(slices_, /*equalize=*/true).masked_fill(~covered, 0.F)),
            kTolerance);
  EXPECT_LT(relative_l2(linear.blur(linear.scatter(seen * scale)), a.normal(volume_)), kTolerance);
}

TEST_P(DeviceArithmetic, FixedPointSumsHaveNoOrder) {
  const SliceAcquisition a = acquisition();
  const auto table = a.plan().table();
  const torch::Tensor transforms = geometry_.transforms.contiguous(), signed_slices = slices_ - 1.F;
  const OperatorView<float> view = table->view(transforms.data_ptr<float>());
  const FixedPoint fixed(signed_slices.abs().max().item<float>());
  std::vector<std::int32_t> order(static_cast<std::size_t>(view.pixel_count));
  std::iota(order.begin(), order.end(), 0);
  const auto scattered = [&] {
    std::vector<std::int64_t> sums(static_cast<std::size_t>(view.voxel_count()), 0);
    for (const std::int32_t i : order) {
      scatter_pixel(view, i, signed_slices.data_ptr<float>()[view.offset(i)],
                    [&](std::int64_t voxel, float term) { sums[static_cast<std::size_t>(voxel)] += fixed.from(term); });
    }
    return sums;
  };
  const std::vector<std::int64_t> first = scattered();
  std::shuffle(order.begin(), order.end(), std::mt19937(1));
  EXPECT_EQ(first, scattered());
  torch::Tensor volume = torch::empty({kShape[0], kShape[1], kShape[2]});
  std::transform(first.begin(), first.end(), volume.data_ptr<float>(),
                 [&](std::int64_t sum) { return static_cast<float>(fixed.to_double(sum)); });
  const PlainOperator<float> linear(table, geometry_.transforms);
  // Closer than float32 sums are to one another.
  EXPECT_LT(relative_l2(volume, linear.scatter(signed_slices)), 1e-6);
}

INSTANTIATE_TEST_SUITE_P(BothFormulations, DeviceArithmetic,
                         testing::Values(AcquisitionFormulation::exact, AcquisitionFormulation::fast),
                         [](const auto& parameter) { return std::string(to_string(parameter.param)); });

TEST(FixedPoint, KeepsWhatItIsGiven) {
  for (const float largest : {1.F, 1.5F, 3e-20F, 7e20F}) {
    const FixedPoint fixed(largest);
    EXPECT_NEAR(fixed.to_double(fixed.from(largest)), largest, 1e-9 * largest);
    EXPECT_NEAR(fixed.to_double(fixed.from(-largest / 3)), -largest / 3, 1e-9 * largest);
    EXPECT_LT(fixed.from(largest), std::int64_t{1} << 32);  // 2^31 of these do not overflow
  }
  EXPECT_EQ(FixedPoint(0.F).from(0.F), 0);
}

#ifndef SVORT_WITH_CUDA
TEST(WithoutCuda, TensorsOnAnotherDeviceAreRefused) {
  AcquisitionGeometry geometry;
  geometry.transforms = torch::zeros({1, 3, 4}, torch::kMeta);
  geometry.psf = gaussian_psf({1., 1., 2.});
  try {
    const SliceAcquisition acquisition(geometry, 4, 4, {8, 8, 8}, AcquisitionFormulation::exact);
    FAIL() << "accepted";
  } catch (const std::invalid_argument& error) {
    EXPECT_NE(std::string(error.what()).find("SVORT_WITH_CUDA"), std::string::npos) << error.what();
  }
}
#endif

}  // namespace
}  // namespace svort
