#include "svort_ros/reconstruction/volume_estimation.h"

#include <ATen/Parallel.h>
#include <gtest/gtest.h>
#include <torch/types.h>

#include <cmath>
#include <limits>

#include "svort_ros/acquisition/point_spread_function.h"
#include "svort_ros/geometry/rigid_transform.h"

namespace svort {
namespace {

constexpr std::int64_t kSize = 28;

// A smooth phantom: three Gaussian blobs, 0 towards the rim.
torch::Tensor phantom() {
  const torch::Tensor axis = torch::arange(kSize, torch::kFloat32) - (kSize - 1) / 2.F;
  const auto blob = [&axis](float x, float y, float z, float width) {
    const auto along = [&](float centre) { return (axis - centre).square() / (2 * width * width); };
    return torch::exp(-(along(x).view({1, 1, -1}) + along(y).view({1, -1, 1}) + along(z).view({-1, 1, 1})));
  };
  return blob(0, 0, 0, 3.F) + 0.7 * blob(4, -3, 2, 2.F) + 0.5 * blob(-3, 4, -4, 2.5F);
}

// Three orthogonal stacks of `per_stack` slices, 3 voxels thick, at spacings that cover the volume.
AcquisitionGeometry three_stacks(int per_stack, double spacing) {
  torch::Tensor axisangle = torch::zeros({3 * per_stack, 6});
  for (int stack = 0; stack < 3; ++stack) {
    for (int i = 0; i < per_stack; ++i) {
      torch::Tensor row = axisangle[stack * per_stack + i];
      if (stack > 0) row[stack - 1] = M_PI / 2;
      row[5] = (i - (per_stack - 1) / 2.) * spacing;
    }
  }
  AcquisitionGeometry geometry;
  geometry.transforms = axisangle_to_matrix(axisangle + 0.01);  // off the lattice
  geometry.psf = gaussian_psf({1., 1., 3.});
  return geometry;
}

// Relative L2 distance, without the outer two voxels, which next to no slice sees.
double relative_l2(const torch::Tensor& a, const torch::Tensor& b) {
  const auto inside = [](const torch::Tensor& volume) {
    return volume.slice(0, 2, kSize - 2).slice(1, 2, kSize - 2).slice(2, 2, kSize - 2);
  };
  return ((inside(a) - inside(b)).norm() / inside(b).norm()).item<double>();
}

class VolumeEstimation : public testing::Test {
 protected:
  void SetUp() override {
    torch::manual_seed(5);
    geometry_ = three_stacks(20, 1.);
    volume_ = phantom();
    slices_ = acquire_slices(volume_, geometry_, 24, 24);
    start_ = reconstruct_psf(slices_, acquisition());
  }
  SliceAcquisition acquisition(const AcquisitionMasks& masks = {}) const {
    return SliceAcquisition(geometry_, 24, 24, {kSize, kSize, kSize}, AcquisitionFormulation::exact, masks);
  }
  AcquisitionGeometry geometry_;
  torch::Tensor volume_, slices_, start_;
};

TEST_F(VolumeEstimation, RecoversAPhantomFromEnoughSlices) {
  ConjugateGradientOptions options;
  options.iterations = 30;
  ConjugateGradientReport report;
  const torch::Tensor solved = solve_weighted_inverse(slices_, acquisition(), {}, start_, options, &report);
  // The PSF reconstruction is blurred by both directions of the operator; the solver undoes it.
  const double before = relative_l2(start_, volume_), after = relative_l2(solved, volume_);
  RecordProperty("relative_l2_psf", std::to_string(before));
  RecordProperty("relative_l2_cg", std::to_string(after));
  EXPECT_GT(before, 0.1);
  EXPECT_LT(after, 0.002);  // measured: 0.0009 after 30 steps
  EXPECT_GE(solved.min().item<float>(), 0.F);
}

TEST_F(VolumeEstimation, ResidualFallsAndTheToleranceStops) {
  ConjugateGradientOptions options;
  options.iterations = 12;
  ConjugateGradientReport report;
  solve_weighted_inverse(slices_, acquisition(), {}, start_, options, &report);
  EXPECT_EQ(report.iterations, 12);
  ASSERT_EQ(report.relative_residual.size(), 13U);
  // Conjugate gradients may raise |r| in a single step, but not over a few on a problem as tame as this.
  for (std::size_t i = 3; i < report.relative_residual.size(); ++i) {
    EXPECT_LT(report.relative_residual[i], report.relative_residual[i - 3]);
  }
  const double tolerance = report.relative_residual[5];
  options.tolerance = tolerance * 1.0001;
  ConjugateGradientReport stopped;
  solve_weighted_inverse(slices_, acquisition(), {}, start_, options, &stopped);
  EXPECT_LE(stopped.iterations, 5);
  EXPECT_GE(stopped.iterations, 1);
  EXPECT_LE(stopped.relative_residual.back(), options.tolerance);
}

TEST_F(VolumeEstimation, NoIterationsReturnTheStart) {
  ConjugateGradientOptions options;
  options.iterations = 0;
  ConjugateGradientReport report;
  const torch::Tensor start = start_ - 0.1;
  EXPECT_TRUE(
      torch::equal(solve_weighted_inverse(slices_, acquisition(), {}, start, options, &report), start.clamp_min(0)));
  EXPECT_EQ(report.iterations, 0);
  EXPECT_EQ(report.relative_residual.size(), 1U);
}

TEST_F(VolumeEstimation, WeightZeroRemovesABadSlice) {
  torch::Tensor damaged = slices_.clone(), weights = torch::ones({slices_.size(0)});
  for (const std::int64_t bad : {9, 30, 51}) {
    damaged[bad] = torch::rand({1, 24, 24}) * 3;
    weights[bad] = 0;
  }
  ConjugateGradientOptions options;
  options.iterations = 20;
  const torch::Tensor zero = torch::zeros_like(start_);
  const double trusting = relative_l2(solve_weighted_inverse(damaged, acquisition(), {}, zero, options), volume_);
  const double weighted = relative_l2(solve_weighted_inverse(damaged, acquisition(), weights, zero, options), volume_);
  EXPECT_LT(weighted, 0.04);
  EXPECT_GT(trusting, 5 * weighted);
}

TEST_F(VolumeEstimation, NormalOperatorIsSymmetricAndWeighted) {
  // Symmetric where the scatter is the exact adjoint: pixels with at least half of the PSF inside.
  torch::Tensor weight;
  acquire_slices(volume_, geometry_, 24, 24, {}, &weight);
  AcquisitionMasks masks;
  masks.slices = weight >= 0.5;
  const SliceAcquisition masked = acquisition(masks);
  const torch::Tensor p = torch::rand({slices_.size(0)});
  const torch::Tensor a = torch::rand_like(volume_), b = torch::rand_like(volume_);
  const auto product = [](const torch::Tensor& x, const torch::Tensor& y) {
    return (x.to(torch::kFloat64) * y.to(torch::kFloat64)).sum().item<double>();
  };
  const double left = product(b, masked.normal(a, p));
  const double right = product(a, masked.normal(b, p));
  EXPECT_NEAR(left, right, 1e-5 * std::abs(left));
  const torch::Tensor twice = masked.normal(a, 2 * p);
  EXPECT_TRUE(torch::allclose(twice, 2 * masked.normal(a, p), 1e-5, 1e-6));
}

TEST_F(VolumeEstimation, EmptyDataStayZeroAndFinite) {
  ConjugateGradientOptions options;
  options.iterations = 5;
  ConjugateGradientReport report;
  const torch::Tensor zero = torch::zeros_like(volume_);
  torch::Tensor solved = solve_weighted_inverse(torch::zeros_like(slices_), acquisition(), {}, zero, options, &report);
  EXPECT_EQ(solved.abs().sum().item<float>(), 0.F);
  EXPECT_EQ(report.iterations, 0);
  AcquisitionGeometry none = geometry_;
  none.transforms = torch::zeros({0, 3, 4});
  const SliceAcquisition nothing(none, 24, 24, {kSize, kSize, kSize}, AcquisitionFormulation::exact);
  solved = solve_weighted_inverse(torch::zeros({0, 1, 24, 24}), nothing, {}, volume_, options);
  EXPECT_TRUE(torch::equal(solved, volume_));
}

TEST_F(VolumeEstimation, SameBytesForAnyThreadCount) {
  ConjugateGradientOptions options;
  options.iterations = 3;
  const int before = at::get_num_threads();
  at::set_num_threads(1);
  const torch::Tensor one = solve_weighted_inverse(slices_, acquisition(), {}, start_, options);
  at::set_num_threads(4);
  const torch::Tensor four = solve_weighted_inverse(slices_, acquisition(), {}, start_, options);
  at::set_num_threads(before);
  EXPECT_TRUE(torch::equal(one, four));
}

TEST_F(VolumeEstimation, EdgePreservingStepsRemoveNoise) {
  const torch::Tensor noisy = volume_ + 0.05 * torch::randn_like(volume_);
  const torch::Tensor weights = torch::full({slices_.size(0)}, 0.2F);
  EdgePreservingOptions options;
  options.iterations = 10;
  options.step = 0.1;
  options.strength = 0.1;
  const torch::Tensor smoothed = refine_edge_preserving(slices_, acquisition(), weights, noisy, options);
  EXPECT_LT(relative_l2(smoothed, volume_), 0.5 * relative_l2(noisy, volume_));
  options.iterations = 0;
  EXPECT_TRUE(torch::equal(refine_edge_preserving(slices_, acquisition(), weights, volume_, options), volume_));
}

TEST_F(VolumeEstimation, RejectsWhatDoesNotFit) {
  const ConjugateGradientOptions options;
  const auto solve = [&](const torch::Tensor& slices, const torch::Tensor& weights, const torch::Tensor& start,
                         const ConjugateGradientOptions& with) {
    return solve_weighted_inverse(slices, acquisition(), weights, start, with);
  };
  EXPECT_THROW(solve(slices_.squeeze(1), {}, start_, options), std::invalid_argument);
  EXPECT_THROW(solve(slices_.slice(0, 0, 5), {}, start_, options), std::invalid_argument);
  EXPECT_THROW(solve(slices_, torch::ones({3}), start_, options), std::invalid_argument);
  EXPECT_THROW(solve(slices_, torch::full({slices_.size(0)}, -1.F), start_, options), std::invalid_argument);
  EXPECT_THROW(solve(slices_, torch::full({slices_.size(0)}, NAN), start_, options), std::invalid_argument);
  EXPECT_THROW(solve(slices_, {}, start_.unsqueeze(0), options), std::invalid_argument);
  EXPECT_THROW(solve(slices_, {}, start_.to(torch::kFloat64), options), std::invalid_argument);
  ConjugateGradientOptions bad;
  bad.iterations = -1;
  EXPECT_THROW(solve(slices_, {}, start_, bad), std::invalid_argument);
  EdgePreservingOptions edge;
  edge.edge = 0.;
  EXPECT_THROW(refine_edge_preserving(slices_, acquisition(), {}, start_, edge), std::invalid_argument);
}

}  // namespace
}  // namespace svort
