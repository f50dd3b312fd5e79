#include "svort_ros/reconstruction/final_volume.h"

#include <ATen/Parallel.h>
#include <gtest/gtest.h>
#include <torch/types.h>

#include <cmath>
#include <functional>
#include <stdexcept>

#include "../../src/reconstruction/edge_prior.h"
#include "svort_ros/acquisition/point_spread_function.h"
#include "svort_ros/geometry/rigid_transform.h"
#include "svort_ros/reconstruction/volume_estimation.h"

namespace svort {
namespace {

constexpr std::int64_t kSize = 40;
constexpr int kPerStack = 15, kPixels = 36;

/// A ball with two inner parts, 0 outside. Its edges are two voxels wide: sharper ones would ring in any
/// reconstruction.
torch::Tensor phantom() {
  torch::Tensor volume = torch::zeros({kSize, kSize, kSize});
  auto value = volume.accessor<float, 3>();
  const auto inside = [](double distance, double radius) { return 0.5 * (1. - std::tanh((distance - radius) / 1.2)); };
  for (int z = 0; z < kSize; ++z)
    for (int y = 0; y < kSize; ++y)
      for (int x = 0; x < kSize; ++x) {
        const double u = x - 19.5, v = y - 19.5, w = z - 19.5;
        if (std::hypot(u, v, w) > 17.) continue;
        value[z][y][x] =
            static_cast<float>(0.6 * inside(std::hypot(u, v, w), 14.) + 0.4 * inside(std::hypot(u - 5., v, w), 4.) -
                               0.4 * inside(std::hypot(u + 4., v - 4., w + 2.), 3.));
      }
  return volume.clamp_min(0.);
}

/// Three orthogonal stacks, slices 2 voxels apart and 3 thick.
struct Scan {
  AcquisitionGeometry geometry;
  torch::Tensor truth, slices, masks, weights;

  Scan() {
    torch::Tensor axisangle = torch::zeros({3 * kPerStack, 6});
    for (int stack = 0; stack < 3; ++stack)
      for (int i = 0; i < kPerStack; ++i) {
        torch::Tensor row = axisangle[stack * kPerStack + i];
        if (stack > 0) row[stack - 1] = M_PI / 2;
        row[5] = 2. * (i - 0.5 * (kPerStack - 1));
      }
    geometry.transforms = axisangle_to_matrix(axisangle + 0.01);  // off the lattice
    geometry.psf = gaussian_psf({1., 1., 3.});
    truth = phantom();
    const SliceAcquisition clean(geometry, kPixels, kPixels, {kSize, kSize, kSize}, AcquisitionFormulation::fast);
    slices = clean.forward(truth);
    masks = (clean.forward((truth > 0).to(torch::kFloat32)) > 0.5).contiguous();
    slices = (slices * masks).contiguous();
    weights = torch::ones({3 * kPerStack});
  }
  SliceAcquisition acquisition() const {
    return SliceAcquisition(geometry, kPixels, kPixels, {kSize, kSize, kSize}, AcquisitionFormulation::fast,
                            {masks, {}});
  }
  /// Root mean square difference over the phantom after the best gain, in units of its brightest part.
  double error(const torch::Tensor& volume) const {
    const torch::Tensor inside = truth > 0;
    const torch::Tensor a = volume.masked_select(inside), b = truth.masked_select(inside);
    const torch::Tensor gain = (a * b).sum() / (a * a).sum();
    return (a * gain - b).square().mean().sqrt().item<double>();
  }
};

TEST(FinalVolume, IsSharperThanThePsfReconstruction) {
  const Scan scan;
  FinalVolumeOptions options;
  options.scale_spread = 0.;  // the slices' intensities are as they should be: what is left is the inverse problem
  const double psf = scan.error(reconstruct_psf(scan.slices, scan.acquisition(), scan.weights));
  const FinalVolume final =
      reconstruct_final_volume(scan.slices, scan.acquisition(), scan.masks, scan.weights, 1., options);
  const double error = scan.error(final.volume);
  const double matched =
      scan.error(reconstruct_final_volume(scan.slices, scan.acquisition(), scan.masks, scan.weights, 1.).volume);
  RecordProperty("psf", std::to_string(psf));
  RecordProperty("final", std::to_string(error));
  RecordProperty("final_matched", std::to_string(matched));
  EXPECT_LT(error, 0.75 * psf) << "PSF " << psf;
  EXPECT_LT(matched, psf) << "matching intensities that need none costs something, but not all";
  EXPECT_GE(final.volume.min().item<float>(), 0.F);
}

TEST(FinalVolume, FindsScaleAndBiasOfTheSlices) {
  const Scan scan;
  torch::manual_seed(3);
  const torch::Tensor log_scale = 0.2 * torch::randn({3 * kPerStack, 1, 1, 1});
  const torch::Tensor axis = (torch::arange(kPixels, torch::kFloat32) - 0.5 * (kPixels - 1)) / 60.;
  const torch::Tensor slope = 0.3 * torch::randn({3 * kPerStack, 1, 1, 1});
  const torch::Tensor distorted = scan.slices * torch::exp(log_scale + slope * axis.view({1, 1, 1, -1}));
  FinalVolumeOptions off;
  off.scale_spread = 0.;
  const FinalVolume unmatched =
      reconstruct_final_volume(distorted, scan.acquisition(), scan.masks, scan.weights, 1., off);
  const FinalVolume matched = reconstruct_final_volume(distorted, scan.acquisition(), scan.masks, scan.weights, 1.);
  const FinalVolume clean = reconstruct_final_volume(scan.slices, scan.acquisition(), scan.masks, scan.weights, 1.);
  EXPECT_LT(scan.error(matched.volume), 0.7 * scan.error(unmatched.volume));
  // Measured: 0.004 of the slices as they should be, 0.014 matched; the PSF reconstruction of the former has 0.041.
  EXPECT_LT(scan.error(clean.volume), 0.01);
  EXPECT_LT(scan.error(matched.volume), 0.02);
  // The scales themselves, against their mean: within 0.06 where they deviate by 0.2. Slices at the rim have few
  // pixels.
  const double shared = log_scale.mean().item<double>();
  double worst = 0.;
  for (int i = 0; i < 3 * kPerStack; ++i) {
    if (scan.masks[i].sum().item<std::int64_t>() < 200) continue;
    worst = std::max(worst,
                     std::abs(matched.fields[static_cast<std::size_t>(i)][0] - (log_scale[i].item<double>() - shared)));
  }
  EXPECT_LT(worst, 0.1);
}

TEST(FinalVolume, PixelsThatFitNowhereCountLittle) {
  const Scan scan;
  torch::Tensor spoilt = scan.slices.clone();
  // A void in one slice through the middle of each stack.
  for (int stack = 0; stack < 3; ++stack) spoilt[stack * kPerStack + 7].slice(1, 12, 24).slice(2, 12, 24).fill_(0.05);
  FinalVolumeOptions tolerant;
  tolerant.outlier_factor = 1e3;
  const auto error = [&](const FinalVolumeOptions& options) {
    return scan.error(
        reconstruct_final_volume(spoilt, scan.acquisition(), scan.masks, scan.weights, 1., options).volume);
  };
  EXPECT_LT(error({}), 0.9 * error(tolerant));
}

TEST(FinalVolume, WithoutPassesItIsThePsfReconstruction) {
  const Scan scan;
  FinalVolumeOptions options;
  options.passes = 0;
  const FinalVolume final =
      reconstruct_final_volume(scan.slices, scan.acquisition(), scan.masks, scan.weights, 1., options);
  EXPECT_TRUE(torch::equal(final.volume, reconstruct_psf(scan.slices, scan.acquisition(), scan.weights)));
}

TEST(FinalVolume, IsTheSameForAnyNumberOfThreads) {
  const Scan scan;
  const int threads = at::get_num_threads();
  at::set_num_threads(1);
  const torch::Tensor one =
      reconstruct_final_volume(scan.slices, scan.acquisition(), scan.masks, scan.weights, 1.).volume;
  at::set_num_threads(3);
  const torch::Tensor three =
      reconstruct_final_volume(scan.slices, scan.acquisition(), scan.masks, scan.weights, 1.).volume;
  at::set_num_threads(threads);
  EXPECT_TRUE(torch::equal(one, three));
}

TEST(FinalVolume, SlicesWithoutWeightGiveNothing) {
  const Scan scan;
  torch::Tensor spoilt = scan.slices.clone(), weights = scan.weights.clone();
  spoilt[7].fill_(5.);
  weights[7] = 0.;
  const torch::Tensor a = reconstruct_final_volume(spoilt, scan.acquisition(), scan.masks, weights, 1.).volume;
  // The level that counts as bright comes from all pixels, so the volumes are close, not equal.
  const torch::Tensor b = reconstruct_final_volume(scan.slices, scan.acquisition(), scan.masks, weights, 1.).volume;
  EXPECT_LT(((a - b).norm() / b.norm()).item<double>(), 0.05);
}

TEST(FinalVolume, NamesWhatDoesNotFit) {
  const Scan scan;
  const auto message = [&](const std::function<void(FinalVolumeOptions&)>& spoil) -> std::string {
    FinalVolumeOptions options;
    spoil(options);
    try {
      validate(options);
    } catch (const std::invalid_argument& error) {
      return error.what();
    }
    return "";
  };
  EXPECT_NE(message([](auto& o) { o.resolution_mm = 0.; }).find("final_volume.resolution_mm is 0"), std::string::npos);
  EXPECT_NE(message([](auto& o) { o.passes = -1; }).find("passes"), std::string::npos);
  EXPECT_NE(message([](auto& o) { o.iterations = 0; }).find("iterations"), std::string::npos);
  EXPECT_NE(message([](auto& o) { o.edge = 0.; }).find("edge is"), std::string::npos);
  EXPECT_NE(message([](auto& o) { o.edge_strength = -1.; }).find("edge_strength"), std::string::npos);
  EXPECT_NE(message([](auto& o) { o.outlier_factor = 0.; }).find("outlier_factor"), std::string::npos);
  EXPECT_EQ(message([](auto&) {}), "");
  EXPECT_THROW(reconstruct_final_volume(scan.slices, scan.acquisition(), scan.slices, scan.weights, 1.),
               std::invalid_argument);
  EXPECT_THROW(reconstruct_final_volume(scan.slices, scan.acquisition(), scan.masks, {}, 1.), std::invalid_argument);
  EXPECT_THROW(reconstruct_final_volume(scan.slices, scan.acquisition(), scan.masks, scan.weights, 0.),
               std::invalid_argument);
}

TEST(EdgeWeights, TheLaplacianIsTheGradientOfTheWeightedDifferences) {
  torch::manual_seed(1);
  const torch::Tensor volume = torch::rand({4, 5, 6}), x = torch::rand({4, 5, 6}), d = torch::rand({4, 5, 6});
  torch::Tensor known = torch::rand({4, 5, 6}) > 0.2;
  const double edge = 0.3;
  const auto energy = [&](const torch::Tensor& y) {
    double sum = 0.;
    for (std::int64_t axis = 0; axis < 3; ++axis) {
      const std::int64_t n = volume.size(axis) - 1;
      const auto step = [&](const torch::Tensor& t) { return t.narrow(axis, 1, n) - t.narrow(axis, 0, n); };
      const torch::Tensor both = known.narrow(axis, 1, n) & known.narrow(axis, 0, n);
      const torch::Tensor weight = both / torch::sqrt(1. + (step(volume) / edge).square());
      sum += 0.5 * (weight * step(y).square()).sum().item<double>();
    }
    return sum;
  };
  torch::Tensor product = torch::zeros_like(x);
  EdgeWeights(volume, known, edge).add_laplacian(x, 1.F, &product);
  // The energy is quadratic: the central difference is exact but for float32 rounding.
  const double slope = (energy(x + d) - energy(x - d)) / 2.;
  EXPECT_NEAR((product * d).sum().item<double>(), slope, 1e-4 * std::abs(slope));
}

}  // namespace
}  // namespace svort
