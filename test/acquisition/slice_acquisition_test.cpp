#include "svort_ros/acquisition/slice_acquisition.h"

#include <ATen/Parallel.h>
#include <gtest/gtest.h>
#include <torch/types.h>

#include <cmath>
#include <functional>
#include <limits>

#include "svort_ros/acquisition/point_spread_function.h"
#include "svort_ros/geometry/rigid_transform.h"

namespace svort {
namespace {

// Restores LibTorch's thread setting.
class ThreadCount {
 public:
  explicit ThreadCount(int count) : before_(at::get_num_threads()) { at::set_num_threads(count); }
  ~ThreadCount() { at::set_num_threads(before_); }

 private:
  int before_;
};

// Slices through the middle of the volume in random orientations, shifted by up to `shift` voxels.
AcquisitionGeometry random_geometry(int slices, double shift, double ratio = 1.25, double thickness = 3.75) {
  AcquisitionGeometry geometry;
  geometry.transforms = axisangle_to_matrix(
      torch::cat({torch::randn({slices, 3}), (torch::rand({slices, 3}) * 2 - 1) * shift}, /*dim=*/1));
  geometry.psf = gaussian_psf({ratio, ratio, thickness});
  geometry.resolution_ratio = ratio;
  return geometry;
}

double inner_product(const torch::Tensor& a, const torch::Tensor& b) {
  return (a.to(torch::kFloat64) * b.to(torch::kFloat64)).sum().item<double>();
}

class AcquisitionOperator : public testing::Test {
 protected:
  void SetUp() override { torch::manual_seed(7); }
};

TEST_F(AcquisitionOperator, ConstantVolumeGivesTheConstantWhereCovered) {
  // Odd and even sizes, slices that stick out.
  for (const auto& shape : {std::array<std::int64_t, 3>{20, 23, 26}, {21, 20, 19}, {9, 40, 17}}) {
    const AcquisitionGeometry geometry = random_geometry(5, 4.);
    torch::Tensor weight;
    const torch::Tensor slices =
        acquire_slices(torch::full({shape[0], shape[1], shape[2]}, 3.F), geometry, 32, 27, {}, &weight);
    const torch::Tensor covered = weight > 0;
    ASSERT_GT(covered.sum().item<std::int64_t>(), 100);
    ASSERT_GT((~covered).sum().item<std::int64_t>(), 100);
    // Weights sum up to rounding only.
    EXPECT_LT((slices.index({covered}) - 3.F).abs().max().item<float>(), 1e-5F);
    EXPECT_EQ(slices.index({~covered}).abs().sum().item<float>(), 0.F);
    EXPECT_LT(weight.max().item<float>(), 1.F + 1e-5F);
  }
}

TEST_F(AcquisitionOperator, LinearRampIsReproducedInTheInterior) {
  // A symmetric PSF and trilinear interpolation leave a linear function as it is: positions are checked, with their
  // signs.
  const std::array<std::int64_t, 3> shape = {40, 44, 47};
  const auto axis = [](std::int64_t count) {
    return torch::arange(count, torch::kFloat32) - static_cast<double>(count - 1) / 2.;
  };
  const torch::Tensor volume =
      2 * axis(shape[2]).view({1, 1, -1}) - 3 * axis(shape[1]).view({1, -1, 1}) + 5 * axis(shape[0]).view({-1, 1, 1});
  const AcquisitionGeometry geometry = random_geometry(4, 1.);
  const int height = 10, width = 12;
  torch::Tensor weight;
  const torch::Tensor slices = acquire_slices(volume, geometry, height, width, {}, &weight);
  ASSERT_GT(weight.min().item<float>(), 0.999F);
  const torch::Tensor x = (axis(width) * geometry.resolution_ratio).view({1, -1}).expand({height, width});
  const torch::Tensor y = (axis(height) * geometry.resolution_ratio).view({-1, 1}).expand({height, width});
  const torch::Tensor points = torch::stack({x, y, torch::zeros_like(x)}, -1).reshape({1, -1, 3}).to(torch::kFloat32);
  const torch::Tensor placed = transform_points(geometry.transforms, points);
  const torch::Tensor expected = torch::matmul(placed, torch::tensor({2.F, -3.F, 5.F})).view_as(slices);
  EXPECT_LT((slices - expected).abs().max().item<float>(), 2e-3F);  // values reach 100; float32, sums of 1192 terms
}

TEST_F(AcquisitionOperator, ScatterIsTheAdjoint) {
  for (const double thickness : {1., 3.75}) {
    const AcquisitionGeometry geometry = random_geometry(9, 6., 1.25, thickness);
    const torch::Tensor volume = torch::rand({30, 33, 28});
    torch::Tensor weight;
    acquire_slices(volume, geometry, 24, 31, {}, &weight);
    AcquisitionMasks masks;
    masks.slices = weight >= 0.5;  // the pixels that the scatter uses
    ASSERT_GT(masks.slices.sum().item<std::int64_t>(), 1000);
    ASSERT_LT(masks.slices.sum().item<std::int64_t>(), masks.slices.numel());
    const torch::Tensor y = torch::randn({9, 1, 24, 31});
    const double left = inner_product(acquire_slices(volume, geometry, 24, 31, masks), y);
    const double right = inner_product(volume, scatter_slices(y, geometry, {30, 33, 28}, /*equalize=*/false, masks));
    EXPECT_NEAR(left, right, 1e-5 * std::abs(left) + 1e-3);  // about 5000 float32 terms of mixed sign
  }
}

TEST_F(AcquisitionOperator, EqualizedScatterOfAConstantIsTheConstant) {
  const AcquisitionGeometry geometry = random_geometry(6, 3.);
  const torch::Tensor ones = torch::full({6, 1, 20, 20}, 2.F);
  const torch::Tensor volume = scatter_slices(ones, geometry, {30, 30, 30}, /*equalize=*/true);
  const torch::Tensor reached = scatter_slices(ones, geometry, {30, 30, 30}, /*equalize=*/false) > 0;
  ASSERT_GT(reached.sum().item<std::int64_t>(), 1000);
  EXPECT_LT((volume.index({reached}) - 2.F).abs().max().item<float>(), 1e-5F);
  EXPECT_EQ(volume.index({~reached}).abs().sum().item<float>(), 0.F);
}

TEST_F(AcquisitionOperator, MasksConfineBothDirections) {
  const AcquisitionGeometry geometry = random_geometry(4, 3.);
  const torch::Tensor volume = torch::rand({24, 24, 24}) + 1;
  AcquisitionMasks masks;
  masks.slices = torch::rand({4, 1, 26, 26}) > 0.4;
  const torch::Tensor all = acquire_slices(volume, geometry, 26, 26);
  EXPECT_TRUE(torch::equal(acquire_slices(volume, geometry, 26, 26, masks), all * masks.slices));

  // Values outside the volume mask have no influence, not even if they are not numbers.
  masks.volume = torch::zeros({24, 24, 24}, torch::kBool);
  masks.volume.slice(0, 5, 20).fill_(true);
  const torch::Tensor damaged = volume.masked_fill(~masks.volume, std::numeric_limits<float>::quiet_NaN());
  const torch::Tensor seen = acquire_slices(damaged, geometry, 26, 26, masks);
  EXPECT_TRUE(torch::isfinite(seen).all().item<bool>());
  EXPECT_TRUE(torch::equal(seen, acquire_slices(volume, geometry, 26, 26, masks)));
  const torch::Tensor covered = seen > 0;
  EXPECT_GT(covered.sum().item<std::int64_t>(), 100);
  EXPECT_GE(seen.index({covered}).min().item<float>(), 1.F - 1e-5F);  // a mean of values in [1, 2], never diluted

  const torch::Tensor scattered = scatter_slices(all, geometry, {24, 24, 24}, /*equalize=*/true, masks);
  EXPECT_EQ(scattered.index({~masks.volume}).abs().sum().item<float>(), 0.F);
  EXPECT_GT(scattered.index({masks.volume}).sum().item<float>(), 0.F);
}

TEST_F(AcquisitionOperator, SlicesOutsideAndNoSlices) {
  AcquisitionGeometry geometry = random_geometry(2, 0.);
  geometry.transforms = geometry.transforms.clone();
  geometry.transforms.select(2, 3).fill_(500.F);
  torch::Tensor weight;
  const torch::Tensor far = acquire_slices(torch::ones({16, 16, 16}), geometry, 8, 8, {}, &weight);
  EXPECT_EQ(far.abs().sum().item<float>(), 0.F);
  EXPECT_EQ(weight.abs().sum().item<float>(), 0.F);
  for (const bool equalize : {false, true}) {
    const torch::Tensor scattered = scatter_slices(torch::ones({2, 1, 8, 8}), geometry, {16, 16, 16}, equalize);
    EXPECT_EQ(scattered.abs().sum().item<float>(), 0.F);
  }
  // Beyond the range of a 32-bit integer too.
  geometry.transforms.select(2, 3).fill_(1e20F);
  EXPECT_EQ(acquire_slices(torch::ones({16, 16, 16}), geometry, 8, 8).abs().sum().item<float>(), 0.F);

  geometry.transforms = torch::zeros({0, 3, 4});
  EXPECT_EQ(acquire_slices(torch::ones({16, 16, 16}), geometry, 8, 9).sizes(), (std::vector<std::int64_t>{0, 1, 8, 9}));
  EXPECT_EQ(scatter_slices(torch::ones({0, 1, 8, 9}), geometry, {5, 6, 7}, true).sizes(),
            (std::vector<std::int64_t>{5, 6, 7}));
}

TEST_F(AcquisitionOperator, VolumeOfOneVoxelHasNoCell) {
  const AcquisitionGeometry geometry = random_geometry(1, 0.);
  EXPECT_EQ(acquire_slices(torch::ones({1, 1, 1}), geometry, 5, 5).abs().sum().item<float>(), 0.F);
}

TEST_F(AcquisitionOperator, PointPsfSamplesTheVolume) {
  // One tap and the identity: pixels are voxels, shifted by half a voxel where sizes are even and odd.
  AcquisitionGeometry geometry;
  geometry.transforms = torch::eye(3, 4).unsqueeze(0);
  geometry.psf = torch::ones({1, 1, 1});
  const torch::Tensor volume = torch::rand({7, 9, 11});
  const torch::Tensor slice = acquire_slices(volume, geometry, 7, 9);
  EXPECT_TRUE(torch::allclose(slice[0][0], volume[3].slice(0, 1, 8).slice(1, 1, 10), 0., 1e-6));
  const torch::Tensor even = acquire_slices(volume, geometry, 7, 8);
  const torch::Tensor between =
      (volume[3].slice(0, 1, 8).slice(1, 1, 9) + volume[3].slice(0, 1, 8).slice(1, 2, 10)) / 2;
  EXPECT_TRUE(torch::allclose(even[0][0], between, 0., 1e-6));
}

TEST_F(AcquisitionOperator, EachSliceHasItsOwnPsf) {
  AcquisitionGeometry several = random_geometry(4, 3.);
  const torch::Tensor thin = gaussian_psf({1.25, 1.25, 2.}), thick = gaussian_psf({1.25, 1.25, 5.});
  several.psf = stack_psfs({thin, thick});
  several.psf_of_slice = torch::tensor({0, 1, 1, 0}, torch::kInt64);
  const torch::Tensor volume = torch::rand({26, 24, 28});
  const torch::Tensor slices = acquire_slices(volume, several, 20, 22);
  const torch::Tensor back = scatter_slices(slices, several, {26, 24, 28}, /*equalize=*/false);
  torch::Tensor sum = torch::zeros_like(back);
  for (std::int64_t i = 0; i < 4; ++i) {
    AcquisitionGeometry one = several;
    one.transforms = several.transforms.slice(0, i, i + 1);
    one.psf = i == 0 || i == 3 ? thin : thick;
    one.psf_of_slice = torch::Tensor();
    EXPECT_TRUE(torch::equal(acquire_slices(volume, one, 20, 22), slices.slice(0, i, i + 1)));
    sum += scatter_slices(slices.slice(0, i, i + 1), one, {26, 24, 28}, /*equalize=*/false);
  }
  EXPECT_TRUE(torch::allclose(back, sum, 1e-5, 1e-6));
  several.psf_of_slice[2] = 2;
  EXPECT_THROW(acquire_slices(volume, several, 20, 22), std::invalid_argument);
  several.psf_of_slice = torch::Tensor();
  EXPECT_THROW(acquire_slices(volume, several, 20, 22), std::invalid_argument);
}

TEST_F(AcquisitionOperator, SameBytesForAnyThreadCount) {
  const AcquisitionGeometry geometry = random_geometry(12, 8.);
  const torch::Tensor volume = torch::rand({40, 36, 38});
  AcquisitionMasks masks;
  masks.slices = torch::rand({12, 1, 30, 30}) > 0.2;
  masks.volume = torch::rand({40, 36, 38}) > 0.1;
  const auto compute = [&](int threads) {
    const ThreadCount setting(threads);
    const torch::Tensor slices = acquire_slices(volume, geometry, 30, 30, masks);
    return std::vector<torch::Tensor>{slices, scatter_slices(slices, geometry, {40, 36, 38}, false, masks),
                                      scatter_slices(slices, geometry, {40, 36, 38}, true, masks)};
  };
  const auto expected = compute(1);
  for (const int threads : {1, 2, 3, 7, 64}) {
    const auto actual = compute(threads);
    for (std::size_t i = 0; i < expected.size(); ++i) {
      EXPECT_TRUE(torch::equal(actual[i], expected[i])) << threads << " threads, result " << i;
    }
  }
}

TEST_F(AcquisitionOperator, AcceptsStridedInput) {
  AcquisitionGeometry geometry = random_geometry(3, 2.);
  const torch::Tensor volume = torch::rand({20, 22, 24});
  const torch::Tensor expected = acquire_slices(volume, geometry, 16, 18);
  const torch::Tensor transposed = volume.transpose(0, 2).contiguous().transpose(0, 2);
  ASSERT_FALSE(transposed.is_contiguous());
  geometry.transforms = geometry.transforms.transpose(1, 2).contiguous().transpose(1, 2);
  EXPECT_TRUE(torch::equal(acquire_slices(transposed, geometry, 16, 18), expected));
}

TEST_F(AcquisitionOperator, RejectsWhatDoesNotFit) {
  const AcquisitionGeometry good = random_geometry(2, 1.);
  const torch::Tensor volume = torch::rand({12, 12, 12});
  const auto message_of = [&](const std::function<void()>& call) -> std::string {
    try {
      call();
    } catch (const std::invalid_argument& error) {
      return error.what();
    }
    return "no exception";
  };
  const auto with = [&](const std::function<void(AcquisitionGeometry*)>& change) {
    AcquisitionGeometry geometry = good;
    change(&geometry);
    return message_of([&] { acquire_slices(volume, geometry, 8, 8); });
  };
  const auto names = [](const std::string& message, const std::string& name) {
    EXPECT_NE(message.find(name), std::string::npos) << message;
  };
  names(with([](auto* g) { g->transforms = torch::zeros({2, 4, 4}); }), "geometry.transforms");
  names(with([](auto* g) { g->transforms = g->transforms.to(torch::kInt64); }), "geometry.transforms");
  names(with([](auto* g) { g->transforms = g->transforms.to(torch::kFloat64); }),
        "volume must be 12 x 12 x 12, Double");
  names(with([](auto* g) { g->transforms = torch::full({2, 3, 4}, NAN); }), "not finite");
  names(with([](auto* g) { g->psf = torch::ones({3, 3}); }), "geometry.psf");
  names(with([](auto* g) { g->psf = torch::Tensor(); }), "undefined");
  names(with([](auto* g) { g->resolution_ratio = 0.; }), "resolution_ratio");
  names(message_of([&] { acquire_slices(volume.to(torch::kFloat64), good, 8, 8); }), "volume");
  names(message_of([&] { acquire_slices(volume.unsqueeze(0), good, 8, 8); }), "volume");
  names(message_of([&] { acquire_slices(volume, good, 0, 8); }), "pixel");
  AcquisitionMasks masks;
  masks.slices = torch::ones({2, 1, 8, 9}, torch::kBool);
  names(message_of([&] { acquire_slices(volume, good, 8, 8, masks); }), "masks.slices");
  masks.slices = torch::ones({2, 1, 8, 8});
  names(message_of([&] { acquire_slices(volume, good, 8, 8, masks); }), "masks.slices");
  masks.slices = torch::Tensor();
  masks.volume = torch::ones({12, 12, 13}, torch::kBool);
  names(message_of([&] { acquire_slices(volume, good, 8, 8, masks); }), "masks.volume");
  const torch::Tensor slices = torch::rand({2, 1, 8, 8});
  names(message_of([&] { scatter_slices(slices[0], good, {12, 12, 12}, false); }), "slices");
  names(message_of([&] { scatter_slices(slices.slice(0, 0, 1), good, {12, 12, 12}, false); }), "same count");
  names(message_of([&] { scatter_slices(slices, good, {12, 0, 12}, false); }), "voxel");
  names(message_of([&] { scatter_slices(slices, good, {4096, 4096, 4096}, false); }), "2^31");
}

}  // namespace
}  // namespace svort
