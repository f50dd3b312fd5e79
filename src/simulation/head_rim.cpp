#include "head_rim.h"

#include <array>
#include <cmath>

#include "smooth_fields.h"

namespace svort {
namespace {

// Intensities are shares of the brain's bright tissue. Ranges by eye from T2-weighted scans at 1.5 T.
constexpr double kSkullMm[] = {1., 3.};
constexpr double kSkull[] = {0.05, 0.4};
constexpr double kScalp[] = {0.2, 0.9};
constexpr double kTransitionMm = 0.7;      // between skull and scalp
constexpr double kUnevenThickness = 0.5;   // standard deviation, share of the mean
constexpr double kUnevenIntensity = 0.25;  // standard deviation, share of the tissue's
constexpr double kDarkest = 0.02;          // what is in the mask is not black
constexpr double kFieldSpacingMm = 20.;
// The skull is smoother than the brain: distances are taken from the brain after this low-pass.
constexpr double kSmoothingMm = 5.;

}  // namespace

void add_head_rim(double largest_mm, double resolution_mm, RandomStream* random, Anatomy* anatomy) {
  const torch::NoGradGuard no_grad;
  const torch::Device device = anatomy->image.device();
  const double mean_mm = random->uniform(0., largest_mm);
  const double skull_mm = random->uniform(kSkullMm[0], kSkullMm[1]);
  const double skull = random->uniform(kSkull[0], kSkull[1]), scalp = random->uniform(kScalp[0], kScalp[1]);

  std::array<torch::Tensor, 3> low_pass, splines;  // z, y, x
  std::array<std::int64_t, 3> points{};
  std::int64_t total = 2;
  for (std::size_t a = 0; a < 3; ++a) {
    const std::int64_t size = anatomy->mask.size(static_cast<std::int64_t>(a));
    const double half_mm = 0.5 * static_cast<double>(size - 1) * resolution_mm;
    low_pass[a] =
        low_pass_matrix(size, -half_mm, resolution_mm, size, -half_mm, resolution_mm, kSmoothingMm).to(device);
    points[a] = spline_points(half_mm, kFieldSpacingMm);
    total *= points[a];
    const torch::Tensor position = torch::arange(size, torch::kFloat64) * resolution_mm - half_mm;
    splines[a] = spline_matrix(position, points[a], kFieldSpacingMm).to(device);
  }
  torch::Tensor coefficients = torch::empty({2, points[0], points[1], points[2]}, torch::kFloat32);
  float* out = coefficients.data_ptr<float>();
  for (std::int64_t i = 0; i < total; ++i) out[i] = static_cast<float>(random->normal(1. / kSplineDeviation));
  const torch::Tensor fields = apply_axes(coefficients.to(device), splines);

  // Near a flat border, a mask that was low-passed by a Gaussian is its integral: the distance follows from it.
  const torch::Tensor share = apply_axes(anatomy->mask.to(torch::kFloat32).unsqueeze(0), low_pass)[0];
  constexpr double kUnseen = 1e-4;
  const torch::Tensor distance_mm =
      torch::erfinv(1. - 2. * share.clamp(kUnseen, 1. - kUnseen)) * (kSmoothingMm * std::sqrt(2.));

  const torch::Tensor thickness_mm = mean_mm * (1. + kUnevenThickness * fields[0]);
  const torch::Tensor rim = (share > kUnseen) & (distance_mm < thickness_mm) & ~anatomy->mask;
  const torch::Tensor outer = torch::sigmoid((distance_mm - skull_mm) / kTransitionMm);
  const torch::Tensor image =
      ((skull + (scalp - skull) * outer) * (1. + kUnevenIntensity * fields[1])).clamp_min(kDarkest);
  anatomy->image = torch::where(rim, image, anatomy->image);
  anatomy->mask = anatomy->mask | rim;
}

}  // namespace svort
