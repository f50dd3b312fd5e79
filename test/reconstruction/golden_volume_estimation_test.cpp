#include <gtest/gtest.h>

#include <regex>

#include "golden_data.h"
#include "svort_ros/reconstruction/volume_estimation.h"

namespace svort {
namespace {

constexpr double kL2Tolerance = 1e-4;
constexpr double kMaximumTolerance = 1e-3;

TEST(GoldenVolumeEstimation, MatchesThePublicImplementation) {
  const GoldenData data("srr.pt");
  const torch::Tensor slices = data.at("slices"), start = data.at("x0"), weights = data.at("p").reshape({-1});
  const AcquisitionGeometry geometry{data.at("transforms"), data.at("psf"), data.at("res_ratio").item<double>()};
  const std::array<std::int64_t, 3> shape = {start.size(0), start.size(1), start.size(2)};
  const auto height = static_cast<int>(slices.size(2)), width = static_cast<int>(slices.size(3));

  WorstDeviation l2("volume estimation, relative L2", kL2Tolerance);
  WorstDeviation maximum("volume estimation, maximum", kMaximumTolerance);
  const auto check = [&](const torch::Tensor& volume, const std::string& key) {
    const Deviation d = deviation(volume, data.at(key));
    l2.check(d.relative_l2, key);
    maximum.check(d.maximum, key);
  };
  const auto operator_with = [&](const AcquisitionMasks& masks) {
    return SliceAcquisition(geometry, height, width, shape, AcquisitionFormulation::exact, masks);
  };
  const SliceAcquisition all = operator_with({});
  check(reconstruct_psf(slices, all), "x0");
  check(all.adjoint(slices * weights.view({-1, 1, 1, 1}), /*equalize=*/false), "b");
  check(all.normal(start, weights), "AtA_x0");

  // cg<iterations>_<p | nop | smask> and gd<iterations>_p
  const std::regex pattern("(cg|gd)([0-9]+)_(p|nop|smask)");
  int conjugate_gradients = 0;
  for (const std::string& key : data.keys("")) {
    std::smatch match;
    if (!std::regex_match(key, match, pattern)) continue;
    const int iterations = std::stoi(match[2]);
    // Only the keys that end in p are weighted.
    const torch::Tensor w = match[3] == "p" ? weights : torch::Tensor();
    AcquisitionMasks masks;
    if (match[3] == "smask") masks.slices = slices > 0;
    if (match[1] == "cg") {
      ConjugateGradientOptions options;
      options.iterations = iterations;
      ConjugateGradientReport report;
      check(solve_weighted_inverse(slices, operator_with(masks), w, start, options, &report), key);
      EXPECT_EQ(report.iterations, iterations);
      ++conjugate_gradients;
    } else {
      EdgePreservingOptions options;
      options.iterations = iterations;
      check(refine_edge_preserving(slices, operator_with(masks), w, start, options), key);
    }
  }
  EXPECT_GE(conjugate_gradients, 2);
}

}  // namespace
}  // namespace svort
