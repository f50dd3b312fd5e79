#include <gtest/gtest.h>
#include <torch/types.h>

#include <functional>
#include <string>

#include "gradient_check.h"
#include "svort_ros/acquisition/point_spread_function.h"
#include "svort_ros/geometry/rigid_transform.h"
#include "svort_ros/reconstruction/volume_estimation.h"

namespace svort {
namespace {

constexpr std::array<std::int64_t, 3> kShape = {18, 19, 20};
constexpr int kSlices = 6, kPixels = 9;

class WeightedInverseGradient : public testing::TestWithParam<AcquisitionFormulation> {
 protected:
  void SetUp() override {
    torch::manual_seed(9);
    const auto f64 = torch::kFloat64;
    geometry_.transforms = axisangle_to_matrix(
        torch::cat({torch::randn({kSlices, 3}, f64), torch::rand({kSlices, 3}, f64) - 0.5}, /*dim=*/1));
    geometry_.psf = gaussian_psf({1., 1., 2.});
    slices_ = torch::rand({kSlices, 1, kPixels, kPixels}, f64) + 0.5;
    weights_ = torch::rand({kSlices}, f64) + 0.2;
    start_ = torch::rand({kShape[0], kShape[1], kShape[2]}, f64) + 0.5;  // the clamp cuts few voxels
    probe_ = torch::randn_like(start_);
    options_.iterations = 3;
  }
  SliceAcquisition with(const torch::Tensor& transforms) const {
    AcquisitionGeometry geometry = geometry_;
    geometry.transforms = transforms;
    return SliceAcquisition(geometry, kPixels, kPixels, kShape, GetParam());
  }
  torch::Tensor solve(const torch::Tensor& slices, const torch::Tensor& weights, const torch::Tensor& start,
                      const torch::Tensor& transforms) const {
    return (solve_weighted_inverse(slices, with(transforms), weights, start, options_) * probe_).sum();
  }
  AcquisitionGeometry geometry_;
  torch::Tensor slices_, weights_, start_, probe_;
  ConjugateGradientOptions options_;
};

// Central differences with steps of 1e-5: their square times a third derivative, and the rounding of float64 / 1e-5.
// A voxel that the clamp cuts within the step, or a tap that crosses a voxel's face, adds a little.
constexpr double kSmooth = 1e-6, kPose = 1e-5;

TEST_P(WeightedInverseGradient, IsTheGradientOfTheUnrolledSteps) {
  const torch::Tensor &y = slices_, &w = weights_, &x = start_, &t = geometry_.transforms;
  EXPECT_LT(gradient_error([&](const torch::Tensor& v) { return solve(y, v, x, t); }, w, kSlices), kSmooth);
  EXPECT_LT(gradient_error([&](const torch::Tensor& v) { return solve(v, w, x, t); }, y, 30), kSmooth);
  EXPECT_LT(gradient_error([&](const torch::Tensor& v) { return solve(y, w, v, t); }, x, 30), kSmooth);
  EXPECT_LT(gradient_error([&](const torch::Tensor& v) { return solve(y, w, x, v); }, t, 24), kPose);
}

TEST_P(WeightedInverseGradient, ReachesTheWeightsThroughReconstructionAndSolver) {
  // As training does it: poses -> PSF reconstruction -> solver, in float32.
  const torch::Tensor y = slices_.to(torch::kFloat32);
  const torch::Tensor w = weights_.to(torch::kFloat32).requires_grad_();
  const torch::Tensor t = geometry_.transforms.to(torch::kFloat32).requires_grad_();
  const SliceAcquisition a = with(t);
  const torch::Tensor solved = solve_weighted_inverse(y, a, w, reconstruct_psf(y, a), options_);
  (solved * probe_.to(torch::kFloat32)).sum().backward();
  EXPECT_GT(w.grad().norm().item<double>(), 0.);
  EXPECT_GT(t.grad().norm().item<double>(), 0.);
  EXPECT_TRUE(torch::isfinite(t.grad()).all().item<bool>());
}

TEST_P(WeightedInverseGradient, ValueAndReportAreThoseWithoutGradients) {
  const auto single = [](const torch::Tensor& tensor) { return tensor.to(torch::kFloat32); };
  const SliceAcquisition a = with(single(geometry_.transforms));
  ConjugateGradientReport detached, recorded;
  const torch::Tensor expected =
      solve_weighted_inverse(single(slices_), a, single(weights_), single(start_), options_, &detached);
  const torch::Tensor w = single(weights_).requires_grad_();
  const torch::Tensor actual = solve_weighted_inverse(single(slices_), a, w, single(start_), options_, &recorded);
  EXPECT_FALSE(expected.requires_grad());
  EXPECT_TRUE(actual.requires_grad());
  // Float32 vectors in both; the order of additions differs.
  EXPECT_LT((actual - expected).norm().item<double>(), 1e-5 * expected.norm().item<double>());
  ASSERT_EQ(recorded.iterations, 3);
  ASSERT_EQ(recorded.relative_residual.size(), detached.relative_residual.size());
  for (std::size_t i = 0; i < detached.relative_residual.size(); ++i) {
    EXPECT_NEAR(recorded.relative_residual[i], detached.relative_residual[i], 1e-5);
  }
  const torch::NoGradGuard no_grad;
  EXPECT_TRUE(torch::equal(solve_weighted_inverse(single(slices_), a, w, single(start_), options_), expected));
}

TEST_P(WeightedInverseGradient, ASliceOfWeightZeroStillHasAGradient) {
  const torch::Tensor w = torch::where(torch::arange(kSlices) == 2, torch::zeros_like(weights_), weights_);
  torch::Tensor leaf = w.clone().requires_grad_();
  solve(slices_, leaf, start_, geometry_.transforms).backward();
  EXPECT_NE(leaf.grad()[2].item<double>(), 0.);
}

INSTANTIATE_TEST_SUITE_P(BothFormulations, WeightedInverseGradient,
                         testing::Values(AcquisitionFormulation::exact, AcquisitionFormulation::fast),
                         [](const auto& parameter) { return std::string(to_string(parameter.param)); });

}  // namespace
}  // namespace svort
