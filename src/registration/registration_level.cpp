#include "registration_level.h"

#include <torch/types.h>

#include <algorithm>
#include <cmath>
#include <sstream>
#include <stdexcept>

namespace svort {
namespace {

// The rim of the outline reaches to where the blurred mask has fallen to this: 1.6 standard deviations.
constexpr float kRimShare = 0.05F;

[[noreturn]] void reject(const std::string& what) { throw std::invalid_argument("registration: " + what); }

torch::Tensor gaussian_kernel(double sigma) {
  const int radius = std::max(1, static_cast<int>(std::ceil(3. * sigma)));
  const torch::Tensor x = torch::arange(-radius, radius + 1, torch::kFloat64);
  const torch::Tensor kernel = torch::exp(-0.5 * x * x / (sigma * sigma));
  return (kernel / kernel.sum()).to(torch::kFloat32);
}

torch::Tensor blurred_in_plane(const torch::Tensor& images, double sigma) {
  const torch::Tensor kernel = gaussian_kernel(sigma);
  const std::int64_t radius = kernel.size(0) / 2;
  const torch::Tensor rows = torch::conv2d(images, kernel.view({1, 1, -1, 1}), {}, 1, torch::IntArrayRef({radius, 0}));
  return torch::conv2d(rows, kernel.view({1, 1, 1, -1}), {}, 1, torch::IntArrayRef({0, radius}));
}

}  // namespace

void validate(const RegistrationInput& input) {
  const std::size_t n = input.count();
  const auto count = static_cast<std::int64_t>(n);
  std::ostringstream what;
  if (n == 0) reject("there are no slices");
  if (!input.slices.defined() || input.slices.dim() != 4 || input.slices.size(0) != count ||
      input.slices.size(1) != 1 || input.slices.scalar_type() != torch::kFloat32 || !input.slices.device().is_cpu())
    reject("slices must be " + std::to_string(n) + " x 1 x h x w, float32, on the CPU");
  if (!input.masks.defined() || input.masks.sizes() != input.slices.sizes() ||
      input.masks.scalar_type() != torch::kBool || !input.masks.device().is_cpu())
    reject("masks must have the shape of the slices, bool, on the CPU");
  if (input.stack.size() != n || input.time_s.size() != n || input.thickness_mm.size() != n)
    reject("stack, time_s and thickness_mm must have one entry per slice, " + std::to_string(n));
  if (!(input.resolution_mm > 0.) || !std::isfinite(input.resolution_mm)) reject("resolution_mm must be positive");
  for (std::size_t i = 0; i < n; ++i) {
    if (!is_rigid(input.T_world_slice[i])) reject("the pose of slice " + std::to_string(i) + " is not rigid");
    if (!(input.thickness_mm[i] > 0.)) reject("the thickness of slice " + std::to_string(i) + " is not positive");
    if (i > 0 && !(input.time_s[i] >= input.time_s[i - 1]))
      reject("slice " + std::to_string(i) + " was acquired before the one in front of it");
  }
  if (!torch::isfinite(input.slices).all().item<bool>()) reject("slices hold NaN or infinity");
}

RegistrationLevel make_level(const RegistrationInput& input, double pixel_mm, double blur_mm, SliceContent content) {
  const torch::NoGradGuard no_grad;
  auto factor = std::max<std::int64_t>(1, std::llround(pixel_mm / input.resolution_mm));
  const auto divides = [&](std::int64_t size) { return size >= factor && size % factor % 2 == 0; };
  while (!divides(input.slices.size(2)) || !divides(input.slices.size(3))) --factor;
  RegistrationLevel level;
  level.pixel_mm = input.resolution_mm * static_cast<double>(factor);
  torch::Tensor share = input.masks.to(torch::kFloat32);
  torch::Tensor sums = input.slices * share;
  if (factor > 1) {
    // Cut what does not fill a whole pixel on both sides alike, so that the centre stays the centre.
    const std::int64_t rows = sums.size(2) / factor * factor, columns = sums.size(3) / factor * factor;
    const std::int64_t top = (sums.size(2) - rows) / 2, left = (sums.size(3) - columns) / 2;
    const auto pooled = [&](const torch::Tensor& images) {
      return torch::avg_pool2d(images.narrow(2, top, rows).narrow(3, left, columns), factor);
    };
    sums = pooled(sums);
    share = pooled(share);
  }
  level.masks = share >= 0.5;
  if (blur_mm > 0.1 * level.pixel_mm) {
    sums = blurred_in_plane(sums, blur_mm / level.pixel_mm);
    share = blurred_in_plane(share, blur_mm / level.pixel_mm);
  }
  if (content == SliceContent::outline) {
    // Slices without any brain pixel have no outline either.
    level.masks = (share >= kRimShare).logical_and(level.masks.flatten(1).any(1).view({-1, 1, 1, 1}));
    share.fill_(1.F);
  }
  level.slices = torch::where(level.masks, sums / share.clamp_min(1e-6), torch::zeros_like(sums)).contiguous();
  level.masks = level.masks.contiguous();

  const std::int64_t n = level.slices.size(0), height = level.slices.size(2), width = level.slices.size(3);
  level.points.resize(static_cast<std::size_t>(n));
  const float* value = level.slices.data_ptr<float>();
  const bool* mask = level.masks.data_ptr<bool>();
  std::vector<float> all;
  for (SlicePoints& points : level.points) {
    for (std::int64_t y = 0; y < height; ++y) {
      for (std::int64_t x = 0; x < width; ++x, ++value, ++mask) {
        if (!*mask) continue;
        const Eigen::Vector2d at(static_cast<double>(2 * x - width + 1), static_cast<double>(2 * y - height + 1));
        points.position.emplace_back((0.5 * level.pixel_mm * at).cast<float>());
        points.value.push_back(*value);
        level.field_radius_mm = std::max(level.field_radius_mm, 0.5 * level.pixel_mm * at.norm());
      }
    }
    all.insert(all.end(), points.value.begin(), points.value.end());
  }
  if (!all.empty()) {
    const auto rank = static_cast<std::ptrdiff_t>(0.99 * static_cast<double>(all.size() - 1));
    std::nth_element(all.begin(), all.begin() + rank, all.end());
    level.bright = std::max(1e-6, static_cast<double>(all[static_cast<std::size_t>(rank)]));
  }
  return level;
}

}  // namespace svort
