#include "svort_ros/simulation/artifacts.h"

#include <cmath>
#include <sstream>
#include <stdexcept>
#include <string>

#include "purposes.h"
#include "svort_ros/simulation/random_stream.h"

namespace svort {
namespace {

constexpr double kBiasReach_mm = 60.;
constexpr double kVoidReach_mm = 30.;  ///< local voids lie within so much of the brain's centre

}  // namespace

ArtifactOptions no_artifacts() {
  ArtifactOptions options;
  options.visit([](const char* key, double& value, const char*) {
    // Sizes stay: they say nothing where there are no voids.
    const std::string name = key;
    if (name.rfind("void_s", 0) != 0 || name == "void_share") value = 0.;
    if (name == "void_speed") value = 1e12;
  });
  return options;
}

void check(const ArtifactOptions& options) {
  const auto require = [](bool ok, const std::string& option, double value, const char* limit) {
    if (ok) return;
    std::ostringstream text;
    text << "artifacts." << option << " is " << value << ", must be " << limit;
    throw std::invalid_argument(text.str());
  };
  ArtifactOptions copy = options;
  copy.visit([&](const char* key, double value, const char*) {
    const std::string name = key;
    require(std::isfinite(value) && value >= 0., name, value, "finite and at least 0");
    const bool share = name.size() > 6 && name.compare(name.size() - 6, 6, "_share") == 0;
    if (share || name.rfind("void_depth", 0) == 0) require(value <= 1., name, value, "at most 1");
  });
  require(options.noise_max >= options.noise_min, "noise_max", options.noise_max, "at least noise_min");
  require(options.void_speed > 0., "void_speed", options.void_speed, "positive");
  require(options.void_size_min_mm > 0., "void_size_min_mm", options.void_size_min_mm, "positive");
  require(options.void_size_max_mm >= options.void_size_min_mm, "void_size_max_mm", options.void_size_max_mm,
          "at least void_size_min_mm");
  require(options.void_depth_max >= options.void_depth_min, "void_depth_max", options.void_depth_max,
          "at least void_depth_min");
}

PlaneQuadratic ScanArtifacts::log_bias(const Pose& T_scanner_slice) const {
  const Eigen::Vector3d o = T_scanner_slice.translation(), u = T_scanner_slice.linear().col(0),
                        v = T_scanner_slice.linear().col(1);
  const Eigen::Matrix3d& h = bias_curvature;
  return {bias_slope.dot(o) + o.dot(h * o),
          bias_slope.dot(u) + 2. * o.dot(h * u),
          bias_slope.dot(v) + 2. * o.dot(h * v),
          u.dot(h * u),
          2. * u.dot(h * v),
          v.dot(h * v)};
}

ScanArtifacts draw_artifacts(const ArtifactOptions& options, const ScanPlan& plan, std::uint64_t seed,
                             std::uint64_t scan) {
  check(options);
  RandomStream random(seed, scan, purpose::kArtifacts);
  ScanArtifacts artifacts;
  artifacts.gamma = std::exp(random.normal(options.gamma));
  artifacts.bias_slope = random.normal3(options.bias / kBiasReach_mm);
  for (int i = 0; i < 3; ++i)
    for (int j = i; j < 3; ++j) {
      const double value = random.normal(options.bias / (kBiasReach_mm * kBiasReach_mm));
      artifacts.bias_curvature(i, j) = artifacts.bias_curvature(j, i) = i == j ? value : 0.5 * value;
    }
  const double noise = random.uniform(options.noise_min, options.noise_max);
  std::vector<double> stack_gain;
  for (int stack = 0; stack < plan.stacks; ++stack) stack_gain.push_back(std::exp(random.normal(options.stack_scale)));

  for (const PlannedSlice& planned : plan.acquired) {
    SliceArtifacts slice;
    slice.dropped = random.chance(options.drop_share);
    slice.mask_lost = random.chance(options.mask_lost_share);
    slice.mask_cut = random.chance(options.mask_cut_share);
    const double angle = random.uniform(0., 2. * M_PI);
    slice.cut_normal = {std::cos(angle), std::sin(angle)};
    slice.cut_offset = random.uniform(-5., 25.);
    const double erosion = random.uniform(0., options.mask_erosion_mm);
    if (random.chance(options.mask_eroded_share)) slice.erosion_mm = erosion;
    slice.noisy = random.chance(options.noisy_share);
    slice.noise = slice.noisy ? noise * options.noisy_factor : noise;
    slice.gain = stack_gain[static_cast<std::size_t>(planned.stack)] * std::exp(random.normal(options.slice_scale));

    const double by_motion = 1. - std::exp(-planned.head_speed / options.void_speed);
    const bool rests = random.chance(options.void_share);
    slice.voided = random.chance(by_motion) || rests;
    const bool whole = random.chance(options.void_whole_share);
    const double depth = random.uniform(options.void_depth_min, options.void_depth_max);
    const double first = random.uniform(options.void_size_min_mm, options.void_size_max_mm),
                 second = random.uniform(options.void_size_min_mm, options.void_size_max_mm);
    const Eigen::Vector3d place = random.direction() * kVoidReach_mm;
    const Eigen::Rotation2Dd axes(random.uniform(0., M_PI));
    if (slice.voided && whole) slice.whole_loss = depth;
    if (slice.voided && !whole) {
      slice.local_loss = depth;
      slice.void_centre = place.head<2>();
      slice.void_shape = axes.toRotationMatrix() *
                         Eigen::Vector2d(1. / (first * first), 1. / (second * second)).asDiagonal() *
                         axes.toRotationMatrix().transpose();
    }
    artifacts.slices.push_back(slice);
  }
  return artifacts;
}

}  // namespace svort
