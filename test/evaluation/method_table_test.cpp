#include "svort_ros/evaluation/method_table.h"

#include <gtest/gtest.h>
#include <torch/types.h>

#include <cmath>
#include <memory>
#include <stdexcept>

#include "evaluation_fixture.h"
#include "svort_ros/geometry/anchor_points.h"
#include "svort_ros/geometry/rigid_transform.h"

namespace svort {
namespace {

using svort_test::quick_setup;
using svort_test::small_brain;

EvaluationScan moving_scan() {
  EvaluationScanOptions options;
  options.motion = "moderate";
  return simulate_evaluation_scan(small_brain(), options);
}

/// Knows where the slices are, and says so, moved as a whole.
class Oracle : public PoseNetwork {
 public:
  /// @param truth n x 3 x 4 of all slices of the scan, in the network's windows
  explicit Oracle(const torch::Tensor& truth) : PoseNetwork("oracle"), truth_(truth) {
    register_parameter("unused", torch::zeros({1}));
  }
  std::vector<NetworkStep> run(const NetworkInput& input, const NetworkGrid& /*grid*/, const NetworkRun& run) override {
    asked_iterations = run.iterations;
    NetworkStep step;
    step.transforms = truth_.narrow(0, 0, input.slices.size(0));
    step.weights = torch::ones({input.slices.size(0)});
    return {step};
  }
  int asked_iterations = -1;

 private:
  torch::Tensor truth_;
};

/// @param shift of the whole, mm
std::shared_ptr<Oracle> oracle(const EvaluationScan& scan, const Eigen::Vector3d& shift) {
  SliceSequence sequence(quick_setup().pipeline.sequence);
  std::vector<torch::Tensor> poses;
  for (std::size_t i = 0; i < scan.slices.size(); ++i) {
    if (!is_kept(sequence.add(scan.slices[i]).status)) continue;
    // A network with a common frame sees the slice's crop.
    poses.push_back(
        tensor_from_pose(Eigen::Translation3d(shift) * scan.truth[i] * sequence.newest_arrival()->T_slice_crop)
            .view({1, 3, 4})
            .to(torch::kFloat32));
  }
  return std::make_shared<Oracle>(torch::cat(poses));
}

TableMethod method_of(const std::shared_ptr<Oracle>& network) {
  TableMethod method;
  method.name = "oracle";
  method.weights_sha256 = "0123456789abcdef";
  method.network = std::make_shared<NetworkRunner>(NetworkInstance{"oracle", {}, network, true}, RunnerOptions{"cpu"});
  return method;
}

TEST(MethodTable, ANetworkThatIsRightHasNoErrorAndOneThatIsShiftedHasThatShift) {
  const EvaluationScan scan = moving_scan();
  TableExtent extent;
  extent.refined = false;
  const TableResult right = measure_method(scan, method_of(oracle(scan, {0., 0., 0.})), quick_setup(), extent);
  // Poses pass through float32: 1e-5 mm of rounding at 100 mm, 1e-3 rad at small angles (see metrics).
  EXPECT_LT(right.score.own.ed_mm, 1e-3);
  EXPECT_LT(right.score.own.gd_rad, 1e-3);
  EXPECT_GT(right.score.own.slice_psnr_db, 60.);
  EXPECT_GT(right.score.own.slice_ssim, 0.999);
  EXPECT_TRUE(right.score.own.sure);

  TableMethod method = method_of(oracle(scan, {3., 4., 0.}));
  method.iterations = 2;
  const TableResult shifted = measure_method(scan, method, quick_setup(), extent);
  EXPECT_NEAR(shifted.score.own.ed_mm, 5., 1e-3);
  EXPECT_LT(shifted.score.own.gd_rad, 1e-3);
  EXPECT_LT(shifted.score.own.relative_ed_mm, 1e-3);
  EXPECT_LT(shifted.score.own.slice_psnr_db, right.score.own.slice_psnr_db - 20.);
  EXPECT_LT(shifted.score.own.slice_ssim, 0.98);
  // Volumes are compared where they fit best: a shift of the whole changes nothing but rounding.
  EXPECT_NEAR(shifted.score.weighted.psnr_db, right.score.weighted.psnr_db, 0.1);
  EXPECT_EQ(shifted.score.iterations, 2);
  EXPECT_EQ(shifted.score.weights, "0123456789ab");
  EXPECT_TRUE(std::isnan(shifted.score.refined.ed_mm));

  ASSERT_EQ(shifted.slices.size(), shifted.score.slices);
  double nearest = 1e9, furthest = 0.;
  for (const TableSlice& slice : shifted.slices) {
    EXPECT_NEAR(slice.ed_mm, 5., 1e-2);
    nearest = std::min(nearest, slice.distance_mm);
    furthest = std::max(furthest, slice.distance_mm);
  }
  EXPECT_LT(nearest, 3.) << "some slice goes through the middle";
  EXPECT_GT(furthest, 15.);
  EXPECT_LT(furthest, 40.) << "the brain is 60 mm long";

  ASSERT_GE(shifted.prefixes.size(), 4U);
  EXPECT_EQ(shifted.prefixes[0].seen, 5U);
  EXPECT_EQ(shifted.prefixes[1].seen, 10U);
  for (const TablePrefix& prefix : shifted.prefixes) EXPECT_NEAR(prefix.ed_mm, 5., 1e-3);
}

TEST(MethodTable, TheNetworkRunsAsOftenAsTheRowSays) {
  const EvaluationScan scan = moving_scan();
  const auto network = oracle(scan, {0., 0., 0.});
  TableMethod method = method_of(network);
  method.iterations = 7;
  measure_method(scan, method, quick_setup(), {false, false, false});
  EXPECT_EQ(network->asked_iterations, 7);
}

TEST(MethodTable, RegistrationAloneAndAfterANetworkFindsWhatTheScannerDoesNotKnow) {
  const EvaluationScan scan = moving_scan();
  TableMethod nominal;
  nominal.name = "nominal";
  nominal.source = PoseSource::nominal;
  const TableExtent extent = {true, true, false};
  const TableScore before = measure_method(scan, nominal, quick_setup(), extent).score;
  EXPECT_GT(before.own.relative_ed_mm, 2.) << "the scan must hold something to be found";
  EXPECT_TRUE(std::isnan(before.own.ed_mm)) << "without a template there is no canonical frame";
  EXPECT_TRUE(std::isnan(before.own.slice_psnr_db));

  TableMethod registration = nominal;
  registration.name = "SVR only";
  registration.source = PoseSource::registration;
  const TableScore alone = measure_method(scan, registration, quick_setup(), extent).score;
  EXPECT_LT(alone.own.relative_ed_mm, 0.5 * before.own.relative_ed_mm);
  EXPECT_EQ(alone.refined.relative_ed_mm, alone.own.relative_ed_mm);
  EXPECT_GT(alone.weighted.psnr_db, before.weighted.psnr_db);
  EXPECT_GT(alone.refined_volume.psnr_db, 10.);

  const TableScore kept = measure_method(scan, method_of(oracle(scan, {2., 0., 0.})), quick_setup(), extent).score;
  EXPECT_LT(kept.refined.relative_ed_mm, before.own.relative_ed_mm);
  EXPECT_LT(kept.refined.ed_mm, 2. + kept.refined.relative_ed_mm + 0.1) << "registration must not move the whole";
  EXPECT_EQ(kept.weighted.psnr_db, kept.unweighted.psnr_db) << "the oracle's weights are all 1";
}

TEST(MethodTable, ASearchFindsWhatRefinementDoesNot) {
  EvaluationScanOptions options;
  options.motion = "severe";
  const EvaluationScan scan = simulate_evaluation_scan(small_brain(), options);
  TableMethod method;
  method.name = "SVR";
  method.source = PoseSource::registration;
  const TableExtent poses_only = {true, false, false};
  const TableScore alone = measure_method(scan, method, quick_setup(), poses_only).score;
  method.search = true;
  const TableResult searched = measure_method(scan, method, quick_setup(), {true, false, true});
  EXPECT_LT(searched.score.own.relative_ed_mm, 0.8 * alone.own.relative_ed_mm);
  EXPECT_TRUE(searched.prefixes.empty());
}

TEST(MethodTable, RejectsWhatItCannotMeasure) {
  const EvaluationScan scan = moving_scan();
  TableMethod method;
  method.name = "empty";
  EXPECT_THROW(measure_method(scan, method, quick_setup()), std::invalid_argument);
  method.source = PoseSource::live;
  EXPECT_THROW(measure_method(scan, method, quick_setup()), std::invalid_argument);
}

TEST(MethodTable, UniformStacksPointAnywhere) {
  EvaluationScanOptions options;
  options.protocol = "uniform";
  const EvaluationScan scan = simulate_evaluation_scan(small_brain(), options);
  // Stacks of the scanner's protocol are within some tilt of right angles; here some pair is not, for this seed.
  double most = 0.;
  std::vector<Eigen::Vector3d> normals;
  for (const Slice& slice : scan.slices)
    if (slice.info.stack == static_cast<int>(normals.size()))
      normals.push_back(slice.info.T_scanner_slice.linear().col(2));
  ASSERT_EQ(normals.size(), 3U);
  for (int a = 0; a < 3; ++a)
    for (int b = 0; b < a; ++b)
      most = std::max(most, std::abs(normals[static_cast<std::size_t>(a)].dot(normals[static_cast<std::size_t>(b)])));
  EXPECT_GT(most, 0.5);
  options.protocol = "any";
  EXPECT_THROW(simulate_evaluation_scan(small_brain(), options), std::invalid_argument);
}

}  // namespace
}  // namespace svort
