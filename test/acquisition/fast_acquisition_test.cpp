#include <ATen/Parallel.h>
#include <gtest/gtest.h>
#include <torch/types.h>

#include <cmath>
#include <string>
#include <vector>

#include "svort_ros/acquisition/point_spread_function.h"
#include "svort_ros/acquisition/slice_acquisition.h"
#include "svort_ros/geometry/rigid_transform.h"

namespace svort {
namespace {

constexpr int kVoxels = 56, kPixels = 44;
constexpr std::array<std::int64_t, 3> kShape = {kVoxels, kVoxels + 1, kVoxels};

// Signed voxel coordinate along an axis, broadcast over the other two.
torch::Tensor axis(int dimension) {
  std::vector<std::int64_t> view = {1, 1, 1};
  view[static_cast<std::size_t>(dimension)] = -1;
  const std::int64_t count = kShape[static_cast<std::size_t>(dimension)];
  return (torch::arange(count) - static_cast<double>(count - 1) / 2.).view(view);
}

// An ellipsoid with folds of about 6 voxels and an edge of about 1 voxel; nothing around it.
torch::Tensor brain() {
  const torch::Tensor z = axis(0), y = axis(1), x = axis(2);
  const torch::Tensor radius = torch::sqrt((x / 17.).square() + (y / 20.).square() + (z / 16.).square());
  const torch::Tensor folds = 1. + 0.3 * torch::sin(x + 0.4 * y) * torch::cos(0.8 * z - 0.3 * x);
  return (folds * torch::sigmoid((1. - radius) * 20.)).masked_fill(radius > 1.3, 0.).to(torch::kFloat32).contiguous();
}

AcquisitionGeometry random_slices(int count, double ratio, double thickness) {
  AcquisitionGeometry geometry;
  geometry.transforms = axisangle_to_matrix(
      torch::cat({torch::randn({count, 3}) * 1.5, torch::randn({count, 2}), (torch::rand({count, 1}) * 2 - 1) * 15},
                 /*dim=*/1));
  geometry.psf = gaussian_psf({ratio, ratio, thickness});
  geometry.resolution_ratio = ratio;
  return geometry;
}

SliceAcquisition with(AcquisitionFormulation formulation, const AcquisitionGeometry& geometry,
                      const AcquisitionMasks& masks = {}) {
  return SliceAcquisition(geometry, kPixels, kPixels, kShape, formulation, masks);
}

double relative_l2(const torch::Tensor& a, const torch::Tensor& b) {
  return ((a - b).norm() / b.norm()).item<double>();
}

double inner_product(const torch::Tensor& a, const torch::Tensor& b) {
  return (a.to(torch::kFloat64) * b.to(torch::kFloat64)).sum().item<double>();
}

class FastAcquisition : public testing::Test {
 protected:
  void SetUp() override { torch::manual_seed(11); }
};

TEST_F(FastAcquisition, IsWithinOnePercentOfTheExactFormulation) {
  const torch::Tensor volume = brain();
  for (const double ratio : {1., 1.25}) {
    const AcquisitionGeometry geometry = random_slices(60, ratio, 3. * ratio);
    const SliceAcquisition exact = with(AcquisitionFormulation::exact, geometry);
    const SliceAcquisition fast = with(AcquisitionFormulation::fast, geometry);
    const torch::Tensor slices = exact.forward(volume);
    const double forward = relative_l2(fast.forward(volume), slices);
    const torch::Tensor psf_reconstruction = exact.adjoint(slices, /*equalize=*/true);
    // The rim, where next to no weight decides about everything or nothing, is left out.
    const torch::Tensor inside = exact.adjoint(torch::ones_like(slices), /*equalize=*/false) > 0.1;
    const double equalized = relative_l2(fast.adjoint(slices, /*equalize=*/true) * inside, psf_reconstruction * inside);
    // Voxel by voxel the plain adjoint shows how taps fall between voxels; seen through A that is gone.
    const torch::Tensor plain = exact.adjoint(slices, /*equalize=*/false);
    const double seen = relative_l2(exact.forward(fast.adjoint(slices, /*equalize=*/false)), exact.forward(plain));
    const double voxel_by_voxel = relative_l2(fast.adjoint(slices, /*equalize=*/false), plain);
    RecordProperty("forward", std::to_string(forward));
    std::cout << "ratio " << ratio << ": forward " << forward << ", equalised adjoint " << equalized
              << ", plain adjoint seen through A " << seen << ", voxel by voxel " << voxel_by_voxel << "\n";
    EXPECT_LT(forward, 0.01);
    EXPECT_LT(equalized, 0.01);
    EXPECT_LT(seen, 0.01);
    // Above the 0.01 of the others, because of the exact taps: see FastAdjoint in analytic_slice_test.
    EXPECT_LT(voxel_by_voxel, ratio == 1. ? 0.025 : 0.05);
    // What is added up is the same.
    EXPECT_NEAR(fast.adjoint(slices, false).sum().item<double>() / plain.sum().item<double>(), 1., 1e-4);
  }
}

TEST_F(FastAcquisition, HoldsForAllThicknessesAndPixelSizes) {
  const torch::Tensor volume = brain();
  for (const double thickness : {1., 2., 4., 8.}) {
    // Pixels larger than the slice is thick, and pixels that are not square.
    for (const auto& pixel : {std::array<double, 2>{1.25, 1.25}, {1.5, 1.}, {2., 2.}}) {
      AcquisitionGeometry geometry = random_slices(12, 1., 1.);
      geometry.psf = gaussian_psf({pixel[0], pixel[1], thickness});
      const double error = relative_l2(with(AcquisitionFormulation::fast, geometry).forward(volume),
                                       with(AcquisitionFormulation::exact, geometry).forward(volume));
      EXPECT_LT(error, 0.01) << "thickness " << thickness << ", pixel " << pixel[0] << " x " << pixel[1];
    }
  }
}

TEST_F(FastAcquisition, ConstantIsAConstantWhereCovered) {
  AcquisitionGeometry geometry = random_slices(6, 1.5, 4.);  // sticks out
  AcquisitionMasks masks;
  for (const bool masked : {false, true}) {
    if (masked) masks.volume = torch::rand({kShape[0], kShape[1], kShape[2]}) > 0.5;
    torch::Tensor weight;
    const torch::Tensor slices = with(AcquisitionFormulation::fast, geometry, masks)
                                     .forward(torch::full({kShape[0], kShape[1], kShape[2]}, 3.F), &weight);
    const torch::Tensor covered = weight > 0;
    ASSERT_GT(covered.sum().item<std::int64_t>(), 1000);
    ASSERT_GT((~covered).sum().item<std::int64_t>(), 100);
    EXPECT_LT((slices.index({covered}) - 3.F).abs().max().item<float>(), 2e-5F);  // float32 sums
    EXPECT_EQ(slices.index({~covered}).abs().sum().item<float>(), 0.F);
    EXPECT_LT(weight.max().item<float>(), 1.F + 1e-5F);
  }
}

TEST_F(FastAcquisition, AdjointAndNormalOperatorBelongTogether) {
  const AcquisitionGeometry geometry = random_slices(9, 1.25, 3.75);
  torch::Tensor weight;
  const torch::Tensor volume = torch::rand({kShape[0], kShape[1], kShape[2]});
  with(AcquisitionFormulation::fast, geometry).forward(volume, &weight);
  AcquisitionMasks masks;
  masks.slices = weight >= 0.5;
  ASSERT_LT(masks.slices.sum().item<std::int64_t>(), masks.slices.numel());
  for (const auto formulation : {AcquisitionFormulation::exact, AcquisitionFormulation::fast}) {
    if (formulation == AcquisitionFormulation::exact) {
      with(formulation, geometry).forward(volume, &weight);
      masks.slices = weight >= 0.5;
    }
    const SliceAcquisition a = with(formulation, geometry, masks);
    const torch::Tensor y = torch::randn_like(weight), w = torch::rand({9}), bright = torch::rand_like(weight) + 1;
    const double left = inner_product(a.forward(volume), y);
    EXPECT_NEAR(left, inner_product(volume, a.adjoint(y, /*equalize=*/false)), 1e-4 * y.norm().item<double>())
        << to_string(formulation);
    // One pass is the same as two.
    const torch::Tensor two = a.adjoint(a.forward(volume) * w.view({-1, 1, 1, 1}), /*equalize=*/false);
    EXPECT_LT(relative_l2(a.normal(volume, w), two), 1e-6) << to_string(formulation);
    // Float64 sums hold what the float32 ones do, and slices can be taken away again.
    torch::Tensor sums = a.empty_sums();
    a.add_to_sums(bright, 1., &sums);
    EXPECT_LT(relative_l2(a.equalized_volume(sums), a.adjoint(bright, /*equalize=*/true)), 1e-4);
    a.add_to_sums(bright, -1., &sums);
    EXPECT_LT(sums.abs().max().item<double>(), 1e-12);
    EXPECT_EQ(a.equalized_volume(sums).abs().sum().item<float>(), 0.F);
    masks.slices = weight >= 0.5;
  }
}

TEST_F(FastAcquisition, SphereHasItsProfile) {
  // A slice through the centre of a ball of radius 14: 1 well inside, 0 well outside, half at the edge of a thin slice.
  const torch::Tensor radius = torch::sqrt(axis(0).square() + axis(1).square() + axis(2).square());
  const torch::Tensor ball = (radius < 14.).to(torch::kFloat32).expand({kShape[0], kShape[1], kShape[2]}).contiguous();
  AcquisitionGeometry geometry = random_slices(5, 1., 2.);
  geometry.transforms = geometry.transforms.clone();
  geometry.transforms.select(2, 3).zero_();
  const torch::Tensor slices = with(AcquisitionFormulation::fast, geometry).forward(ball);
  const torch::Tensor along = torch::arange(kPixels) - (kPixels - 1) / 2.;
  const torch::Tensor from_centre = torch::sqrt(along.view({-1, 1}).square() + along.view({1, -1}).square());
  for (std::int64_t i = 0; i < 5; ++i) {
    const torch::Tensor slice = slices[i][0];
    EXPECT_LT((slice.index({from_centre < 9.}) - 1.F).abs().max().item<float>(), 1e-5F);
    EXPECT_LT(slice.index({from_centre > 19.}).abs().max().item<float>(), 1e-5F);
    // Voxels make the ball's edge rough: a tenth of a voxel there is 0.05 of intensity.
    const double ring = slice.index({(from_centre > 13.5) & (from_centre < 14.5)}).mean().item<double>();
    EXPECT_NEAR(ring, 0.5, 0.1);
  }
}

TEST_F(FastAcquisition, NoSlicesOneSliceAndSlicesOutside) {
  AcquisitionGeometry geometry = random_slices(1, 1., 3.);
  EXPECT_GT(with(AcquisitionFormulation::fast, geometry).forward(brain()).sum().item<float>(), 0.F);
  geometry.transforms = geometry.transforms.clone();
  geometry.transforms.select(2, 3).fill_(1e20F);
  const SliceAcquisition far = with(AcquisitionFormulation::fast, geometry);
  EXPECT_EQ(far.forward(brain()).abs().sum().item<float>(), 0.F);
  EXPECT_EQ(far.normal(brain()).abs().sum().item<float>(), 0.F);
  geometry.transforms = torch::zeros({0, 3, 4});
  const SliceAcquisition none = with(AcquisitionFormulation::fast, geometry);
  EXPECT_EQ(none.forward(brain()).numel(), 0);
  EXPECT_EQ(none.adjoint(torch::zeros({0, 1, kPixels, kPixels}), true).abs().sum().item<float>(), 0.F);
}

TEST_F(FastAcquisition, SameBytesForAnyThreadCount) {
  const SliceAcquisition a = with(AcquisitionFormulation::fast, random_slices(12, 1.25, 3.75));
  const torch::Tensor volume = torch::rand({kShape[0], kShape[1], kShape[2]});
  const int before = at::get_num_threads();
  std::vector<torch::Tensor> expected;
  for (const int threads : {1, 2, 5}) {
    at::set_num_threads(threads);
    const torch::Tensor slices = a.forward(volume);
    const std::vector<torch::Tensor> results = {slices, a.adjoint(slices, false), a.adjoint(slices, true),
                                                a.normal(volume)};
    if (expected.empty()) expected = results;
    for (std::size_t i = 0; i < results.size(); ++i) {
      EXPECT_TRUE(torch::equal(results[i], expected[i])) << threads << " threads, result " << i;
    }
  }
  at::set_num_threads(before);
}

TEST_F(FastAcquisition, RefusesPsfsThatAreNoGaussians) {
  AcquisitionGeometry geometry = random_slices(2, 1., 3.);
  const auto message = [&] {
    try {
      with(AcquisitionFormulation::fast, geometry);
    } catch (const std::invalid_argument& error) {
      return std::string(error.what());
    }
    return std::string("accepted");
  };
  EXPECT_EQ(message(), "accepted");
  geometry.psf = torch::full({5, 3, 3}, 1.F / 45.F);  // a box
  EXPECT_NE(message().find("differs from a Gaussian"), std::string::npos) << message();
  geometry.psf = torch::zeros({3, 3, 3});
  geometry.psf[0][1][1] = 1.F;
  EXPECT_NE(message().find("not centred"), std::string::npos) << message();
  EXPECT_NO_THROW(with(AcquisitionFormulation::exact, geometry));
  EXPECT_THROW(acquisition_formulation("quick"), std::invalid_argument);
  EXPECT_EQ(acquisition_formulation("fast"), AcquisitionFormulation::fast);
}

}  // namespace
}  // namespace svort
