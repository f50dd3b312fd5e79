#include <gtest/gtest.h>
#include <torch/types.h>

#include <array>
#include <cmath>
#include <string>
#include <vector>

#include "svort_ros/acquisition/point_spread_function.h"
#include "svort_ros/acquisition/slice_acquisition.h"
#include "svort_ros/geometry/rigid_transform.h"

namespace svort {
namespace {

// Second moments of a PSF along x, y, z, voxels^2.
std::array<double, 3> variances(const torch::Tensor& psf) {
  std::array<double, 3> variance{};
  const double sum = psf.sum().item<double>();
  for (std::int64_t axis = 0; axis < 3; ++axis) {
    const std::int64_t count = psf.size(2 - axis);
    std::vector<std::int64_t> view = {1, 1, 1};
    view[static_cast<std::size_t>(2 - axis)] = count;
    const torch::Tensor offset = (torch::arange(count) - (count - 1) / 2).view(view);
    variance[static_cast<std::size_t>(axis)] = (psf * offset * offset).sum().item<double>() / sum;
  }
  return variance;
}

// Sizes odd and even.
constexpr std::array<std::int64_t, 3> kShape = {48, 51, 50};

// Squared distance of each voxel from the centre of the volume.
torch::Tensor squared_radius() {
  const auto axis = [](std::int64_t count) {
    return torch::arange(count, torch::kFloat64) - static_cast<double>(count - 1) / 2.;
  };
  return axis(kShape[2]).square().view({1, 1, -1}) + axis(kShape[1]).square().view({1, -1, 1}) +
         axis(kShape[0]).square().view({-1, 1, 1});
}

AcquisitionGeometry slices_at(const std::vector<double>& distances, const std::array<double, 3>& ratio) {
  const auto count = static_cast<std::int64_t>(distances.size());
  torch::Tensor axisangle = torch::cat({torch::randn({count, 3}), torch::zeros({count, 3})}, /*dim=*/1);
  for (std::int64_t i = 0; i < count; ++i) axisangle[i][5] = distances[static_cast<std::size_t>(i)];
  AcquisitionGeometry geometry;
  geometry.transforms = axisangle_to_matrix(axisangle);
  geometry.psf = gaussian_psf(ratio);
  return geometry;
}

class AnalyticSlice : public testing::TestWithParam<AcquisitionFormulation> {
 protected:
  void SetUp() override { torch::manual_seed(8); }
};

TEST_P(AnalyticSlice, GaussianBallIsWidenedAlongEachAxisByTheProfile) {
  // A Gaussian ball of variance s through a Gaussian profile of variances v is a product of Gaussians of variances s +
  // v, in closed form. Trilinear interpolation adds f (1 - f) to a variance, 1/6 on average. In-plane axes differ:
  // pixels of 2 x 1 voxels show whether x and y are what they should be.
  const double s = 16.;
  const torch::Tensor ball = torch::exp(-squared_radius() / (2 * s)).to(torch::kFloat32);
  for (const double thickness : {1., 2., 3., 5., 8.}) {
    for (const auto& pixel : {std::array<double, 2>{1., 1.}, {2., 1.}, {1., 2.5}}) {
      const std::vector<double> distances = {0., 1.7, -5.2};
      const AcquisitionGeometry geometry = slices_at(distances, {pixel[0], pixel[1], thickness});
      const std::array<double, 3> v = variances(geometry.psf);
      const torch::Tensor slices = SliceAcquisition(geometry, 17, 18, kShape, GetParam()).forward(ball);
      const auto along = [&](double variance, const torch::Tensor& offset) {
        const double wide = s + variance + 1. / 6.;
        return std::sqrt(s / wide) * torch::exp(-offset.square() / (2 * wide));
      };
      const torch::Tensor x = torch::arange(18, torch::kFloat64) - 8.5, y = torch::arange(17, torch::kFloat64) - 8.;
      for (std::size_t i = 0; i < distances.size(); ++i) {
        const torch::Tensor z = torch::full({1, 1}, distances[i], torch::kFloat64);
        const torch::Tensor expected = along(v[0], x.view({1, -1})) * along(v[1], y.view({-1, 1})) * along(v[2], z);
        const double error = (slices[static_cast<std::int64_t>(i)][0] - expected).abs().max().item<double>() /
                             expected.max().item<double>();
        // Interpolation varies by 1/12 around its mean (0.25 % of s per axis), and the profile ends at 1e-3 of its
        // peak, which cuts the tails of the thickest (measured: 0.0105 there).
        EXPECT_LT(error, 0.015) << "thickness " << thickness << ", pixel " << pixel[0] << " x " << pixel[1];
      }
    }
  }
}

TEST_P(AnalyticSlice, SphereIsACutThroughABall) {
  // A ball of radius 15, each voxel the share of it inside, through slices 1 to 8 voxels thick: the integral over the
  // profile of the disc at each depth, with the disc's edge softened by pixel, voxel and interpolation.
  const double radius = 15.;
  torch::Tensor ball = torch::zeros({kShape[0], kShape[1], kShape[2]}, torch::kFloat64);
  // The share of a voxel inside, of the plane that touches the sphere there: linear within half a voxel of it.
  ball = (radius - squared_radius().sqrt() + 0.5).clamp(0., 1.);
  for (const double thickness : {1., 2., 4., 8.}) {
    const std::vector<double> distances = {0., 3., -8., 11.5};
    const AcquisitionGeometry geometry = slices_at(distances, {1., 1., thickness});
    const std::array<double, 3> v = variances(geometry.psf);
    const torch::Tensor slices =
        SliceAcquisition(geometry, 37, 37, kShape, GetParam()).forward(ball.to(torch::kFloat32));
    const torch::Tensor along = torch::arange(37, torch::kFloat64) - 18.;
    const torch::Tensor from_centre = (along.view({-1, 1}).square() + along.view({1, -1}).square()).sqrt();
    // In plane: pixel (its profile), the voxel's own width (1/12) and interpolation (1/6).
    const double edge = std::sqrt(v[0] + 1. / 12. + 1. / 6.), depth = std::sqrt(v[2] + 1. / 12. + 1. / 6.);
    for (std::size_t i = 0; i < distances.size(); ++i) {
      torch::Tensor expected = torch::zeros_like(from_centre);
      double total = 0.;
      for (double z = -4. * depth; z <= 4. * depth; z += 0.05) {
        const double weight = std::exp(-0.5 * z * z / (depth * depth));
        const double at = distances[i] + z, squared = radius * radius - at * at;
        total += weight;
        if (squared <= 0.) continue;
        expected += weight * 0.5 * torch::erfc((from_centre - std::sqrt(squared)) / (edge * std::sqrt(2.)));
      }
      expected /= total;
      const torch::Tensor slice = slices[static_cast<std::int64_t>(i)][0].to(torch::kFloat64);
      const torch::Tensor off = (slice - expected).abs();
      const auto what = [&] {
        return "thickness " + std::to_string(thickness) + ", distance " + std::to_string(distances[i]);
      };
      // The disc's edge is taken as straight, and the voxels' as smooth: up to a tenth at single pixels of the edge
      // (half a voxel's width of it is 0.3 of intensity), little on average.
      EXPECT_LT(off.max().item<double>(), 0.1) << what();
      EXPECT_LT(off.mean().item<double>(), 0.006) << what();
      EXPECT_NEAR(slice.sum().item<double>() / expected.sum().item<double>(), 1., 0.01) << what();
      EXPECT_LT(slice.index({from_centre > 18.}).abs().max().item<double>(), 0.01) << what();
    }
  }
}

TEST_P(AnalyticSlice, ZeroSlicesOneSliceAndVolumesOfAllSizes) {
  for (const std::int64_t size : {1, 2, 3, 8, 9}) {
    for (const std::int64_t count : {0, 1}) {
      const AcquisitionGeometry geometry =
          slices_at(std::vector<double>(static_cast<std::size_t>(count), 0.), {1., 1., 2.});
      const SliceAcquisition a(geometry, 5, 6, {size, size + 1, size + 2}, GetParam());
      torch::Tensor weight;
      const torch::Tensor slices = a.forward(torch::full({size, size + 1, size + 2}, 2.F), &weight);
      ASSERT_EQ(slices.sizes(), (std::vector<std::int64_t>{count, 1, 5, 6}));
      const torch::Tensor covered = weight > 0;
      EXPECT_EQ(covered.any().item<bool>(), count > 0 && size > 1) << size;
      if (covered.any().item<bool>()) {
        EXPECT_LT((slices.index({covered}) - 2.F).abs().max().item<float>(), 1e-5F) << size;
      }
      for (const bool equalize : {false, true}) {
        const torch::Tensor volume = a.adjoint(torch::ones_like(slices), equalize);
        ASSERT_EQ(volume.sizes(), (std::vector<std::int64_t>{size, size + 1, size + 2}));
        EXPECT_TRUE(torch::isfinite(volume).all().item<bool>());
        const bool empty = (volume.abs().sum() == 0).item<bool>();
        // In between, too little of the profile may be inside for any pixel to be scattered.
        if (count == 0 || size == 1) {
          EXPECT_TRUE(empty) << size;
        } else if (size >= 8) {
          EXPECT_FALSE(empty) << size;
        }
      }
    }
  }
}

INSTANTIATE_TEST_SUITE_P(BothFormulations, AnalyticSlice,
                         testing::Values(AcquisitionFormulation::exact, AcquisitionFormulation::fast),
                         [](const auto& parameter) { return std::string(to_string(parameter.param)); });

TEST(FastAdjoint, IsCloserToTheProfileThanItsExactTapsAre) {
  // Taps one voxel apart, each in one cell of voxels, leave a pattern in the plain adjoint of a few oblique slices. The
  // same profile with taps a third of a voxel apart is what both formulations stand for.
  torch::manual_seed(21);
  constexpr int kPixels = 30, kThirds = 3;
  for (const double ratio : {1., 1.25}) {
    AcquisitionGeometry geometry = slices_at(std::vector<double>(24, 0.), {ratio, ratio, 3. * ratio});
    for (std::int64_t i = 0; i < 24; ++i) {
      geometry.transforms = geometry.transforms.clone();
      geometry.transforms[i][2][3] = static_cast<double>(i) - 11.5;
    }
    geometry.resolution_ratio = ratio;
    const torch::Tensor along = torch::arange(kPixels, torch::kFloat32) * 0.5;
    const torch::Tensor slices = (1. + 0.3 * torch::sin(along).view({-1, 1}) * torch::cos(along).view({1, -1}))
                                     .expand({24, 1, kPixels, kPixels})
                                     .contiguous();
    const auto adjoint = [&](const AcquisitionGeometry& of, AcquisitionFormulation formulation) {
      return SliceAcquisition(of, kPixels, kPixels, kShape, formulation).adjoint(slices, /*equalize=*/false);
    };
    const std::array<double, 3> v = variances(geometry.psf);
    torch::Tensor fine = torch::zeros({kShape[0], kShape[1], kShape[2]});
    double total = 0.;
    for (int part = 0; part < kThirds * kThirds * kThirds; ++part) {
      const std::array<int, 3> third = {part % kThirds - 1, part / kThirds % kThirds - 1, part / kThirds / kThirds - 1};
      torch::Tensor exponent = torch::zeros({19, 13, 13}, torch::kFloat64);
      AcquisitionGeometry moved = geometry;
      moved.transforms = geometry.transforms.clone();
      for (std::int64_t axis = 0; axis < 3; ++axis) {
        const double shift = third[static_cast<std::size_t>(axis)] / 3.;
        const std::int64_t count = axis == 2 ? 19 : 13;
        std::vector<std::int64_t> view = {1, 1, 1};
        view[static_cast<std::size_t>(2 - axis)] = count;
        const torch::Tensor offset =
            torch::arange(count, torch::kFloat64) - static_cast<double>(count - 1) / 2. + shift;
        exponent = exponent + (offset.square() / (2 * v[static_cast<std::size_t>(axis)])).view(view);
        moved.transforms.select(2, 3).select(1, axis) += shift;
      }
      torch::Tensor psf = torch::exp(-exponent);
      psf = psf.masked_fill(psf < 1e-3, 0.);
      const double share = psf.sum().item<double>();
      moved.psf = (psf / share).to(torch::kFloat32);
      fine += adjoint(moved, AcquisitionFormulation::exact) * share;
      total += share;
    }
    fine /= total;
    const auto distance = [](const torch::Tensor& a, const torch::Tensor& b) {
      return ((a - b).norm() / b.norm()).item<double>();
    };
    const torch::Tensor exact = adjoint(geometry, AcquisitionFormulation::exact);
    const torch::Tensor fast = adjoint(geometry, AcquisitionFormulation::fast);
    std::cout << "ratio " << ratio << ": fast from exact " << distance(fast, exact) << ", fast from fine "
              << distance(fast, fine) << ", exact from fine " << distance(exact, fine) << "\n";
    EXPECT_LT(distance(fast, fine), 0.6 * distance(exact, fine));
    EXPECT_LT(distance(fast, exact), ratio == 1. ? 0.04 : 0.07);
  }
}

}  // namespace
}  // namespace svort
