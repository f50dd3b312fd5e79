// Simulated damage on the slices of the bundled real scan: real anatomy and contrast, known answers.

#include <gtest/gtest.h>

#include <algorithm>
#include <cmath>
#include <cstdio>
#include <filesystem>
#include <map>
#include <string>
#include <vector>

#include "svort_ros/decision/slice_quality.h"
#include "svort_ros/io/calibration.h"
#include "svort_ros/io/nifti_stack.h"
#include "svort_ros/live/live_pipeline.h"
#include "svort_ros/simulation/random_stream.h"

namespace svort {
namespace {

enum class Damage { none, local_void, dark, noisy };

std::vector<Slice> real_scan() {
  const std::filesystem::path folder = std::filesystem::path(SVORT_SOURCE_DIR) / "data/real";
  std::vector<std::filesystem::path> stacks, masks;
  for (const char* run : {"1", "3", "5"}) {
    stacks.push_back(folder / (std::string("sub-01_run-") + run + "_T2w.nii.gz"));
    masks.push_back(folder / (std::string("sub-01_run-") + run + "_T2w_desc-brain_mask.nii.gz"));
  }
  return read_stacks(stacks, masks, "real", {});
}

/// The 0.99 quantile of the brain.
double brightness(const std::vector<Slice>& scan) {
  std::vector<float> values;
  for (const Slice& slice : scan)
    for (std::size_t i = 0; i < slice.pixels.size(); ++i)
      if (slice.mask[i]) values.push_back(slice.pixels[i]);
  const auto rank = values.begin() + static_cast<std::ptrdiff_t>(0.99 * static_cast<double>(values.size()));
  std::nth_element(values.begin(), rank, values.end());
  return static_cast<double>(*rank);
}

/// As the simulator damages slices (see ArtifactOptions): a Gaussian void of 6 to 25 mm around a place in the brain
/// that takes 40 to 100 % of the signal, the same share of the whole slice, or noise of 10 to 20 % of the brightest
/// tissue.
void spoil(Slice* slice, Damage damage, double brightest, RandomStream* random) {
  std::vector<std::size_t> brain;
  for (std::size_t i = 0; i < slice->mask.size(); ++i)
    if (slice->mask[i]) brain.push_back(i);
  const auto width = static_cast<std::size_t>(slice->info.columns);
  const double loss = random->uniform(0.4, 1.);
  const std::size_t centre = brain[static_cast<std::size_t>(random->uniform() * static_cast<double>(brain.size()))];
  const Eigen::Vector2d sizes(random->uniform(6., 25.), random->uniform(6., 25.));
  const Eigen::Matrix2d axes = Eigen::Rotation2Dd(random->uniform(0., M_PI)).toRotationMatrix();
  const double deviation = brightest * random->uniform(0.1, 0.2);
  const auto place = [&](std::size_t i) -> Eigen::Vector2d {
    return Eigen::Vector2d(static_cast<double>(i % width), static_cast<double>(i / width))
        .cwiseProduct(slice->info.pixel_spacing);
  };
  for (std::size_t i = 0; i < slice->pixels.size(); ++i) {
    const Eigen::Vector2d p = (axes.transpose() * (place(i) - place(centre))).cwiseQuotient(sizes);
    const double value = static_cast<double>(slice->pixels[i]);
    double spoilt = value;
    if (damage == Damage::local_void) spoilt = value * (1. - loss * std::exp(-0.5 * p.squaredNorm()));
    if (damage == Damage::dark) spoilt = value * (1. - 0.9 * loss);
    if (damage == Damage::noisy)
      spoilt = std::hypot(value + random->normal(deviation), random->normal(deviation));  // Rician
    slice->pixels[i] = static_cast<float>(spoilt);
  }
}

TEST(RealScanQuality, DamageStandsOutFromRealAnatomy) {
  const std::vector<Slice> scan = real_scan();
  const double brightest = brightness(scan);
  PipelineOptions options;
  options.estimator.method = "nominal";  // poses do not matter to the score from the images
  std::map<Damage, std::vector<double>> scores;
  for (std::uint64_t round = 0; round < 10; ++round) {
    LivePipeline pipeline(options);
    std::map<std::pair<int, int>, Damage> truth;
    RandomStream random(1, round);
    for (Slice slice : scan) {
      const bool has_brain = std::count(slice.mask.begin(), slice.mask.end(), 1) > 0;
      const double draw = random.uniform();
      const Damage damage = draw < 0.06   ? Damage::local_void
                            : draw < 0.1  ? Damage::dark
                            : draw < 0.14 ? Damage::noisy
                                          : Damage::none;
      if (has_brain && damage != Damage::none) spoil(&slice, damage, brightest, &random);
      truth[{slice.info.stack, slice.info.index}] = damage;
      pipeline.add(slice);
    }
    QualityMonitor monitor{SliceQualityOptions()};
    for (const SliceQuality& slice : monitor.update(pipeline.sequence(), pipeline.estimate(), Volume(), 40.))
      scores[truth.at({slice.stack, slice.index})].push_back(slice.image_score);
  }
  const std::vector<double>& good = scores[Damage::none];
  const auto low = std::count_if(good.begin(), good.end(), [](double s) { return s < SliceQualityOptions().accept; });
  const double below = static_cast<double>(low) / static_cast<double>(good.size());
  std::printf("%zu undamaged slices, %.3f of them below accept\n", good.size(), below);
  std::map<Damage, double> auc;
  for (const auto& [damage, name] :
       {std::pair{Damage::local_void, "void"}, {Damage::dark, "dark"}, {Damage::noisy, "noisy"}}) {
    std::vector<double> all = good;
    std::vector<bool> bad(good.size(), false);
    for (const double score : scores[damage]) {
      all.push_back(score);
      bad.push_back(true);
    }
    const Roc result = roc(all, bad);
    auc[damage] = result.auc;
    std::printf("%-6s %3zu slices: AUC %.3f, found at 10 %% %.2f, at 20 %% %.2f\n", name, result.bad, result.auc,
                result.found_at_10, result.found_at_20);
  }
  // Calibrated for 10 % on simulated scans; without the scan's own measure of what is usual it was 91 %.
  EXPECT_LT(below, 0.25);
  EXPECT_GT(auc[Damage::local_void], 0.8);  // some voids are small, or where the slice is dark anyway
  EXPECT_GT(auc[Damage::dark], 0.95);
  EXPECT_GT(auc[Damage::noisy], 0.95);
}

}  // namespace
}  // namespace svort
