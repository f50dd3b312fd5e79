#include "svort_ros/acquisition/slice_acquisition.h"

#include <torch/torch.h>

#include <algorithm>
#include <limits>
#include <numeric>
#include <sstream>
#include <stdexcept>
#include <string>
#include <vector>

#include "parallel.h"
#include "pixel_plan.h"
#include "psf_split.h"
#include "tap_kernels.h"
#include "tap_sampler.h"

namespace svort {
namespace {

constexpr const char* kName = "SliceAcquisition";

// Pixels with less than this share of the PSF inside the volume are not scattered (rule of the public implementation).
constexpr float kSmallestShare = 0.5F;

// Weights below this in float64 sums are what rounding left of slices that were taken away.
constexpr double kRoundingOfSums = 1e-12;

[[noreturn]] void reject(const std::string& what) { throw std::invalid_argument(std::string(kName) + ": " + what); }

std::string shape_text(const torch::Tensor& tensor) {
  if (!tensor.defined()) return "an undefined tensor";
  std::ostringstream text;
  text << tensor.sizes() << " " << c10::toString(tensor.scalar_type()) << " on " << tensor.device();
  return text.str();
}

// A contiguous tensor of the given type and shape (-1: any size) on the CPU, or an exception.
torch::Tensor checked(const torch::Tensor& tensor, const char* name, torch::ScalarType type,
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
    reject(std::string(name) + " must be " + expected.str() + ", " + c10::toString(type) + ", on the CPU, got " +
           shape_text(tensor));
  }
  return tensor.detach().contiguous();
}

void check_sizes(std::int64_t slices, std::int64_t height, std::int64_t width,
                 const std::array<std::int64_t, 3>& volume_shape) {
  // Offsets within one array are kept in 32 bits.
  constexpr std::int64_t kLargest = std::numeric_limits<std::int32_t>::max();
  double voxels = 1.;
  for (const std::int64_t size : volume_shape) {
    if (size < 1) reject("the volume must have at least one voxel along each axis, got " + std::to_string(size));
    voxels *= static_cast<double>(size);
  }
  if (voxels > static_cast<double>(kLargest)) reject("the volume has more than 2^31 - 1 voxels");
  constexpr std::int64_t kLongest = std::numeric_limits<std::uint16_t>::max();
  if (height < 1 || width < 1 || height > kLongest || width > kLongest) {
    reject("slices must have at least one pixel and at most " + std::to_string(kLongest) + " along each axis, got " +
           std::to_string(height) + " x " + std::to_string(width));
  }
  if (static_cast<double>(slices) * static_cast<double>(height) * static_cast<double>(width) >
      static_cast<double>(kLargest)) {
    reject("the slices have more than 2^31 - 1 pixels");
  }
}

// The exact PSF ends where it falls below 1e-3 of its peak; blur and taps together reach a little further, with next to
// no weight. Without this limit such voxels would become a halo around the slices: 1e-3 of what the centre plane of a
// single slice gives to a voxel.
float least_weight_of(const torch::Tensor& psfs, double resolution_ratio) {
  constexpr double kThreshold = 1e-3;
  if (psfs.size(0) == 0) return 0.F;
  const double smallest = std::get<0>(psfs.sum({2, 3}).max(1)).min().item<double>();
  return static_cast<float>(kThreshold * smallest / (resolution_ratio * resolution_ratio));
}

struct GroupOfSlice {
  std::int32_t slice = 0, group = 0;
};

// What one thread works on at a time.
struct Tile {
  std::int64_t pixels = 0;
  std::vector<GroupOfSlice> groups;
};

}  // namespace

const char* to_string(AcquisitionFormulation formulation) {
  return formulation == AcquisitionFormulation::exact ? "exact" : "fast";
}

AcquisitionFormulation acquisition_formulation(const std::string& name) {
  for (const auto formulation : {AcquisitionFormulation::exact, AcquisitionFormulation::fast}) {
    if (name == to_string(formulation)) return formulation;
  }
  throw std::invalid_argument("the formulation of the forward model must be exact or fast, got '" + name + "'");
}

struct SliceAcquisition::Plan {
  AcquisitionFormulation formulation = AcquisitionFormulation::exact;
  VolumeShape shape;
  std::int32_t height = 0, width = 0;
  float least_weight = 0.F;             // voxels that receive no more are empty after the equalised scatter
  std::vector<float> blur;              // half kernel; {1} in the exact formulation
  std::vector<PsfTaps> psfs;            // SliceTaps point into it
  std::vector<SliceTaps> taps;          // one per slice
  std::vector<SlicePixels> pixels;      // one per slice
  std::vector<Tile> tiles;              // those that hold pixels, colour by colour, the fullest first
  std::array<std::size_t, 5> colour{};  // tiles of colour c are [colour[c], colour[c + 1])
  torch::Tensor volume_mask;

  bool blurs() const { return blur.size() > 1; }
  const bool* mask() const { return volume_mask.defined() ? volume_mask.data_ptr<bool>() : nullptr; }
  std::array<std::int64_t, 3> volume_shape() const { return {shape.depth, shape.height, shape.width}; }
  std::int64_t slice_count() const { return static_cast<std::int64_t>(taps.size()); }
  torch::Tensor new_slices() const { return torch::zeros({slice_count(), 1, height, width}, torch::kFloat32); }
  torch::Tensor new_volume() const { return torch::zeros({shape.depth, shape.height, shape.width}, torch::kFloat32); }
  torch::Tensor checked_slices(const torch::Tensor& slices) const {
    return checked(slices, "slices", torch::kFloat32, {slice_count(), 1, height, width});
  }
  torch::Tensor checked_volume(const torch::Tensor& volume) const {
    return checked(volume, "volume", torch::kFloat32, {shape.depth, shape.height, shape.width});
  }
  std::int64_t offset(std::int64_t slice, std::size_t pixel) const {
    const SlicePixels& of_slice = pixels[static_cast<std::size_t>(slice)];
    return (slice * height + of_slice.row[pixel]) * width + of_slice.column[pixel];
  }
  // Weight of a pixel in the scatter: 1 / (PSF share inside), or 0 to leave it out.
  float scale(const SlicePixels& of_slice, std::size_t pixel) const {
    const float share = of_slice.share_of(pixel);
    return share >= kSmallestShare ? 1.F / share : 0.F;
  }

  void find_pixels(const bool* slices_mask);
  void weigh_pixels(SlicePixels* of_slice, const SliceTaps& of_taps, const float* ones, const float* mask_values) const;
  torch::Tensor gathered_volume(const torch::Tensor& volume) const;
  void finish_volume(torch::Tensor* volume) const;

  template <class Visit>
  void visit_tile(const Tile& tile, const Visit& visit) const;
  template <class Visit>
  void for_each_batch(const Visit& visit) const;
  template <class Visit>
  void for_each_batch_exclusively(const Visit& visit) const;
  template <class Real, class Kernel>
  void scatter_sums(const float* slices, double factor, Kernel kernel, Real* sums) const;
  template <class Real>
  torch::Tensor divide_sums(const Real* sums, double smallest) const;
};

// Calls visit(slice, taps, kernel's taps, first pixel, batch) for the batches of one tile, in their order.
template <class Visit>
void SliceAcquisition::Plan::visit_tile(const Tile& tile, const Visit& visit) const {
  for (const GroupOfSlice& item : tile.groups) {
    const auto slice = static_cast<std::size_t>(item.slice);
    const PixelGroup& group = pixels[slice].groups[static_cast<std::size_t>(item.group)];
    const TapList list = taps[slice].list();
    for (std::int32_t first = group.begin; first < group.end; first += static_cast<std::int32_t>(kLanes)) {
      visit(slice, list, static_cast<std::size_t>(first), batch_of(taps[slice], pixels[slice], group, first));
    }
  }
}

// All batches, in parallel, for visitors that write to their own pixels only.
template <class Visit>
void SliceAcquisition::Plan::for_each_batch(const Visit& visit) const {
  parallel_tasks(static_cast<std::int64_t>(tiles.size()),
                 [&](std::int64_t tile) { visit_tile(tiles[static_cast<std::size_t>(tile)], visit); });
}

// All batches, in parallel, such that no two visitors at a time have taps in the same voxel.
template <class Visit>
void SliceAcquisition::Plan::for_each_batch_exclusively(const Visit& visit) const {
  for (std::size_t c = 0; c < 4; ++c) {
    parallel_tasks(static_cast<std::int64_t>(colour[c + 1] - colour[c]),
                   [&](std::int64_t tile) { visit_tile(tiles[colour[c] + static_cast<std::size_t>(tile)], visit); });
  }
}

void SliceAcquisition::Plan::weigh_pixels(SlicePixels* of_slice, const SliceTaps& of_taps, const float* ones,
                                          const float* mask_values) const {
  const TapKernels& kernels = tap_kernels();
  const TapList list = of_taps.list();
  const auto margin = static_cast<float>(blur.size() - 1);
  of_slice->weight.resize(of_slice->count());
  if (mask_values != nullptr) of_slice->share.resize(of_slice->count());
  for (const PixelGroup& group : of_slice->groups) {
    for (std::int32_t first = group.begin; first < group.end; first += static_cast<std::int32_t>(kLanes)) {
      const PixelBatch batch = batch_of(of_taps, *of_slice, group, first);
      const auto begin = static_cast<std::size_t>(first);
      alignas(32) float sums[kLanes];
      const auto inside = [&](std::size_t lane) {
        return of_taps.reach({batch.x[lane], batch.y[lane], batch.z[lane]}, margin) == Reach::interior;
      };
      bool all_inside = true;
      for (std::size_t lane = 0; all_inside && lane < batch.count; ++lane) all_inside = inside(lane);
      if (all_inside) {
        std::fill(sums, sums + kLanes, of_taps.total());
      } else if (ones != nullptr) {
        kernels.gather(list, batch, ones, sums);
      } else {
        kernels.weigh(list, batch, sums);
      }
      std::vector<float>& share = mask_values != nullptr ? of_slice->share : of_slice->weight;
      std::copy(sums, sums + batch.count, share.begin() + first);
      if (mask_values == nullptr) continue;
      kernels.gather(list, batch, mask_values, sums);
      for (std::size_t lane = 0; lane < batch.count; ++lane) of_slice->weight[begin + lane] = sums[lane];
    }
  }
}

void SliceAcquisition::Plan::find_pixels(const bool* slices_mask) {
  pixels.resize(taps.size());
  // A volume that is one voxel thick has no cell of 2 x 2 x 2 voxels.
  if (taps.empty() || shape.width < 2 || shape.height < 2 || shape.depth < 2) return;
  const TileGrid grid(shape, taps);
  torch::Tensor ones, mask_values;
  if (blurs()) {
    ones = torch::ones({shape.depth, shape.height, shape.width}, torch::kFloat32);
    blur_volume(blur, shape, ones.data_ptr<float>(), ones.data_ptr<float>());
  }
  if (volume_mask.defined()) {
    mask_values = volume_mask.to(torch::kFloat32).contiguous();
    blur_volume(blur, shape, mask_values.data_ptr<float>(), mask_values.data_ptr<float>());
  }
  parallel_tasks(slice_count(), [&](std::int64_t slice) {
    const auto s = static_cast<std::size_t>(slice);
    const bool* mask = slices_mask != nullptr ? slices_mask + slice * height * width : nullptr;
    pixels[s] = group_pixels(taps[s], grid, mask, height, width);
    weigh_pixels(&pixels[s], taps[s], ones.defined() ? ones.data_ptr<float>() : nullptr,
                 mask_values.defined() ? mask_values.data_ptr<float>() : nullptr);
  });

  std::vector<Tile> all(static_cast<std::size_t>(grid.count()));
  for (std::size_t slice = 0; slice < pixels.size(); ++slice) {
    for (std::size_t group = 0; group < pixels[slice].groups.size(); ++group) {
      const PixelGroup& g = pixels[slice].groups[group];
      Tile& tile = all[static_cast<std::size_t>(g.tile)];
      tile.groups.push_back({static_cast<std::int32_t>(slice), static_cast<std::int32_t>(group)});
      tile.pixels += g.end - g.begin;
    }
  }
  std::vector<std::size_t> order(all.size());
  std::iota(order.begin(), order.end(), std::size_t{0});
  const auto colour_of = [&grid](std::size_t tile) {
    return static_cast<std::size_t>(grid.colour(static_cast<std::int32_t>(tile)));
  };
  std::stable_sort(order.begin(), order.end(), [&](std::size_t a, std::size_t b) {
    return colour_of(a) != colour_of(b) ? colour_of(a) < colour_of(b) : all[a].pixels > all[b].pixels;
  });
  for (const std::size_t tile : order) {
    if (all[tile].groups.empty()) continue;
    tiles.push_back(std::move(all[tile]));
    for (std::size_t c = colour_of(tile) + 1; c < colour.size(); ++c) colour[c] = tiles.size();
  }
}

// What forward() samples: the volume within its mask, blurred.
torch::Tensor SliceAcquisition::Plan::gathered_volume(const torch::Tensor& volume) const {
  torch::Tensor source = checked_volume(volume);
  // Not a product: a value outside the mask has no influence even if it is not a number.
  if (volume_mask.defined()) source = source.masked_fill(~volume_mask, 0.);
  if (!blurs()) return source;
  torch::Tensor blurred = torch::empty_like(source);
  blur_volume(blur, shape, source.data_ptr<float>(), blurred.data_ptr<float>());
  return blurred;
}

// Turns what the scatter summed up into a volume. The mask only says where values may land.
void SliceAcquisition::Plan::finish_volume(torch::Tensor* volume) const {
  blur_volume(blur, shape, volume->data_ptr<float>(), volume->data_ptr<float>());
  if (volume_mask.defined()) volume->masked_fill_(~volume_mask, 0.);
}

template <class Real, class Kernel>
void SliceAcquisition::Plan::scatter_sums(const float* slices, double factor, Kernel kernel, Real* sums) const {
  for_each_batch_exclusively([&](std::size_t slice, const TapList& list, std::size_t first, const PixelBatch& batch) {
    alignas(32) float value[kLanes] = {}, scales[kLanes] = {};
    bool adds = false;
    for (std::size_t lane = 0; lane < batch.count; ++lane) {
      const float share = scale(pixels[slice], first + lane);
      if (share == 0.F) continue;
      scales[lane] = static_cast<float>(factor * static_cast<double>(share));
      value[lane] = slices[offset(static_cast<std::int64_t>(slice), first + lane)];
      adds = true;
    }
    if (adds) kernel(list, batch, value, scales, sums);
  });
}

template <class Real>
torch::Tensor SliceAcquisition::Plan::divide_sums(const Real* sums, double smallest) const {
  torch::Tensor volume = new_volume(), weights = new_volume();
  float* value = volume.data_ptr<float>();
  float* weight = weights.data_ptr<float>();
  parallel_chunks(shape.voxel_count(), [&](std::int64_t begin, std::int64_t end) {
    for (std::int64_t i = begin; i < end; ++i) {
      if (!(static_cast<double>(sums[2 * i + 1]) > smallest)) continue;
      value[i] = static_cast<float>(sums[2 * i]);
      weight[i] = static_cast<float>(sums[2 * i + 1]);
    }
  });
  blur_volume(blur, shape, value, value);
  blur_volume(blur, shape, weight, weight);
  const bool* in_mask = mask();
  parallel_chunks(shape.voxel_count(), [&](std::int64_t begin, std::int64_t end) {
    for (std::int64_t i = begin; i < end; ++i) {
      const bool counts = weight[i] > least_weight && (in_mask == nullptr || in_mask[i]);
      value[i] = counts ? value[i] / weight[i] : 0.F;
    }
  });
  return volume;
}

SliceAcquisition::SliceAcquisition(const AcquisitionGeometry& geometry, int height, int width,
                                   const std::array<std::int64_t, 3>& volume_shape, AcquisitionFormulation formulation,
                                   const AcquisitionMasks& masks) {
  const torch::NoGradGuard no_grad;
  const torch::Tensor transforms = checked(geometry.transforms, "geometry.transforms", torch::kFloat32, {-1, 3, 4});
  const bool several = geometry.psf.defined() && geometry.psf.dim() == 4;
  torch::Tensor psf =
      checked(geometry.psf, "geometry.psf", torch::kFloat32,
              several ? std::vector<std::int64_t>{-1, -1, -1, -1} : std::vector<std::int64_t>{-1, -1, -1});
  if (!torch::isfinite(transforms).all().item<bool>()) reject("geometry.transforms holds values that are not finite");
  if (!torch::isfinite(psf).all().item<bool>()) reject("geometry.psf holds values that are not finite");
  if (!(geometry.resolution_ratio > 0.) || !(geometry.resolution_ratio < std::numeric_limits<float>::max())) {
    reject("geometry.resolution_ratio must be finite and positive, got " + std::to_string(geometry.resolution_ratio));
  }
  const std::int64_t slices = transforms.size(0);
  check_sizes(slices, height, width, volume_shape);
  torch::Tensor slices_mask, psf_index;
  if (masks.slices.defined()) {
    slices_mask = checked(masks.slices, "masks.slices", torch::kBool, {slices, 1, height, width});
  }
  const auto plan = std::make_shared<Plan>();
  if (masks.volume.defined()) {
    // A copy: the weights below hold for these values.
    plan->volume_mask =
        checked(masks.volume, "masks.volume", torch::kBool, {volume_shape[0], volume_shape[1], volume_shape[2]})
            .clone();
  }
  if (!several) psf = psf.unsqueeze(0);
  if (several || geometry.psf_of_slice.defined()) {
    psf_index = checked(geometry.psf_of_slice, "geometry.psf_of_slice", torch::kInt64, {slices});
    if (((psf_index < 0) | (psf_index >= psf.size(0))).any().item<bool>()) {
      reject("geometry.psf_of_slice must be in 0 .. " + std::to_string(psf.size(0) - 1));
    }
  }
  plan->formulation = formulation;
  plan->shape = {static_cast<std::int32_t>(volume_shape[2]), static_cast<std::int32_t>(volume_shape[1]),
                 static_cast<std::int32_t>(volume_shape[0])};
  plan->height = height;
  plan->width = width;
  const std::array<std::int64_t, 3> psf_size = {psf.size(1), psf.size(2), psf.size(3)};
  std::vector<PsfTaps> lists;
  if (formulation == AcquisitionFormulation::fast) {
    PsfSplit split = split_psfs(kName, psf.data_ptr<float>(), psf.size(0), psf_size);
    plan->blur = std::move(split.blur);
    lists = std::move(split.remain);
    plan->least_weight = least_weight_of(psf, geometry.resolution_ratio);
  } else {
    plan->blur = {1.F};
    for (std::int64_t i = 0; i < psf.size(0); ++i) lists.push_back(nonzero_taps(psf[i].data_ptr<float>(), psf_size));
  }
  for (const PsfTaps& list : lists) plan->psfs.push_back(spread_taps(list));
  plan->taps.reserve(static_cast<std::size_t>(slices));
  for (std::int64_t slice = 0; slice < slices; ++slice) {
    const std::int64_t index = psf_index.defined() ? psf_index.data_ptr<std::int64_t>()[slice] : 0;
    plan->taps.emplace_back(plan->psfs[static_cast<std::size_t>(index)], transforms.data_ptr<float>() + 12 * slice,
                            plan->shape, plan->width, plan->height, geometry.resolution_ratio);
  }
  plan->find_pixels(slices_mask.defined() ? slices_mask.data_ptr<bool>() : nullptr);
  plan_ = plan;
}

torch::Tensor SliceAcquisition::forward(const torch::Tensor& volume, torch::Tensor* weight) const {
  const torch::NoGradGuard no_grad;
  const Plan& plan = *plan_;
  const torch::Tensor source = plan.gathered_volume(volume);
  torch::Tensor slices = plan.new_slices();
  torch::Tensor weights = weight != nullptr ? plan.new_slices() : torch::Tensor();
  const float* voxels = source.data_ptr<float>();
  float* values = slices.data_ptr<float>();
  float* weight_values = weight != nullptr ? weights.data_ptr<float>() : nullptr;
  const TapKernels& kernels = tap_kernels();
  plan.for_each_batch([&](std::size_t slice, const TapList& list, std::size_t first, const PixelBatch& batch) {
    alignas(32) float sums[kLanes];
    kernels.gather(list, batch, voxels, sums);
    for (std::size_t lane = 0; lane < batch.count; ++lane) {
      const float inside = plan.pixels[slice].weight[first + lane];
      if (!(inside > 0.F)) continue;
      const std::int64_t pixel = plan.offset(static_cast<std::int64_t>(slice), first + lane);
      values[pixel] = sums[lane] / inside;
      if (weight_values != nullptr) weight_values[pixel] = inside;
    }
  });
  if (weight != nullptr) *weight = weights;
  return slices;
}

torch::Tensor SliceAcquisition::adjoint(const torch::Tensor& slices, bool equalize) const {
  const torch::NoGradGuard no_grad;
  const Plan& plan = *plan_;
  const torch::Tensor source = plan.checked_slices(slices);
  const float* pixels = source.data_ptr<float>();
  const TapKernels& kernels = tap_kernels();
  if (equalize) {
    std::vector<float> sums(static_cast<std::size_t>(2 * plan.shape.voxel_count()), 0.F);
    plan.scatter_sums(pixels, 1., kernels.scatter_pairs, sums.data());
    return plan.divide_sums(sums.data(), 0.);
  }
  torch::Tensor volume = plan.new_volume();
  float* voxels = volume.data_ptr<float>();
  plan.for_each_batch_exclusively(
      [&](std::size_t slice, const TapList& list, std::size_t first, const PixelBatch& batch) {
        alignas(32) float value[kLanes] = {};
        bool adds = false;  // a pixel of value 0 adds nothing to a plain sum
        for (std::size_t lane = 0; lane < batch.count; ++lane) {
          const float scale = plan.scale(plan.pixels[slice], first + lane);
          if (scale == 0.F) continue;
          value[lane] = pixels[plan.offset(static_cast<std::int64_t>(slice), first + lane)] * scale;
          adds = adds || value[lane] != 0.F;
        }
        if (adds) kernels.scatter(list, batch, value, voxels);
      });
  plan.finish_volume(&volume);
  return volume;
}

torch::Tensor SliceAcquisition::normal(const torch::Tensor& volume, const torch::Tensor& weights) const {
  const torch::NoGradGuard no_grad;
  const Plan& plan = *plan_;
  const torch::Tensor source = plan.gathered_volume(volume);
  const torch::Tensor slice_weights =
      weights.defined() ? checked(weights, "weights", torch::kFloat32, {plan.slice_count()}) : torch::Tensor();
  const float* w = weights.defined() ? slice_weights.data_ptr<float>() : nullptr;
  torch::Tensor result = plan.new_volume();
  const float* from = source.data_ptr<float>();
  float* to = result.data_ptr<float>();
  const TapKernels& kernels = tap_kernels();
  plan.for_each_batch_exclusively(
      [&](std::size_t slice, const TapList& list, std::size_t first, const PixelBatch& batch) {
        const float of_slice = w != nullptr ? w[slice] : 1.F;
        if (of_slice == 0.F) return;
        alignas(32) float value[kLanes];
        kernels.gather(list, batch, from, value);
        for (std::size_t lane = 0; lane < batch.count; ++lane) {
          const float inside = plan.pixels[slice].weight[first + lane];
          const float scale = inside > 0.F ? plan.scale(plan.pixels[slice], first + lane) : 0.F;
          value[lane] = scale == 0.F ? 0.F : (value[lane] / inside * of_slice) * scale;
        }
        kernels.scatter(list, batch, value, to);
      });
  plan.finish_volume(&result);
  return result;
}

torch::Tensor SliceAcquisition::empty_sums() const {
  const Plan& plan = *plan_;
  return torch::zeros({plan.shape.depth, plan.shape.height, plan.shape.width, 2}, torch::kFloat64);
}

void SliceAcquisition::add_to_sums(const torch::Tensor& slices, double factor, torch::Tensor* sums) const {
  const torch::NoGradGuard no_grad;
  const Plan& plan = *plan_;
  const torch::Tensor source = plan.checked_slices(slices);
  const torch::Tensor target =
      checked(*sums, "sums", torch::kFloat64, {plan.shape.depth, plan.shape.height, plan.shape.width, 2});
  if (target.data_ptr() != sums->data_ptr()) reject("sums must be contiguous");
  plan.scatter_sums(source.data_ptr<float>(), factor, tap_kernels().scatter_double_pairs, target.data_ptr<double>());
}

torch::Tensor SliceAcquisition::equalized_volume(const torch::Tensor& sums) const {
  const torch::NoGradGuard no_grad;
  const Plan& plan = *plan_;
  const torch::Tensor source =
      checked(sums, "sums", torch::kFloat64, {plan.shape.depth, plan.shape.height, plan.shape.width, 2});
  return plan.divide_sums(source.data_ptr<double>(), kRoundingOfSums);
}

std::int64_t SliceAcquisition::slice_count() const { return plan_->slice_count(); }
std::int64_t SliceAcquisition::height() const { return plan_->height; }
std::int64_t SliceAcquisition::width() const { return plan_->width; }
std::array<std::int64_t, 3> SliceAcquisition::volume_shape() const { return plan_->volume_shape(); }
AcquisitionFormulation SliceAcquisition::formulation() const { return plan_->formulation; }

torch::Tensor acquire_slices(const torch::Tensor& volume, const AcquisitionGeometry& geometry, int height, int width,
                             const AcquisitionMasks& masks, torch::Tensor* weight) {
  const torch::Tensor source = checked(volume, "volume", torch::kFloat32, {-1, -1, -1});
  const SliceAcquisition acquisition(geometry, height, width, {source.size(0), source.size(1), source.size(2)},
                                     AcquisitionFormulation::exact, masks);
  return acquisition.forward(source, weight);
}

torch::Tensor scatter_slices(const torch::Tensor& slices, const AcquisitionGeometry& geometry,
                             const std::array<std::int64_t, 3>& volume_shape, bool equalize,
                             const AcquisitionMasks& masks) {
  const torch::Tensor source = checked(slices, "slices", torch::kFloat32, {-1, 1, -1, -1});
  constexpr std::int64_t kLargest = std::numeric_limits<int>::max();
  const SliceAcquisition acquisition(geometry, static_cast<int>(std::min(source.size(2), kLargest)),
                                     static_cast<int>(std::min(source.size(3), kLargest)), volume_shape,
                                     AcquisitionFormulation::exact, masks);
  if (acquisition.slice_count() != source.size(0)) {
    reject("slices and geometry.transforms must have the same count, got " + std::to_string(source.size(0)) + " and " +
           std::to_string(acquisition.slice_count()));
  }
  return acquisition.adjoint(source, equalize);
}

}  // namespace svort
