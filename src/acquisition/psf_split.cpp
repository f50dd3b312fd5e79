#include "psf_split.h"

#include <algorithm>
#include <cmath>
#include <limits>
#include <memory>
#include <sstream>
#include <stdexcept>
#include <string>

#include "parallel.h"

namespace svort {
namespace {

// Taps below this fraction of the peak are left out, as in gaussian_psf().
constexpr double kThreshold = 1e-3;
// Variances below this (voxels^2) are no blur at all.
constexpr double kSmallestVariance = 1e-4;
// A PSF further than this (relative L2) from the Gaussian of its own variances is no Gaussian. Those of gaussian_psf()
// are within 0.1 (the narrowest, which few taps describe).
constexpr double kLargestMisfit = 0.12;

double variance_of(const std::vector<double>& half) {
  double sum = half[0], second = 0.;
  for (std::size_t i = 1; i < half.size(); ++i) {
    sum += 2. * half[i];
    second += 2. * half[i] * static_cast<double>(i * i);
  }
  return second / sum;
}

std::vector<double> sampled_gaussian(double squared_sigma, std::size_t radius) {
  std::vector<double> half(radius + 1);
  for (std::size_t i = 0; i <= radius; ++i) half[i] = std::exp(-0.5 * static_cast<double>(i * i) / squared_sigma);
  return half;
}

// Half a sampled Gaussian whose taps have exactly this variance, sum 1; as long as the threshold asks for. The sampled,
// cut curve has another variance than the curve itself, which would add up to a few per cent of blur.
std::vector<double> gaussian_of_variance(double variance) {
  if (variance < kSmallestVariance) return {1.};
  for (std::size_t radius = 1;; ++radius) {
    double low = 1e-3, high = 1e6;
    if (variance_of(sampled_gaussian(high, radius)) < variance) continue;
    for (int i = 0; i < 200; ++i) {
      const double middle = std::sqrt(low * high);
      (variance_of(sampled_gaussian(middle, radius)) < variance ? low : high) = middle;
    }
    if (sampled_gaussian(high, radius + 1).back() >= kThreshold) continue;
    std::vector<double> half = sampled_gaussian(high, radius);
    double sum = half[0];
    for (std::size_t i = 1; i < half.size(); ++i) sum += 2. * half[i];
    for (double& value : half) value /= sum;
    return half;
  }
}

struct Moments {
  double sum = 0.;
  std::array<double, 3> mean{}, variance{};  // x, y, z
};

Moments moments_of(const PsfTaps& taps) {
  Moments m;
  for (std::size_t t = 0; t < taps.count(); ++t) {
    m.sum += static_cast<double>(taps.value[t]);
    for (std::size_t axis = 0; axis < 3; ++axis) {
      const double value = static_cast<double>(taps.value[t]), x = static_cast<double>(taps.offset[t][axis]);
      m.mean[axis] += value * x;
      m.variance[axis] += value * x * x;
    }
  }
  for (std::size_t axis = 0; axis < 3; ++axis) {
    m.mean[axis] /= m.sum;
    m.variance[axis] = m.variance[axis] / m.sum - m.mean[axis] * m.mean[axis];
  }
  return m;
}

double at(const std::vector<double>& half, std::int64_t offset) {
  const auto index = static_cast<std::size_t>(std::abs(offset));
  return index < half.size() ? half[index] : 0.;
}

// The blur and the remaining taps of one axis together.
std::vector<double> convolve(const std::vector<double>& a, const std::vector<double>& b) {
  const auto ra = static_cast<std::int64_t>(a.size()) - 1, rb = static_cast<std::int64_t>(b.size()) - 1;
  std::vector<double> sum(static_cast<std::size_t>(ra + rb + 1), 0.);
  for (std::int64_t i = 0; i <= ra + rb; ++i) {
    for (std::int64_t j = -rb; j <= rb; ++j) sum[static_cast<std::size_t>(i)] += at(b, j) * at(a, i - j);
  }
  return sum;
}

PsfTaps taps_of(const std::array<std::vector<double>, 3>& half, double sum) {
  PsfTaps taps;
  const auto radius = [&half](std::size_t axis) { return static_cast<std::int64_t>(half[axis].size()) - 1; };
  for (std::int64_t z = -radius(2); z <= radius(2); ++z) {
    for (std::int64_t y = -radius(1); y <= radius(1); ++y) {
      for (std::int64_t x = -radius(0); x <= radius(0); ++x) {
        taps.value.push_back(static_cast<float>(sum * at(half[0], x) * at(half[1], y) * at(half[2], z)));
        taps.offset.push_back({static_cast<float>(x), static_cast<float>(y), static_cast<float>(z)});
      }
    }
  }
  return taps;
}

// Relative L2 distance of a PSF from the product of one symmetric kernel per axis.
double misfit(const PsfTaps& taps, const std::array<std::vector<double>, 3>& half, double sum) {
  // |a - b|^2 = |a|^2 + |b|^2 - 2 a b: taps outside the array count as well.
  double a = 0., ab = 0., b = sum * sum;
  for (std::size_t t = 0; t < taps.count(); ++t) {
    double model = sum;
    for (std::size_t axis = 0; axis < 3; ++axis) model *= at(half[axis], std::llround(taps.offset[t][axis]));
    const auto value = static_cast<double>(taps.value[t]);
    a += value * value;
    ab += value * model;
  }
  for (const std::vector<double>& kernel : half) {
    double squares = -kernel[0] * kernel[0];
    for (const double value : kernel) squares += 2. * value * value;
    b *= squares;
  }
  return std::sqrt(std::max(0., a + b - 2. * ab) / a);
}

}  // namespace

PsfSplit split_psfs(const char* function, const float* psfs, std::int64_t count,
                    const std::array<std::int64_t, 3>& size) {
  const auto reject = [function](std::int64_t psf, const std::string& what) {
    std::ostringstream message;
    message << function << ": the fast formulation needs Gaussian PSFs as gaussian_psf() makes them, but geometry.psf "
            << psf << " " << what << "; use the exact formulation";
    throw std::invalid_argument(message.str());
  };
  std::vector<PsfTaps> taps;
  std::vector<Moments> moments;
  double common = std::numeric_limits<double>::infinity();
  for (std::int64_t i = 0; i < count; ++i) {
    taps.push_back(nonzero_taps(psfs + i * size[0] * size[1] * size[2], size));
    moments.push_back(moments_of(taps.back()));
    const Moments& m = moments.back();
    if (taps.back().count() == 0 || !(m.sum > 0.)) reject(i, "has no positive sum");
    for (std::size_t axis = 0; axis < 3; ++axis) {
      if (!(m.variance[axis] >= 0.)) reject(i, "has a negative variance");
      if (std::abs(m.mean[axis]) > 1e-3) reject(i, "is not centred");
      common = std::min(common, m.variance[axis]);
    }
  }
  if (count == 0) common = 0.;
  PsfSplit split;
  const std::vector<double> blur = gaussian_of_variance(common);
  for (const double value : blur) split.blur.push_back(static_cast<float>(value));
  for (std::size_t i = 0; i < taps.size(); ++i) {
    std::array<std::vector<double>, 3> remain, whole;
    for (std::size_t axis = 0; axis < 3; ++axis) {
      remain[axis] = gaussian_of_variance(moments[i].variance[axis] - common);
      whole[axis] = convolve(blur, remain[axis]);
    }
    const double off = misfit(taps[i], whole, moments[i].sum);
    if (!(off <= kLargestMisfit)) {
      reject(static_cast<std::int64_t>(i), "differs from a Gaussian by " + std::to_string(off) + " (relative L2)");
    }
    split.remain.push_back(taps_of(remain, moments[i].sum));
  }
  return split;
}

void blur_volume(const std::vector<float>& half_kernel, const VolumeShape& shape, const float* in, float* out) {
  if (half_kernel.size() <= 1) {
    if (in != out) std::copy(in, in + shape.voxel_count(), out);
    return;
  }
  const auto combine_rows = tap_kernels().combine_rows;
  const auto radius = static_cast<std::int32_t>(half_kernel.size()) - 1;
  const std::int64_t width = shape.width, plane = shape.stride_z();
  const std::size_t taps = 2 * half_kernel.size() - 1;
  // Weights and rows of the kernel that lie inside [0, count) around `centre`.
  const auto inside = [&](std::int32_t centre, std::int32_t count, std::int64_t stride, const float* source,
                          std::vector<const float*>* rows, std::vector<float>* weights) {
    rows->clear();
    weights->clear();
    for (std::int32_t i = std::max(0, centre - radius); i <= std::min(count - 1, centre + radius); ++i) {
      rows->push_back(source + i * stride);
      weights->push_back(half_kernel[static_cast<std::size_t>(std::abs(i - centre))]);
    }
  };
  // Not zeroed: a vector would touch all of it twice.
  const std::unique_ptr<float[]> between(new float[static_cast<std::size_t>(shape.voxel_count())]);
  parallel_chunks(shape.depth, [&](std::int64_t first, std::int64_t last) {
    std::vector<float> padded(static_cast<std::size_t>(width + 2 * radius), 0.F);
    std::vector<const float*> rows, shifted(taps);
    std::vector<float> weights, along_row(taps);
    for (std::size_t i = 0; i < taps; ++i) {
      shifted[i] = padded.data() + i;
      const auto offset = static_cast<std::int32_t>(i) - radius;
      along_row[i] = half_kernel[static_cast<std::size_t>(std::abs(offset))];
    }
    for (std::int64_t z = first; z < last; ++z) {
      for (std::int32_t y = 0; y < shape.height; ++y) {
        inside(y, shape.height, width, in + z * plane, &rows, &weights);
        combine_rows(rows.data(), weights.data(), rows.size(), width, padded.data() + radius);
        combine_rows(shifted.data(), along_row.data(), taps, width, between.get() + z * plane + y * width);
      }
    }
  });
  parallel_chunks(shape.depth, [&](std::int64_t first, std::int64_t last) {
    std::vector<const float*> rows;
    std::vector<float> weights;
    for (std::int64_t z = first; z < last; ++z) {
      inside(static_cast<std::int32_t>(z), shape.depth, plane, between.get(), &rows, &weights);
      combine_rows(rows.data(), weights.data(), rows.size(), plane, out + z * plane);
    }
  });
}

}  // namespace svort
