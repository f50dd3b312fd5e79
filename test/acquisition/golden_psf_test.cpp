#include <gtest/gtest.h>

#include <optional>

#include "golden_data.h"
#include "svort_ros/acquisition/point_spread_function.h"

namespace svort {
namespace {

std::array<double, 3> ratio(const torch::Tensor& tensor) {
  const torch::Tensor values = tensor.to(torch::kFloat64).contiguous();
  return {values[0].item<double>(), values[1].item<double>(), values[2].item<double>()};
}

TEST(GoldenPsf, MatchesThePublicImplementation) {
  const GoldenData data("psf.pt");
  WorstDeviation worst("psf, maximum", 1e-6);
  for (int k = 0; data.has("psf_" + std::to_string(k)); ++k) {
    const std::string index = std::to_string(k);
    const torch::Tensor psf = gaussian_psf(ratio(data.at("res_ratio_" + index)));
    worst.check(deviation(psf, data.at("psf_" + index)).maximum, "psf_" + index);
  }
  EXPECT_GE(worst.count(), 1);
  worst.check(deviation(gaussian_psf(ratio(data.at("res_ratio_r0")), 0), data.at("psf_r0")).maximum, "psf_r0");
  const auto r_max = static_cast<int>(data.at("r_max_rk").item<std::int64_t>());
  worst.check(deviation(gaussian_psf(ratio(data.at("res_ratio_rk")), r_max), data.at("psf_rk")).maximum, "psf_rk");
}

}  // namespace
}  // namespace svort
