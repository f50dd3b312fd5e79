#include <gtest/gtest.h>
#include <torch/types.h>

#include <cmath>

#include "golden_data.h"
#include "svort_ros/metrics/image_similarity.h"
#include "svort_ros/metrics/pose_error.h"

namespace svort {
namespace {

TEST(GoldenMetrics, PoseErrors) {
  const GoldenData golden("metrics.pt");
  WorstDeviation points("anchor distances, mm", 1e-3), mean("their means, mm", 1e-3);
  PoseErrors errors;
  int configurations = 0;
  for (; golden.has("ed_cfg_" + std::to_string(configurations)); ++configurations) {
    const std::string k = std::to_string(configurations);
    const torch::Tensor cfg = golden.at("ed_cfg_" + k);
    AnchorFrame frame;
    frame.width = cfg[0].item<int>();
    frame.height = cfg[1].item<int>();
    frame.resolution = cfg[2].item<double>();
    errors = pose_errors(golden.at("mat_a"), golden.at("mat_b"), frame);
    points.check(deviation(errors.points, golden.at("ed_points_" + k)).maximum, "ed_points_" + k);
    points.check(deviation(errors.ed, golden.at("ed_" + k)).maximum, "ed_" + k);
    mean.check(std::abs(summarise(errors.ed).mean - golden.at("ed_mean_" + k).item<double>()), "ed_mean_" + k);
  }
  ASSERT_GE(configurations, 1);

  // arccos loses digits near 0, and the reference was computed from float32 matrices.
  const torch::Tensor gd = golden.at("gd").to(torch::kFloat64);
  const torch::Tensor tolerance = torch::where(gd < 0.01, torch::full_like(gd, 2e-3), torch::full_like(gd, 1e-4));
  WorstDeviation angle("geodesic distance / its tolerance", 1.), chord("geodesic distance from the chord, rad", 1e-5);
  angle.check(((errors.gd - gd).abs() / tolerance).max().item<double>(), "gd");
  chord.check(deviation(errors.gd, golden.at("gd_chord")).maximum, "gd_chord");
}

TEST(GoldenMetrics, ImageSimilarity) {
  const GoldenData golden("metrics.pt");
  // float64 on both sides, but images and maps are stored as float32.
  WorstDeviation value("mse, psnr, ssim (relative)", 1e-6), map("ssim maps", 1e-6);
  for (const std::string prefix : {"vol_", "img_"}) {
    const torch::Tensor test = golden.at(prefix + "test"), reference = golden.at(prefix + "ref");
    const auto check = [&](double actual, const std::string& key) {
      const double expected = golden.at(prefix + key).item<double>();
      value.check(std::abs(actual / expected - 1.), prefix + key);
    };
    check(mean_squared_error(test, reference), "mse");
    check(peak_signal_to_noise(test, reference), "psnr");
    for (const auto& [window, key] :
         {std::pair{SsimWindow::uniform, "ssim_w7"}, {SsimWindow::gaussian, "ssim_gauss"}}) {
      const Ssim ssim = structural_similarity(test, reference, window);
      check(ssim.mean, key);
      map.check(deviation(ssim.map, golden.at(prefix + key + "_map")).maximum, prefix + key + "_map");
    }
    SimilarityOptions given;
    given.data_range = golden.at(prefix + "data_range").item<double>();
    check(peak_signal_to_noise(test, reference, given), "psnr");
  }
}

}  // namespace
}  // namespace svort
