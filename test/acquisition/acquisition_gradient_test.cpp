#include <gtest/gtest.h>
#include <torch/types.h>

#include <cmath>
#include <functional>
#include <string>
#include <vector>

#include "gradient_check.h"
#include "svort_ros/acquisition/point_spread_function.h"
#include "svort_ros/acquisition/slice_acquisition.h"
#include "svort_ros/geometry/rigid_transform.h"

namespace svort {
namespace {

constexpr std::array<std::int64_t, 3> kShape = {20, 22, 21};
constexpr int kHeight = 6, kWidth = 7;

torch::Tensor smooth_volume(torch::ScalarType type) {
  const auto axis = [&](std::int64_t count) { return torch::arange(count, type) * 0.37; };
  return 1.5 + torch::sin(axis(kShape[2])).view({1, 1, -1}) * torch::cos(axis(kShape[1])).view({1, -1, 1}) +
         0.5 * torch::sin(axis(kShape[0]) + 1.).view({-1, 1, 1});
}

// Parameters: formulation, whether masks are in force.
class AcquisitionGradient : public testing::TestWithParam<std::tuple<AcquisitionFormulation, bool>> {
 protected:
  void SetUp() override {
    torch::manual_seed(3);
    const auto f64 = torch::kFloat64;
    poses_ = axisangle_to_matrix(torch::cat({torch::randn({3, 3}, f64), torch::rand({3, 3}, f64) * 2 - 1}, /*dim=*/1));
    geometry_.transforms = poses_;
    if (masked()) {
      geometry_.transforms = axisangle_to_matrix(
          torch::cat({torch::randn({3, 3}, f64), (torch::rand({3, 3}, f64) * 2 - 1) * 7}, /*dim=*/1));
    }
    geometry_.psf = gaussian_psf({1.2, 1.2, 2.});
    geometry_.resolution_ratio = 1.2;
    volume_ = smooth_volume(f64);
    slices_ = torch::rand({3, 1, kHeight, kWidth}, f64) + 0.5;
    probe_slices_ = torch::randn({3, 1, kHeight, kWidth}, f64);
    probe_volume_ = torch::randn({kShape[0], kShape[1], kShape[2]}, f64);
    if (masked()) {
      masks_.slices = torch::rand({3, 1, kHeight, kWidth}) > 0.2;
      masks_.volume = smooth_volume(f64) > 0.7;
    }
  }
  AcquisitionFormulation formulation() const { return std::get<0>(GetParam()); }
  bool masked() const { return std::get<1>(GetParam()); }
  SliceAcquisition with(const torch::Tensor& transforms) const {
    AcquisitionGeometry geometry = geometry_;
    geometry.transforms = transforms;
    return SliceAcquisition(geometry, kHeight, kWidth, kShape, formulation(), masks_);
  }
  AcquisitionGeometry geometry_;
  AcquisitionMasks masks_;
  /// Every tap of every pixel is inside the volume, blur included: no jumps at the border. geometry_.transforms are the
  /// same, or stick out if there are masks.
  torch::Tensor poses_;
  torch::Tensor volume_, slices_, probe_slices_, probe_volume_;
};

// The maps are linear in volume and slices: central differences have no error but rounding, 1e-16 / 1e-5 of the sums.
constexpr double kLinear = 1e-8;
// In the poses the maps are smooth between the voxels' faces: the error of a central difference of 1e-5 is its square
// times a third derivative (measured: at most 2e-9 in all). A tap that crosses a face within the step would add its PSF
// value x step x bend, and there is room for a few of these.
constexpr double kPose = 1e-6;

TEST_P(AcquisitionGradient, ForwardInTheVolume) {
  const SliceAcquisition a = with(geometry_.transforms);
  const auto f = [&](const torch::Tensor& x) { return (a.forward(x) * probe_slices_).sum(); };
  EXPECT_LT(gradient_error(f, volume_, 60), kLinear);
}

TEST_P(AcquisitionGradient, ForwardInThePoses) {
  const auto f = [&](const torch::Tensor& t) { return (with(t).forward(volume_) * probe_slices_).sum(); };
  EXPECT_LT(gradient_error(f, poses_, 36), kPose);
}

TEST_P(AcquisitionGradient, AdjointInTheSlices) {
  const SliceAcquisition a = with(geometry_.transforms);
  for (const bool equalize : {false, true}) {
    const auto f = [&](const torch::Tensor& y) { return (a.adjoint(y, equalize) * probe_volume_).sum(); };
    EXPECT_LT(gradient_error(f, slices_, 60), kLinear) << equalize;
  }
}

TEST_P(AcquisitionGradient, AdjointInThePoses) {
  // A voxel with next to no weight has a value of its own, and a gradient without limit: left out of the sum.
  const torch::Tensor inside = with(poses_).adjoint(torch::ones_like(slices_), false) > 0.05;
  const torch::Tensor probe = probe_volume_ * inside;
  for (const bool equalize : {false, true}) {
    const auto f = [&](const torch::Tensor& t) { return (with(t).adjoint(slices_, equalize) * probe).sum(); };
    EXPECT_LT(gradient_error(f, poses_, 36), kPose) << equalize;
  }
}

TEST_P(AcquisitionGradient, NormalInVolumeWeightsAndPoses) {
  const SliceAcquisition a = with(geometry_.transforms);
  const torch::Tensor w = torch::rand({3}, torch::kFloat64) + 0.2;
  const auto in_volume = [&](const torch::Tensor& x) { return (a.normal(x, w) * probe_volume_).sum(); };
  EXPECT_LT(gradient_error(in_volume, volume_, 40), kLinear);
  const auto in_weights = [&](const torch::Tensor& x) { return (a.normal(volume_, x) * probe_volume_).sum(); };
  EXPECT_LT(gradient_error(in_weights, w, 3), kLinear);
  const auto in_poses = [&](const torch::Tensor& t) { return (with(t).normal(volume_, w) * probe_volume_).sum(); };
  EXPECT_LT(gradient_error(in_poses, poses_, 36), kPose);
}

TEST_P(AcquisitionGradient, ValuesAreThoseWithoutGradients) {
  const torch::Tensor x = volume_.to(torch::kFloat32), y = slices_.to(torch::kFloat32);
  const SliceAcquisition plain = with(geometry_.transforms.to(torch::kFloat32));
  const SliceAcquisition recording = with(geometry_.transforms.to(torch::kFloat32).requires_grad_());
  const SliceAcquisition in_double = with(geometry_.transforms);
  EXPECT_FALSE(plain.requires_grad());
  EXPECT_TRUE(recording.requires_grad());
  const torch::Tensor covered = plain.adjoint(torch::ones_like(y), false) > 0.01;
  // Rounding of float32 sums of about a hundred terms; a weight of 0.5 or of next to nothing decides about everything
  // or nothing, so voxels with little weight are left out.
  const auto compare = [&](const torch::Tensor& expected, const torch::Tensor& graph, const torch::Tensor& exact) {
    EXPECT_FALSE(expected.requires_grad());
    EXPECT_TRUE(graph.requires_grad());
    const double size = expected.norm().item<double>();
    ASSERT_GT(size, 1.);
    EXPECT_LT((graph - expected).norm().item<double>(), 1e-6 * size);
    EXPECT_LT((exact - expected).norm().item<double>(), 1e-5 * size);
  };
  torch::Tensor weight, weight_in_double;
  const torch::Tensor slices = plain.forward(x, &weight);
  compare(slices, recording.forward(x), in_double.forward(volume_, &weight_in_double));
  EXPECT_LT((weight - weight_in_double).abs().max().item<double>(), 1e-5);
  compare(plain.adjoint(y, false), recording.adjoint(y, false), in_double.adjoint(slices_, false));
  compare(plain.adjoint(y, true) * covered, recording.adjoint(y, true) * covered,
          in_double.adjoint(slices_, true) * covered);
  compare(plain.normal(x), recording.normal(x), in_double.normal(volume_));

  const torch::NoGradGuard no_grad;
  EXPECT_TRUE(torch::equal(recording.forward(x), slices)) << "the vectorised path is taken again";
}

TEST_P(AcquisitionGradient, Float32GradientsAreThoseOfFloat64) {
  const auto gradients = [&](torch::ScalarType type) {
    const torch::Tensor t = geometry_.transforms.to(type).clone().requires_grad_();
    const torch::Tensor x = volume_.to(type).clone().requires_grad_();
    const torch::Tensor y = slices_.to(type).clone().requires_grad_();
    const SliceAcquisition a = with(t);
    const torch::Tensor covered = with(geometry_.transforms).adjoint(torch::ones_like(slices_), false) > 0.05;
    ((a.forward(x) * probe_slices_.to(type)).sum() + (a.adjoint(y, false) * probe_volume_.to(type)).sum() +
     (a.adjoint(y, true) * (probe_volume_ * covered).to(type)).sum())
        .backward();
    return std::vector<torch::Tensor>{t.grad(), x.grad(), y.grad()};
  };
  const auto single = gradients(torch::kFloat32), exact = gradients(torch::kFloat64);
  for (std::size_t i = 0; i < exact.size(); ++i) {
    EXPECT_EQ(single[i].scalar_type(), torch::kFloat32);
    // A tap within rounding of a voxel's face has the slope of the other side: rare, and one of many.
    EXPECT_LT((single[i] - exact[i]).norm().item<double>(), 1e-3 * exact[i].norm().item<double>()) << i;
  }
}

INSTANTIATE_TEST_SUITE_P(BothFormulations, AcquisitionGradient,
                         testing::Combine(testing::Values(AcquisitionFormulation::exact, AcquisitionFormulation::fast),
                                          testing::Bool()),
                         [](const auto& parameters) {
                           return std::string(to_string(std::get<0>(parameters.param))) +
                                  (std::get<1>(parameters.param) ? "Masked" : "Inside");
                         });

TEST(AcquisitionGradientErrors, Float64TensorsBelongToFloat64Poses) {
  AcquisitionGeometry geometry;
  geometry.transforms = torch::eye(3, 4).unsqueeze(0);
  geometry.psf = gaussian_psf({1., 1., 2.});
  const SliceAcquisition single(geometry, 4, 4, {12, 12, 12}, AcquisitionFormulation::exact);
  EXPECT_THROW(single.forward(torch::ones({12, 12, 12}, torch::kFloat64)), std::invalid_argument);
  geometry.transforms = geometry.transforms.to(torch::kFloat64);
  const SliceAcquisition exact(geometry, 4, 4, {12, 12, 12}, AcquisitionFormulation::exact);
  EXPECT_THROW(exact.forward(torch::ones({12, 12, 12})), std::invalid_argument);
  EXPECT_THROW(exact.adjoint(torch::ones({1, 1, 4, 4}), false), std::invalid_argument);
}

}  // namespace
}  // namespace svort
