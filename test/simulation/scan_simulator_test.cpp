#include "svort_ros/simulation/scan_simulator.h"

#include <gtest/gtest.h>
#include <torch/types.h>

#include <algorithm>
#include <cmath>
#include <set>

#include "svort_ros/acquisition/point_spread_function.h"
#include "svort_ros/geometry/rigid_transform.h"
#include "svort_ros/reconstruction/volume_estimation.h"

namespace svort {
namespace {

NetworkGrid coarse_grid() {
  NetworkGrid grid;
  grid.volume_shape = {56, 60, 64};  // unequal, so that swapped axes would be seen
  grid.resolution_mm = 2.;
  return grid;
}

/// Three stacks of a brain with left and right told apart; artifacts and variation off.
SimulatorOptions clean_options(const std::string& motion) {
  SimulatorOptions options;
  options.motion = motion;
  options.artifacts = no_artifacts();
  options.anatomy = no_anatomy_variation();
  options.scanner.stacks_min = options.scanner.stacks_max = 3;
  options.scanner.slices_min = 20;
  return options;
}

std::vector<BrainVolume> phantoms() {
  PhantomOptions options;
  options.length_mm = 72.;
  return {make_phantom(options)};
}

SliceAcquisition acquisition_at(const SimulatedScan& scan, const torch::Tensor& transforms, const NetworkGrid& grid) {
  AcquisitionGeometry geometry;
  geometry.transforms = change_resolution(transforms, 1., grid.resolution_mm);
  geometry.resolution_ratio = scan.input.slice_resolution_mm / grid.resolution_mm;
  geometry.psf = gaussian_psf(
      {geometry.resolution_ratio, geometry.resolution_ratio, scan.input.thickness_mm / grid.resolution_mm});
  AcquisitionMasks masks;
  masks.slices = scan.masks;
  masks.volume = scan.volume > 0;  // as in the simulator: means over the brain alone
  return SliceAcquisition(geometry, static_cast<int>(scan.input.slices.size(2)),
                          static_cast<int>(scan.input.slices.size(3)), grid.volume_shape, AcquisitionFormulation::fast,
                          masks);
}

double correlation(const torch::Tensor& a, const torch::Tensor& b, const torch::Tensor& where) {
  const torch::Tensor x = a.masked_select(where), y = b.masked_select(where);
  const torch::Tensor dx = x - x.mean(), dy = y - y.mean();
  return ((dx * dy).sum() / (dx.norm() * dy.norm())).item<double>();
}

double agreement(const SimulatedScan& scan, const torch::Tensor& transforms, const NetworkGrid& grid) {
  const SliceAcquisition acquisition = acquisition_at(scan, transforms, grid);
  return correlation(acquisition.forward(scan.volume), scan.input.slices, scan.masks);
}

TEST(ScanSimulator, SlicesAreWhatTheForwardModelSeesAtTheTruth) {
  for (const std::string protocol : {"scanner", "uniform"}) {
    SimulatorOptions options = clean_options("severe");
    options.scanner.protocol = protocol;
    ScanSimulator simulator(phantoms(), coarse_grid(), options, 11);
    for (const SimulatedScan& scan : simulator.simulate(0, 3)) {
      const SliceAcquisition acquisition = acquisition_at(scan, scan.truth, simulator.grid());
      // The 0.99 quantile is 1. Away from the rim, where few taps count and float32 rounding of poses shows.
      const torch::Tensor inside = torch::max_pool2d((~scan.masks).to(torch::kFloat32), 5, 1, 2) < 0.5;
      const torch::Tensor difference =
          (acquisition.forward(scan.volume) - scan.input.slices).masked_select(inside).abs();
      ASSERT_GT(difference.numel(), 5000);
      // Taps that reach past the rim: a few. Equal within float32 otherwise.
      EXPECT_LT(difference.median().item<double>(), 1e-4) << protocol;
      EXPECT_GT(agreement(scan, scan.truth, simulator.grid()), 0.98) << protocol;
    }
  }
}

TEST(ScanSimulator, ReconstructionAtTheTruthGivesTheVolume) {
  SimulatorOptions options = clean_options("none");
  options.scanner.stacks_min = options.scanner.stacks_max = 6;
  ScanSimulator simulator(phantoms(), coarse_grid(), options, 3);
  for (const SimulatedScan& scan : simulator.simulate(0, 2)) {
    const SliceAcquisition acquisition = acquisition_at(scan, scan.truth, simulator.grid());
    ConjugateGradientOptions solver;
    solver.iterations = 5;
    const torch::Tensor volume = solve_weighted_inverse(scan.input.slices, acquisition, {},
                                                        reconstruct_psf(scan.input.slices, acquisition), solver);
    const torch::Tensor brain = (volume > 0) & (scan.volume > 0);
    // Slices of 3 mm see the folds of the 2 mm volume only in part.
    EXPECT_GT(correlation(volume, scan.volume, brain), 0.95);
    EXPECT_GT(correlation(volume, scan.volume, brain), correlation(volume, scan.volume.flip({2}), brain) + 0.1)
        << "left and right";
  }
}

TEST(ScanSimulator, TruthFitsBetterThanNominalAndMirroredPoses) {
  for (const std::string motion : {"moderate", "severe"}) {
    SimulatorOptions options;  // with all artifacts
    options.motion = motion;
    ScanSimulator simulator(phantoms(), coarse_grid(), options, 5);
    for (const SimulatedScan& scan : simulator.simulate(0, 4)) {
      const double at_truth = agreement(scan, scan.truth, simulator.grid());
      // Nominal poses, aligned as well as one rigid transform does it at the first slice.
      const torch::Tensor to_brain =
          compose_transforms(scan.truth.narrow(0, 0, 1), inverse_transform(scan.input.transforms.narrow(0, 0, 1)));
      const torch::Tensor nominal =
          compose_transforms(to_brain.expand_as(scan.input.transforms), scan.input.transforms);
      EXPECT_GT(at_truth, agreement(scan, nominal, simulator.grid())) << motion << " scan " << scan.number;

      // The brain's mirror image at mirrored poses would look the same in an image; the phantom is not symmetric.
      torch::Tensor mirrored = scan.truth.clone();
      const torch::Tensor m = torch::diag(torch::tensor({-1.F, 1.F, 1.F})),
                          d = torch::diag(torch::tensor({1.F, 1.F, -1.F}));
      const torch::Tensor last = trans_first_to_last(mirrored);
      mirrored = trans_last_to_first(torch::cat(
          {torch::matmul(torch::matmul(m, last.slice(2, 0, 3)), d), torch::matmul(m, last.slice(2, 3, 4))}, 2));
      EXPECT_GT(at_truth, agreement(scan, mirrored, simulator.grid()));
    }
  }
}

TEST(ScanSimulator, WithoutMotionNominalPosesAreTheTruthUpToOneRigidTransform) {
  ScanSimulator simulator(phantoms(), coarse_grid(), clean_options("none"), 9);
  for (const SimulatedScan& scan : simulator.simulate(4, 2)) {
    const torch::Tensor between = compose_transforms(scan.truth.to(torch::kFloat64),
                                                     inverse_transform(scan.input.transforms.to(torch::kFloat64)));
    EXPECT_LT((between - between.narrow(0, 0, 1)).abs().max().item<double>(), 1e-3);  // float32 of some 50 mm
    EXPECT_FALSE(scan.displaced.any().item<bool>());
    // The brain's centre is the origin: the middle of the masks' box, and the phantom's box is nearly its brain's.
    const torch::Tensor centre = trans_first_to_last(between.narrow(0, 0, 1)).select(2, 3);
    EXPECT_LT(centre.norm().item<double>(), 8.);
  }
}

TEST(ScanSimulator, UniformProtocolHidesTheOrientation) {
  SimulatorOptions options = clean_options("mild");
  options.scanner.protocol = "uniform";
  ScanSimulator simulator(phantoms(), coarse_grid(), options, 1);
  const auto scan = simulator.simulate(0, 1)[0];
  EXPECT_FALSE(scan.input.common_frame);
  const torch::Tensor rotations = scan.input.transforms.slice(2, 0, 3);
  EXPECT_LT((rotations - torch::eye(3)).abs().max().item<double>(), 1e-6);
  std::set<int> stacks;
  for (const PlannedSlice& slice : scan.plan.acquired) stacks.insert(slice.stack);
  EXPECT_EQ(stacks.size(), 3U);
}

TEST(ScanSimulator, ScanDependsOnSeedAndNumberAlone) {
  SimulatorOptions options;
  options.anatomies = 2;
  options.scans_per_anatomy = 2;
  ScanSimulator simulator(phantoms(), coarse_grid(), options, 21), other(phantoms(), coarse_grid(), options, 21),
      seeded(phantoms(), coarse_grid(), options, 22);
  const auto batch = simulator.simulate(2, 3);
  const auto again = other.simulate(2, 3);
  for (std::size_t i = 0; i < batch.size(); ++i) {
    EXPECT_TRUE(torch::equal(batch[i].input.slices, again[i].input.slices));
    EXPECT_TRUE(torch::equal(batch[i].truth, again[i].truth));
    EXPECT_TRUE(torch::equal(batch[i].volume, again[i].volume));
  }
  // In another batch, after other scans.
  other.simulate(9, 1);
  const auto alone = other.simulate(4, 1);
  ASSERT_TRUE(torch::equal(batch[2].truth, alone[0].truth));
  EXPECT_LT((batch[2].input.slices - alone[0].input.slices).abs().max().item<double>(), 1e-3);  // float32 rounding
  EXPECT_FALSE(torch::equal(seeded.simulate(4, 1)[0].truth, alone[0].truth));
}

TEST(ScanSimulator, PreparedSlicesAreCroppedAsTheLiveSequenceDoes) {
  SimulatorOptions options;
  options.scanner.prefix_share = 1.;
  ScanSimulator simulator(phantoms(), coarse_grid(), options, 2);
  bool some_cut = false;
  for (const SimulatedScan& scan : simulator.simulate(0, 6)) {
    const auto n = scan.truth.size(0);
    EXPECT_GE(n, 1);
    some_cut = some_cut || scan.plan.slices > 2 * scan.plan.acquired.size();
    ASSERT_EQ(scan.input.slices.sizes(), torch::IntArrayRef({n, 1, 64, 64}));
    ASSERT_EQ(scan.masks.sizes(), scan.input.slices.sizes());
    ASSERT_EQ(scan.plan.acquired.size(), static_cast<std::size_t>(n));
    EXPECT_TRUE((scan.masks.flatten(1).sum(1) >= 4).all().item<bool>());  // 16 mm^2
    EXPECT_EQ(scan.input.slices.masked_select(~scan.masks).abs().sum().item<float>(), 0.F);
    const torch::Tensor order = scan.input.times.slice(0, 1) > scan.input.times.slice(0, 0, -1);
    EXPECT_TRUE(order.all().item<bool>());
    EXPECT_EQ(scan.input.times[0].item<float>(), 0.F);
    // Centred within a pixel.
    const torch::Tensor columns = scan.masks.any(2).flatten(1);
    for (std::int64_t i = 0; i < n; ++i) {
      const torch::Tensor where = torch::nonzero(columns[i]).flatten();
      EXPECT_LE(std::abs(where[0].item<double>() + where[-1].item<double>() - 63.), 1.);
    }
    // 0.99 quantile at 1, from a sample.
    const torch::Tensor brain = std::get<0>(scan.input.slices.masked_select(scan.masks).sort());
    EXPECT_NEAR(brain[static_cast<std::int64_t>(0.99 * static_cast<double>(brain.numel()))].item<double>(), 1., 0.05);
  }
  EXPECT_TRUE(some_cut);
}

TEST(AnatomySource, ARimLiesAroundTheBrainAndLeavesItAsItIs) {
  AnatomyOptions options;
  const AnatomySource bare(phantoms(), coarse_grid(), options, torch::kCPU);
  options.rim_share = 1.;
  options.rim_mm = 10.;
  const AnatomySource rimmed(phantoms(), coarse_grid(), options, torch::kCPU);
  // Within 15 voxels (30 mm) of the brain; the field makes the rim at most about three times its mean of up to 10 mm.
  const auto grown = [](const torch::Tensor& mask, std::int64_t voxels) {
    return torch::max_pool3d(mask.to(torch::kFloat32).view({1, 1, 56, 60, 64}), 2 * voxels + 1, 1, voxels)
               .view({56, 60, 64}) > 0.;
  };
  double most = 0.;
  bool dark = false, bright = false;
  for (std::uint64_t number = 0; number < 6; ++number) {
    const Anatomy before = bare.make(3, number), after = rimmed.make(3, number), again = rimmed.make(3, number);
    EXPECT_TRUE(torch::equal(after.image, again.image));
    const torch::Tensor rim = after.mask & ~before.mask;
    EXPECT_FALSE((before.mask & ~after.mask).any().item<bool>());
    EXPECT_TRUE(torch::equal(after.image.masked_fill(rim, 0.), before.image));
    EXPECT_TRUE((after.image.masked_select(rim) > 0.).all().item<bool>());
    EXPECT_FALSE((rim & ~grown(before.mask, 15)).any().item<bool>());
    const double share = rim.sum().item<double>() / before.mask.sum().item<double>();
    most = std::max(most, share);
    if (share > 0.1) {
      dark = dark || (after.image.masked_select(rim) < 0.4).any().item<bool>();
      bright = bright || (after.image.masked_select(rim) > 0.4).any().item<bool>();
    }
    BrainVolume measured;
    measured.mask = after.mask;
    measured.resolution_mm = coarse_grid().resolution_mm;
    EXPECT_EQ(after.extent.half_size, brain_extent(measured).half_size);
  }
  EXPECT_GT(most, 0.3);
  EXPECT_TRUE(dark);
  EXPECT_TRUE(bright);
}

TEST(AnatomySource, ARimIsAsThickAsItsMeanSays) {
  // A ball, so that the rim's volume says its thickness.
  BrainVolume ball;
  ball.name = "ball";
  const torch::Tensor axis = torch::arange(64, torch::kFloat32) - 31.5;
  const torch::Tensor radius2 = axis.square().view({64, 1, 1}) + axis.square().view({64, 1}) + axis.square();
  constexpr double kRadius = 18.;  // voxels of 2 mm
  ball.mask = radius2 < kRadius * kRadius;
  ball.image = ball.mask.to(torch::kFloat32);
  ball.resolution_mm = 2.;
  NetworkGrid grid;
  grid.volume_shape = {64, 64, 64};
  grid.resolution_mm = 2.;
  AnatomyOptions options = no_anatomy_variation();
  options.rim_share = 1.;
  const AnatomySource source({ball}, grid, options, torch::kCPU);
  const double brain = ball.mask.sum().item<double>();
  double sum = 0.;
  constexpr int kBrains = 60;
  for (std::uint64_t number = 0; number < kBrains; ++number) {
    const double volume = source.make(5, number).mask.sum().item<double>();
    sum += 2. * kRadius * (std::cbrt(volume / brain) - 1.);
  }
  // Means are uniform in 0 .. 8 mm: 4 mm on average, give or take 0.3 mm over 60 brains.
  EXPECT_NEAR(sum / kBrains, 4., 1.);
}

TEST(AnatomySource, ADeformationNeitherTurnsNorShiftsTheBrain) {
  // Brains whose intensity is a coordinate say where each voxel of the deformed brain comes from.
  NetworkGrid grid;
  grid.volume_shape = {64, 64, 64};
  grid.resolution_mm = 2.;
  const torch::Tensor axis = (torch::arange(64, torch::kFloat32) - 31.5) * 2.;  // mm
  const std::vector<torch::Tensor> coordinates = {axis.view({1, 1, 64}).expand({64, 64, 64}),
                                                  axis.view({1, 64, 1}).expand({64, 64, 64}),
                                                  axis.view({64, 1, 1}).expand({64, 64, 64})};
  const torch::Tensor inside = (coordinates[0] / 36.).square() + ((coordinates[1] - 6.) / 46.).square() +
                                   ((coordinates[2] + 4.) / 34.).square() <
                               1.;
  constexpr double kOffsetMm = 100.;  // intensities are not negative
  AnatomyOptions options = no_anatomy_variation();
  options.elastic_mm = 2.5;
  std::vector<AnatomySource> still, deformed;
  for (const torch::Tensor& coordinate : coordinates) {
    BrainVolume brain;
    brain.name = "ramp";
    brain.image = coordinate + kOffsetMm;
    brain.mask = inside;
    brain.resolution_mm = 2.;
    still.emplace_back(std::vector<BrainVolume>{brain}, grid, no_anatomy_variation(), torch::kCPU);
    deformed.emplace_back(std::vector<BrainVolume>{brain}, grid, options, torch::kCPU);
  }
  for (std::uint64_t number = 0; number < 4; ++number) {
    const torch::Tensor mask = deformed[0].make(7, number).mask & inside;
    std::vector<torch::Tensor> from, to;
    for (std::size_t a = 0; a < 3; ++a) {
      const Anatomy before = still[a].make(7, number);
      const torch::Tensor there = before.image.masked_select(inside), at = coordinates[a].masked_select(inside);
      const double unit = ((at + kOffsetMm).sum() / there.sum()).item<double>();
      to.push_back(coordinates[a].masked_select(mask));
      from.push_back(deformed[a].make(7, number).image.masked_select(mask) * unit - kOffsetMm);
    }
    const torch::Tensor p = torch::stack(to).to(torch::kFloat64), q = torch::stack(from).to(torch::kFloat64);
    const torch::Tensor moved = q - p;
    EXPECT_NEAR(moved.square().mean().sqrt().item<double>(), options.elastic_mm, 1.);
    EXPECT_LT(moved.mean(1).norm().item<double>(), 0.4) << "mm, brain " << number;
    // The rotation by which the voxels' displacement is explained best: small angles.
    const torch::Tensor lever = p - p.mean(1, true), rest = moved - moved.mean(1, true);
    const torch::Tensor second = torch::matmul(lever, lever.t()), cross = torch::matmul(lever, rest.t());
    const torch::Tensor inertia = second.trace() * torch::eye(3, torch::kFloat64) - second;
    const torch::Tensor moment =
        torch::stack({cross[1][2] - cross[2][1], cross[2][0] - cross[0][2], cross[0][1] - cross[1][0]});
    const torch::Tensor rotation = torch::matmul(inertia.inverse(), moment);
    EXPECT_LT(rotation.norm().item<double>() * 180. / M_PI, 0.4) << "degrees, brain " << number;
  }
}

TEST(ScanSimulator, RefusesWhatDoesNotFit) {
  const auto message = [](const SimulatorOptions& options, const std::vector<BrainVolume>& volumes) {
    try {
      ScanSimulator(volumes, coarse_grid(), options, 1);
    } catch (const std::invalid_argument& error) {
      return std::string(error.what());
    }
    return std::string("accepted");
  };
  SimulatorOptions options;
  EXPECT_NE(message(options, {}).find("at least one brain volume"), std::string::npos);
  options.motion = "wild";
  EXPECT_NE(message(options, phantoms()).find("'wild'"), std::string::npos);
  options = {};
  options.scanner.thickness_max_mm = 2.;
  EXPECT_NE(message(options, phantoms()).find("thickness_max_mm"), std::string::npos);
  options = {};
  options.artifacts.drop_share = 1.5;
  EXPECT_NE(message(options, phantoms()).find("drop_share"), std::string::npos);
  options = {};
  options.anatomy.rim_mm = 20.;
  EXPECT_NE(message(options, phantoms()).find("rim_mm"), std::string::npos);
  options = {};
  options.anatomy.rim_share = -0.1;
  EXPECT_NE(message(options, phantoms()).find("rim_share"), std::string::npos);
  auto volumes = phantoms();
  volumes[0].mask.zero_();
  EXPECT_NE(message({}, volumes).find("no brain voxel"), std::string::npos);
}

}  // namespace
}  // namespace svort
