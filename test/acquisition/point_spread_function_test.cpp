#include "svort_ros/acquisition/point_spread_function.h"

#include <gtest/gtest.h>
#include <torch/types.h>

#include <cmath>
#include <limits>

namespace svort {
namespace {

// Standard deviation along one axis of the array.
double width(const torch::Tensor& psf, std::int64_t axis) {
  std::vector<std::int64_t> others;
  for (std::int64_t a = 0; a < 3; ++a) {
    if (a != axis) others.push_back(a);
  }
  const torch::Tensor profile = psf.to(torch::kFloat64).sum(others);
  const std::int64_t count = profile.size(0);
  const torch::Tensor offset = torch::arange(count, torch::kFloat64) - static_cast<double>(count - 1) / 2.;
  return std::sqrt((profile * offset * offset).sum().item<double>());
}

TEST(PointSpreadFunction, IsNormalisedSymmetricAndOfTheRightWidth) {
  const torch::Tensor psf = gaussian_psf({4., 3., 6.}, 16);
  EXPECT_NEAR(psf.sum().item<double>(), 1., 1e-6);
  EXPECT_TRUE(torch::equal(psf, psf.flip({0, 1, 2})));
  EXPECT_GE(psf.min().item<float>(), 0.F);
  // FWHM is 2.3548 sigma. The cut at 1e-3 of the peak takes 0.4 % of the variance's tails.
  EXPECT_NEAR(width(psf, 2), 1.2067 * 4. / 2.3548, 0.02 * 4.);
  EXPECT_NEAR(width(psf, 1), 1.2067 * 3. / 2.3548, 0.02 * 3.);
  EXPECT_NEAR(width(psf, 0), 6. / 2.3548, 0.02 * 6.);
}

TEST(PointSpreadFunction, RejectsRatiosThatAreNoSizes) {
  for (const double bad : {0., -1., std::numeric_limits<double>::infinity(), std::nan(""), 1e6}) {
    EXPECT_THROW(gaussian_psf({1., 1., bad}), std::invalid_argument) << bad;
  }
  EXPECT_THROW(gaussian_psf({1., 1., 1.}, -1), std::invalid_argument);
}

TEST(PointSpreadFunction, StackIsCentred) {
  const torch::Tensor small = gaussian_psf({1., 1., 1.}), large = gaussian_psf({1.25, 1.25, 3.75});
  const torch::Tensor stacked = stack_psfs({small, large});
  EXPECT_TRUE(torch::equal(stacked[1], large));
  EXPECT_NEAR(stacked[0].sum().item<double>(), 1., 1e-6);
  EXPECT_TRUE(torch::equal(stacked[0], stacked[0].flip({0, 1, 2})));
  EXPECT_THROW(stack_psfs({}), std::invalid_argument);
  EXPECT_THROW(stack_psfs({torch::ones({2, 3, 3})}), std::invalid_argument);
}

}  // namespace
}  // namespace svort
