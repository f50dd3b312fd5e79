#include "svort_ros/acquisition/slice_acquisition.h"

#include <torch/torch.h>

#include <algorithm>
#include <limits>
#include <sstream>
#include <stdexcept>
#include <string>
#include <vector>

#include "float4.h"
#include "parallel.h"
#include "tap_sampler.h"

namespace svort {
namespace {

// Pixels with less than this share of the PSF inside the volume are not scattered (rule of the public implementation).
constexpr float kSmallestShare = 0.5F;

[[noreturn]] void reject(const char* function, const std::string& what) {
  throw std::invalid_argument(std::string(function) + ": " + what);
}

std::string shape_text(const torch::Tensor& tensor) {
  if (!tensor.defined()) return "an undefined tensor";
  std::ostringstream text;
  text << tensor.sizes() << " " << c10::toString(tensor.scalar_type()) << " on " << tensor.device();
  return text.str();
}

// A contiguous tensor of the given type and shape (-1: any size) on the CPU, or an exception.
torch::Tensor checked(const torch::Tensor& tensor, const char* function, const char* name, torch::ScalarType type,
                      const std::vector<std::int64_t>& shape) {
  bool fits = tensor.defined() && tensor.device().is_cpu() && tensor.scalar_type() == type &&
              tensor.dim() == static_cast<std::int64_t>(shape.size());
  for (std::size_t axis = 0; fits && axis < shape.size(); ++axis) {
    fits = shape[axis] < 0 || tensor.size(static_cast<std::int64_t>(axis)) == shape[axis];
  }
  if (!fits) {
    std::ostringstream expected;
    for (std::size_t axis = 0; axis < shape.size(); ++axis) {
      expected << (axis ? " x " : "") << (shape[axis] < 0 ? std::string("any") : std::to_string(shape[axis]));
    }
    reject(function, std::string(name) + " must be " + expected.str() + ", " + c10::toString(type) +
                         ", on the CPU, got " + shape_text(tensor));
  }
  return tensor.detach().contiguous();
}

// Everything acquire_slices() and scatter_slices() share, checked and ready for plain loops.
struct Problem {
  torch::Tensor transforms, psf_index, slices_mask, volume_mask;  // keep the memory alive
  std::vector<PsfTaps> taps;                                      // one list per PSF
  const std::int64_t* psf_of_slice = nullptr;                     // null if there is one PSF
  std::size_t largest_psf = 0;                                    // most taps of any PSF
  VolumeShape shape;
  std::int32_t slices = 0, height = 0, width = 0;
  double resolution_ratio = 1.;

  std::int64_t pixels_per_slice() const { return std::int64_t{height} * width; }
  const bool* volume_mask_data() const { return volume_mask.defined() ? volume_mask.data_ptr<bool>() : nullptr; }

  SliceTaps slice_taps(const std::vector<PsfTaps>& lists, std::int64_t slice) const {
    const auto psf = psf_of_slice == nullptr ? std::size_t{0} : static_cast<std::size_t>(psf_of_slice[slice]);
    return SliceTaps(lists[psf], transforms.data_ptr<float>() + 12 * slice, shape, width, height, resolution_ratio);
  }
};

Problem check_problem(const char* function, const AcquisitionGeometry& geometry,
                      const std::array<std::int64_t, 3>& volume_shape, std::int64_t height, std::int64_t width,
                      const AcquisitionMasks& masks) {
  Problem problem;
  problem.transforms = checked(geometry.transforms, function, "geometry.transforms", torch::kFloat32, {-1, 3, 4});
  const bool several = geometry.psf.defined() && geometry.psf.dim() == 4;
  torch::Tensor psf =
      checked(geometry.psf, function, "geometry.psf", torch::kFloat32,
              several ? std::vector<std::int64_t>{-1, -1, -1, -1} : std::vector<std::int64_t>{-1, -1, -1});
  if (!torch::isfinite(problem.transforms).all().item<bool>()) {
    reject(function, "geometry.transforms holds values that are not finite");
  }
  if (!torch::isfinite(psf).all().item<bool>()) reject(function, "geometry.psf holds values that are not finite");
  if (!(geometry.resolution_ratio > 0.) || !(geometry.resolution_ratio < std::numeric_limits<float>::max())) {
    reject(function,
           "geometry.resolution_ratio must be finite and positive, got " + std::to_string(geometry.resolution_ratio));
  }
  // Offsets within one array are kept in 32 bits.
  constexpr std::int64_t kLargest = std::numeric_limits<std::int32_t>::max();
  double voxels = 1.;
  for (const std::int64_t size : volume_shape) {
    if (size < 1)
      reject(function, "the volume must have at least one voxel along each axis, got " + std::to_string(size));
    voxels *= static_cast<double>(size);
  }
  if (voxels > static_cast<double>(kLargest)) reject(function, "the volume has more than 2^31 - 1 voxels");
  if (height < 1 || width < 1) {
    reject(function,
           "slices must have at least one pixel, got " + std::to_string(height) + " x " + std::to_string(width));
  }
  const std::int64_t slices = problem.transforms.size(0);
  if (static_cast<double>(slices) * static_cast<double>(height) * static_cast<double>(width) >
      static_cast<double>(kLargest)) {
    reject(function, "the slices have more than 2^31 - 1 pixels");
  }
  if (masks.slices.defined()) {
    problem.slices_mask = checked(masks.slices, function, "masks.slices", torch::kBool, {slices, 1, height, width});
  }
  if (masks.volume.defined()) {
    problem.volume_mask = checked(masks.volume, function, "masks.volume", torch::kBool,
                                  {volume_shape[0], volume_shape[1], volume_shape[2]});
  }
  if (!several) psf = psf.unsqueeze(0);
  if (several || geometry.psf_of_slice.defined()) {
    problem.psf_index = checked(geometry.psf_of_slice, function, "geometry.psf_of_slice", torch::kInt64, {slices});
    if (((problem.psf_index < 0) | (problem.psf_index >= psf.size(0))).any().item<bool>()) {
      reject(function, "geometry.psf_of_slice must be in 0 .. " + std::to_string(psf.size(0) - 1));
    }
    problem.psf_of_slice = problem.psf_index.data_ptr<std::int64_t>();
  }
  for (std::int64_t i = 0; i < psf.size(0); ++i) {
    problem.taps.push_back(nonzero_taps(psf[i].data_ptr<float>(), {psf.size(1), psf.size(2), psf.size(3)}));
    problem.largest_psf = std::max(problem.largest_psf, problem.taps.back().count());
  }
  problem.shape = {static_cast<std::int32_t>(volume_shape[2]), static_cast<std::int32_t>(volume_shape[1]),
                   static_cast<std::int32_t>(volume_shape[0])};
  problem.slices = static_cast<std::int32_t>(slices);
  problem.height = static_cast<std::int32_t>(height);
  problem.width = static_cast<std::int32_t>(width);
  problem.resolution_ratio = geometry.resolution_ratio;
  return problem;
}

// Offsets of the pixels to work on, so that threads get equal shares however the masks are spread.
std::vector<std::int32_t> active_pixels(const Problem& problem) {
  const std::int64_t count = problem.slices * problem.pixels_per_slice();
  const bool* mask = problem.slices_mask.defined() ? problem.slices_mask.data_ptr<bool>() : nullptr;
  std::vector<std::int32_t> active;
  active.reserve(static_cast<std::size_t>(count));
  for (std::int64_t pixel = 0; pixel < count; ++pixel) {
    if (mask == nullptr || mask[pixel]) active.push_back(static_cast<std::int32_t>(pixel));
  }
  return active;
}

// Calls visit(pixel, taps, centre) for pixels [begin, end) of `active`; a slice's taps are rotated once.
template <class Visit>
void for_each_pixel(const Problem& problem, const std::vector<PsfTaps>& lists, const std::vector<std::int32_t>& active,
                    std::int64_t begin, std::int64_t end, const Visit& visit) {
  const std::int64_t per_slice = problem.pixels_per_slice();
  std::int64_t i = begin;
  while (i < end) {
    const std::int64_t slice = active[static_cast<std::size_t>(i)] / per_slice;
    const SliceTaps taps = problem.slice_taps(lists, slice);
    for (; i < end && active[static_cast<std::size_t>(i)] < (slice + 1) * per_slice; ++i) {
      const std::int32_t pixel = active[static_cast<std::size_t>(i)];
      const auto within = static_cast<std::int32_t>(pixel - slice * per_slice);
      visit(pixel, taps, taps.centre(within % problem.width, within / problem.width));
    }
  }
}

// Shares of the columns and rows of a cell, {x0 y0, x1 y0, x0 y1, x1 y1}. Products of weights, not v + w (u - v): a
// voxel outside a mask then cancels exactly, and a tiny share inside keeps its relative accuracy.
inline Float4 plane_shares(float wx, float wy) {
  const Float4 x = Float4{1.F, 0.F, 1.F, 0.F} + splat(wx) * Float4{-1.F, 1.F, -1.F, 1.F};
  const Float4 y = Float4{1.F, 1.F, 0.F, 0.F} + splat(wy) * Float4{-1.F, -1.F, 1.F, 1.F};
  return x * y;
}

struct PixelSum {
  float value = 0.F, weight = 0.F;
};

PixelSum gather(const float* volume, const VolumeShape& shape, const TapSamples& samples) {
  const std::ptrdiff_t stride_y = shape.stride_y(), stride_z = shape.stride_z();
  Float4 sum = splat(0.F);
  for (std::size_t t = 0; t < samples.count; ++t) {
    const float* below = volume + samples.index[t];
    const float* above = below + stride_z;
    const Float4 column = splat(samples.lower[t]) * load_pairs(below, below + stride_y) +
                          splat(samples.upper[t]) * load_pairs(above, above + stride_y);
    sum += plane_shares(samples.wx[t], samples.wy[t]) * column;
  }
  return {(sum[0] + sum[1]) + (sum[2] + sum[3]), samples.weight};
}

// As gather(), on pairs (value inside the mask or 0, 1 inside the mask or 0).
PixelSum gather_masked(const float* pairs, const VolumeShape& shape, const TapSamples& samples) {
  const std::ptrdiff_t stride_y = 2 * shape.stride_y(), stride_z = 2 * std::ptrdiff_t{shape.stride_z()};
  Float4 sum = splat(0.F);
  for (std::size_t t = 0; t < samples.count; ++t) {
    const float* below = pairs + 2 * std::ptrdiff_t{samples.index[t]};
    const float* above = below + stride_z;
    const float wx = samples.wx[t], wy = samples.wy[t], lower = samples.lower[t], upper = samples.upper[t];
    const Float4 row = splat((1.F - wy) * lower) * load4(below) + splat(wy * lower) * load4(below + stride_y) +
                       splat((1.F - wy) * upper) * load4(above) + splat(wy * upper) * load4(above + stride_y);
    sum += Float4{1.F - wx, 1.F - wx, wx, wx} * row;
  }
  return {sum[0] + sum[2], sum[1] + sum[3]};
}

std::vector<float> masked_pairs(const float* volume, const bool* mask, std::int64_t count) {
  std::vector<float> pairs(static_cast<std::size_t>(2 * count));
  for (std::int64_t i = 0; i < count; ++i) {
    pairs[static_cast<std::size_t>(2 * i)] = mask[i] ? volume[i] : 0.F;
    pairs[static_cast<std::size_t>(2 * i + 1)] = mask[i] ? 1.F : 0.F;
  }
  return pairs;
}

// One plane of a tap's cell, for a pixel's value; kChannels = 2 adds the weights themselves beside the values.
template <int kChannels>
struct PlaneTerm;

template <>
struct PlaneTerm<1> {
  Float4 shares;

  PlaneTerm(float wx, float wy, float value) : shares(plane_shares(wx, wy) * splat(value)) {}
  void add(float weight, std::ptrdiff_t stride_y, float* cell) const {
    store_pairs(load_pairs(cell, cell + stride_y) + splat(weight) * shares, cell, cell + stride_y);
  }
};

template <>
struct PlaneTerm<2> {
  Float4 row;
  float wy;

  PlaneTerm(float wx, float wy_, float value) : row{(1.F - wx) * value, 1.F - wx, wx * value, wx}, wy(wy_) {}
  void add(float weight, std::ptrdiff_t stride_y, float* cell) const {
    float* next = cell + 2 * stride_y;
    store4(load4(cell) + splat((1.F - wy) * weight) * row, cell);
    store4(load4(next) + splat(wy * weight) * row, next);
  }
};

// One slab of planes [first, last) of the volume, written by one thread only.
struct Slab {
  std::int32_t first = 0, last = 0;
};

template <int kChannels>
void scatter_pixel(const TapSamples& samples, const VolumeShape& shape, const Slab& slab, bool crosses, float scale,
                   float value, float* volume) {
  const std::ptrdiff_t stride_y = shape.stride_y(), stride_z = shape.stride_z();
  for (std::size_t t = 0; t < samples.count; ++t) {
    float* cell = volume + kChannels * std::ptrdiff_t{samples.index[t]};
    const PlaneTerm<kChannels> term(samples.wx[t], samples.wy[t], value);
    const std::int32_t plane = crosses ? samples.index[t] / shape.stride_z() : slab.first;
    if (!crosses || (plane >= slab.first && plane < slab.last)) {
      term.add(samples.lower[t] * scale, stride_y, cell);
    }
    if (!crosses || (plane + 1 >= slab.first && plane + 1 < slab.last)) {
      term.add(samples.upper[t] * scale, stride_y, cell + kChannels * stride_z);
    }
  }
}

// Slabs with about the same number of pixels each.
std::vector<Slab> balanced_slabs(const std::vector<std::int64_t>& pixels_per_plane, int count) {
  const auto depth = static_cast<std::int32_t>(pixels_per_plane.size());
  std::int64_t total = 0;
  for (const std::int64_t pixels : pixels_per_plane) total += pixels;
  std::vector<Slab> slabs;
  std::int64_t seen = 0;
  std::int32_t first = 0;
  for (std::int32_t plane = 0; plane < depth; ++plane) {
    seen += pixels_per_plane[static_cast<std::size_t>(plane)];
    const auto done = static_cast<std::int64_t>(slabs.size()) + 1;
    if (plane + 1 == depth || (done < count && seen * count >= total * done)) {
      slabs.push_back({first, plane + 1});
      first = plane + 1;
    }
  }
  return slabs;
}

// Weight of each pixel in the scatter: 1 / (PSF share inside), or 0 to leave it out.
std::vector<float> pixel_scales(const Problem& problem, const std::vector<std::int32_t>& active) {
  std::vector<float> scales(active.size());
  parallel_chunks(static_cast<std::int64_t>(active.size()), [&](std::int64_t begin, std::int64_t end) {
    std::int64_t i = begin;
    for_each_pixel(problem, problem.taps, active, begin, end,
                   [&](std::int32_t, const SliceTaps& taps, const std::array<float, 3>& centre) {
                     const float weight = taps.weight_inside(centre);
                     scales[static_cast<std::size_t>(i++)] = weight >= kSmallestShare ? 1.F / weight : 0.F;
                   });
  });
  return scales;
}

// Every voxel is owned by one slab and receives its terms in the order of pixels and taps, whatever the number of
// slabs: no atomics, no private copies of the volume, the same bytes for any number of threads.
template <int kChannels>
void scatter(const Problem& problem, const float* slices, const std::vector<std::int32_t>& active, float* volume) {
  const std::vector<float> scales = pixel_scales(problem, active);
  std::vector<PsfTaps> spread;
  for (const PsfTaps& taps : problem.taps) spread.push_back(spread_taps(taps));
  std::vector<std::int64_t> pixels_per_plane(static_cast<std::size_t>(problem.shape.depth), 0);
  {
    std::size_t i = 0;
    for_each_pixel(problem, spread, active, 0, static_cast<std::int64_t>(active.size()),
                   [&](std::int32_t, const SliceTaps& taps, const std::array<float, 3>& centre) {
                     if (scales[i++] == 0.F) return;
                     const auto planes = taps.planes(centre);
                     ++pixels_per_plane[static_cast<std::size_t>((planes[0] + planes[1]) / 2)];
                   });
  }
  const std::vector<Slab> slabs = balanced_slabs(pixels_per_plane, worker_count());
  parallel_chunks(static_cast<std::int64_t>(slabs.size()), [&](std::int64_t first_slab, std::int64_t last_slab) {
    TapSamples samples(problem.largest_psf);
    for (std::int64_t s = first_slab; s < last_slab; ++s) {
      const Slab slab = slabs[static_cast<std::size_t>(s)];
      std::size_t i = 0;
      for_each_pixel(problem, spread, active, 0, static_cast<std::int64_t>(active.size()),
                     [&](std::int32_t pixel, const SliceTaps& taps, const std::array<float, 3>& centre) {
                       const float scale = scales[i++];
                       if (scale == 0.F) return;
                       const auto planes = taps.planes(centre);
                       if (planes[1] < slab.first || planes[0] >= slab.last) return;
                       const bool crosses = planes[0] < slab.first || planes[1] >= slab.last;
                       taps.place(centre, &samples);
                       scatter_pixel<kChannels>(samples, problem.shape, slab, crosses, scale, slices[pixel], volume);
                     });
    }
  });
}

}  // namespace

torch::Tensor acquire_slices(const torch::Tensor& volume, const AcquisitionGeometry& geometry, int height, int width,
                             const AcquisitionMasks& masks, torch::Tensor* weight) {
  const char* function = "acquire_slices";
  const torch::Tensor source = checked(volume, function, "volume", torch::kFloat32, {-1, -1, -1});
  const Problem problem =
      check_problem(function, geometry, {source.size(0), source.size(1), source.size(2)}, height, width, masks);
  const float* voxels = source.data_ptr<float>();
  const bool* mask = problem.volume_mask_data();
  const std::vector<float> pairs =
      mask != nullptr ? masked_pairs(voxels, mask, problem.shape.voxel_count()) : std::vector<float>();

  torch::Tensor slices = torch::zeros({problem.slices, 1, height, width}, torch::kFloat32);
  torch::Tensor weights = weight != nullptr ? torch::zeros_like(slices) : torch::Tensor();
  float* values = slices.data_ptr<float>();
  float* weight_values = weight != nullptr ? weights.data_ptr<float>() : nullptr;
  const std::vector<std::int32_t> active = active_pixels(problem);
  parallel_chunks(static_cast<std::int64_t>(active.size()), [&](std::int64_t begin, std::int64_t end) {
    TapSamples samples(problem.largest_psf);
    for_each_pixel(problem, problem.taps, active, begin, end,
                   [&](std::int32_t pixel, const SliceTaps& taps, const std::array<float, 3>& centre) {
                     taps.place(centre, &samples);
                     const PixelSum sum = mask != nullptr ? gather_masked(pairs.data(), problem.shape, samples)
                                                          : gather(voxels, problem.shape, samples);
                     if (!(sum.weight > 0.F)) return;
                     values[pixel] = sum.value / sum.weight;
                     if (weight_values != nullptr) weight_values[pixel] = sum.weight;
                   });
  });
  if (weight != nullptr) *weight = weights;
  return slices;
}

torch::Tensor scatter_slices(const torch::Tensor& slices, const AcquisitionGeometry& geometry,
                             const std::array<std::int64_t, 3>& volume_shape, bool equalize,
                             const AcquisitionMasks& masks) {
  const char* function = "scatter_slices";
  const torch::Tensor source = checked(slices, function, "slices", torch::kFloat32, {-1, 1, -1, -1});
  const Problem problem = check_problem(function, geometry, volume_shape, source.size(2), source.size(3), masks);
  if (problem.slices != source.size(0)) {
    reject(function, "slices and geometry.transforms must have the same count, got " + std::to_string(source.size(0)) +
                         " and " + std::to_string(problem.slices));
  }
  const float* pixels = source.data_ptr<float>();
  std::vector<std::int32_t> active = active_pixels(problem);
  torch::Tensor volume = torch::zeros({volume_shape[0], volume_shape[1], volume_shape[2]}, torch::kFloat32);
  float* voxels = volume.data_ptr<float>();
  const std::int64_t count = problem.shape.voxel_count();
  if (equalize) {
    std::vector<float> pairs(static_cast<std::size_t>(2 * count), 0.F);
    scatter<2>(problem, pixels, active, pairs.data());
    for (std::int64_t i = 0; i < count; ++i) {
      const float received = pairs[static_cast<std::size_t>(2 * i + 1)];
      if (received > 0.F) voxels[i] = pairs[static_cast<std::size_t>(2 * i)] / received;
    }
  } else {
    // A pixel of value 0 adds nothing to a plain sum.
    const auto adds_nothing = [pixels](std::int32_t pixel) { return pixels[pixel] == 0.F; };
    active.erase(std::remove_if(active.begin(), active.end(), adds_nothing), active.end());
    scatter<1>(problem, pixels, active, voxels);
  }
  // The volume mask only says where values may land; it takes no part in the pixel's weight.
  if (const bool* mask = problem.volume_mask_data()) {
    for (std::int64_t i = 0; i < count; ++i) {
      if (!mask[i]) voxels[i] = 0.F;
    }
  }
  return volume;
}

}  // namespace svort
