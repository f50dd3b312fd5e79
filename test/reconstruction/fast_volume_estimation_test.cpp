#include <gtest/gtest.h>
#include <torch/types.h>

#include <array>
#include <cmath>
#include <iostream>

#include "svort_ros/acquisition/point_spread_function.h"
#include "svort_ros/geometry/rigid_transform.h"
#include "svort_ros/reconstruction/volume_estimation.h"

namespace svort {
namespace {

constexpr std::array<std::int64_t, 3> kShape = {60, 70, 64};
constexpr int kPixels = 56, kSlices = 120;

// An ellipsoid with folds of about 6 voxels and an edge of about 1 voxel; nothing around it.
torch::Tensor brain() {
  const auto axis = [](std::size_t dimension) {
    std::vector<std::int64_t> view = {1, 1, 1};
    view[dimension] = -1;
    return (torch::arange(kShape[dimension]) - static_cast<double>(kShape[dimension] - 1) / 2.).view(view);
  };
  const torch::Tensor z = axis(0), y = axis(1), x = axis(2);
  const torch::Tensor radius = torch::sqrt((x / 21.).square() + (y / 25.).square() + (z / 20.).square());
  const torch::Tensor folds = 1. + 0.3 * torch::sin(x + 0.4 * y) * torch::cos(0.8 * z - 0.3 * x);
  return (folds * torch::sigmoid((1. - radius) * 20.)).masked_fill(radius > 1.3, 0.).to(torch::kFloat32).contiguous();
}

TEST(FastVolumeEstimation, ConjugateGradientsAreThoseOfTheExactFormulation) {
  torch::manual_seed(6);
  const torch::Tensor volume = brain();
  for (const double ratio : {1., 1.25}) {
    AcquisitionGeometry geometry;
    geometry.transforms = axisangle_to_matrix(torch::cat(
        {torch::randn({kSlices, 3}) * 1.5, torch::randn({kSlices, 2}), (torch::rand({kSlices, 1}) * 2 - 1) * 20},
        /*dim=*/1));
    geometry.psf = gaussian_psf({ratio, ratio, 3. * ratio});
    geometry.resolution_ratio = ratio;
    const auto with = [&](AcquisitionFormulation formulation) {
      return SliceAcquisition(geometry, kPixels, kPixels, kShape, formulation);
    };
    const SliceAcquisition exact = with(AcquisitionFormulation::exact), fast = with(AcquisitionFormulation::fast);
    const torch::Tensor slices = exact.forward(volume);
    const torch::Tensor weights = torch::rand({kSlices}) + 0.5;
    // The rim, where next to no weight decides about everything or nothing, is left out.
    const torch::Tensor inside = exact.adjoint(torch::ones_like(slices), /*equalize=*/false) > 0.1;
    ConjugateGradientOptions options;
    options.iterations = 5;  // the error grows with the steps; the product takes two
    const auto solve = [&](const SliceAcquisition& a) {
      return solve_weighted_inverse(slices, a, weights, reconstruct_psf(slices, a), options) * inside;
    };
    const torch::Tensor expected = solve(exact), actual = solve(fast);
    const double error = ((actual - expected).norm() / expected.norm()).item<double>();
    const double seen = ((exact.forward(actual) - exact.forward(expected)).norm() / slices.norm()).item<double>();
    std::cout << "ratio " << ratio << ": " << error << ", seen through A " << seen << "\n";
    EXPECT_LT(error, 0.01);
    EXPECT_LT(seen, 0.01);
  }
}

}  // namespace
}  // namespace svort
