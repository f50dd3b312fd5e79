#include "acquisition_plan.h"

#include <torch/types.h>

#include <algorithm>
#include <limits>
#include <numeric>
#include <sstream>
#include <stdexcept>
#include <utility>

#include "plain_operator.h"
#ifdef SVORT_WITH_CUDA
#include "cuda/device_operator.h"
#endif

namespace svort {
namespace {

constexpr const char* kName = "SliceAcquisition";

std::string shape_text(const torch::Tensor& tensor) {
  if (!tensor.defined()) return "an undefined tensor";
  std::ostringstream text;
  text << tensor.sizes() << " " << c10::toString(tensor.scalar_type()) << " on " << tensor.device();
  return text.str();
}

void check_sizes(std::int64_t slices, std::int64_t height, std::int64_t width,
                 const std::array<std::int64_t, 3>& volume_shape) {
  // Offsets within one array are kept in 32 bits.
  constexpr std::int64_t kLargest = std::numeric_limits<std::int32_t>::max();
  double voxels = 1.;
  for (const std::int64_t size : volume_shape) {
    if (size < 1)
      reject_acquisition("the volume must have at least one voxel along each axis, got " + std::to_string(size));
    voxels *= static_cast<double>(size);
  }
  if (voxels > static_cast<double>(kLargest)) reject_acquisition("the volume has more than 2^31 - 1 voxels");
  constexpr std::int64_t kLongest = std::numeric_limits<std::uint16_t>::max();
  if (height < 1 || width < 1 || height > kLongest || width > kLongest) {
    reject_acquisition("slices must have at least one pixel and at most " + std::to_string(kLongest) +
                       " along each axis, got " + std::to_string(height) + " x " + std::to_string(width));
  }
  if (static_cast<double>(slices) * static_cast<double>(height) * static_cast<double>(width) >
      static_cast<double>(kLargest)) {
    reject_acquisition("the slices have more than 2^31 - 1 pixels");
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

// What the vectorised kernels do, as parts that autograd can be put on; the gradient of the poses is the plain one.
class VectorOperator : public PlainOperator<float> {
 public:
  VectorOperator(const AcquisitionPlan& plan, std::shared_ptr<const PixelTable> table)
      : PlainOperator<float>(std::move(table), plan.transforms), plan_(plan) {}

  torch::Tensor gather(const torch::Tensor& volume) const override {
    torch::Tensor slices = plan_.new_slices();
    plan_.gather(volume.data_ptr<float>(), slices.data_ptr<float>(),
                 [](const SlicePixels&, std::size_t, float sum) { return sum; });
    return slices;
  }
  torch::Tensor scatter(const torch::Tensor& slices) const override {
    torch::Tensor volume = plan_.new_volume();
    plan_.scatter(slices.data_ptr<float>(), volume.data_ptr<float>(),
                  [](const SlicePixels&, std::size_t, float pixel) { return pixel; });
    return volume;
  }
  torch::Tensor blur(const torch::Tensor& volume) const override {
    torch::Tensor blurred = torch::empty_like(volume);
    blur_volume(plan_.blur, plan_.shape, volume.data_ptr<float>(), blurred.data_ptr<float>());
    return blurred;
  }

 private:
  const AcquisitionPlan& plan_;
};

}  // namespace

void reject_acquisition(const std::string& what) { throw std::invalid_argument(std::string(kName) + ": " + what); }

void check_acquisition_tensor(const torch::Tensor& tensor, const char* name, torch::ScalarType type,
                              const torch::Device& device, const std::vector<std::int64_t>& shape) {
  bool fits = tensor.defined() && tensor.device() == device && tensor.scalar_type() == type &&
              tensor.dim() == static_cast<std::int64_t>(shape.size());
  for (std::size_t axis = 0; fits && axis < shape.size(); ++axis) {
    fits = shape[axis] < 0 || tensor.size(static_cast<std::int64_t>(axis)) == shape[axis];
  }
  if (fits) return;
  std::ostringstream expected;
  for (std::size_t axis = 0; axis < shape.size(); ++axis) {
    expected << (axis ? " x " : "") << (shape[axis] < 0 ? std::string("any") : std::to_string(shape[axis]));
  }
  expected << ", " << c10::toString(type) << ", on " << device;
  reject_acquisition(std::string(name) + " must be " + expected.str() + ", got " + shape_text(tensor));
}

const char* to_string(AcquisitionFormulation formulation) {
  return formulation == AcquisitionFormulation::exact ? "exact" : "fast";
}

AcquisitionFormulation acquisition_formulation(const std::string& name) {
  for (const auto formulation : {AcquisitionFormulation::exact, AcquisitionFormulation::fast}) {
    if (name == to_string(formulation)) return formulation;
  }
  throw std::invalid_argument("the formulation of the forward model must be exact or fast, got '" + name + "'");
}

AcquisitionPlan::AcquisitionPlan(const AcquisitionGeometry& geometry, int slice_height, int slice_width,
                                 const std::array<std::int64_t, 3>& volume_size, AcquisitionFormulation how,
                                 const AcquisitionMasks& masks)
    : formulation(how), height(slice_height), width(slice_width), resolution_ratio(geometry.resolution_ratio) {
  // Type and device of the transforms are those of the operator.
  if (geometry.transforms.defined()) {
    if (geometry.transforms.scalar_type() == torch::kFloat64) type = torch::kFloat64;
    device = geometry.transforms.device();
  }
  check_acquisition_tensor(geometry.transforms, "geometry.transforms", type, device, {-1, 3, 4});
  transforms = geometry.transforms;
  const torch::NoGradGuard no_grad;
  if (!device.is_cpu()) {
#ifdef SVORT_WITH_CUDA
    if (!device.is_cuda()) reject_acquisition("geometry.transforms must be on the CPU or a CUDA device");
#else
    reject_acquisition(
        "geometry.transforms is not on the CPU, and this build has no CUDA (SVORT_WITH_CUDA); move all tensors there");
#endif
    if (type != torch::kFloat32) reject_acquisition("float64 is for the CPU; geometry.transforms must be float32");
  }
  const torch::Tensor matrices = transforms.detach().to(torch::kCPU, torch::kFloat32).contiguous();
  const bool several = geometry.psf.defined() && geometry.psf.dim() == 4;
  torch::Tensor psf = geometry.psf.defined() ? geometry.psf.detach().to(torch::kCPU).contiguous() : geometry.psf;
  check_acquisition_tensor(psf, "geometry.psf", torch::kFloat32, torch::kCPU,
                           several ? std::vector<std::int64_t>{-1, -1, -1, -1} : std::vector<std::int64_t>{-1, -1, -1});
  if (!torch::isfinite(matrices).all().item<bool>()) {
    reject_acquisition("geometry.transforms holds values that are not finite");
  }
  if (!torch::isfinite(psf).all().item<bool>()) reject_acquisition("geometry.psf holds values that are not finite");
  if (!(resolution_ratio > 0.) || !(resolution_ratio < std::numeric_limits<float>::max())) {
    reject_acquisition("geometry.resolution_ratio must be finite and positive, got " +
                       std::to_string(resolution_ratio));
  }
  const std::int64_t slices = matrices.size(0);
  check_sizes(slices, height, width, volume_size);
  torch::Tensor slices_mask, index;
  if (masks.slices.defined()) {
    check_acquisition_tensor(masks.slices, "masks.slices", torch::kBool, device, {slices, 1, height, width});
    slices_mask = masks.slices.to(torch::kCPU).contiguous();
  }
  if (masks.volume.defined()) {
    check_acquisition_tensor(masks.volume, "masks.volume", torch::kBool, device,
                             {volume_size[0], volume_size[1], volume_size[2]});
    // A copy: the weights below hold for these values.
    volume_mask = masks.volume.clone(torch::MemoryFormat::Contiguous);
  }
  if (!several) psf = psf.unsqueeze(0);
  if (several || geometry.psf_of_slice.defined()) {
    index = geometry.psf_of_slice.defined() ? geometry.psf_of_slice.to(torch::kCPU).contiguous() : torch::Tensor();
    check_acquisition_tensor(index, "geometry.psf_of_slice", torch::kInt64, torch::kCPU, {slices});
    if (((index < 0) | (index >= psf.size(0))).any().item<bool>()) {
      reject_acquisition("geometry.psf_of_slice must be in 0 .. " + std::to_string(psf.size(0) - 1));
    }
  }
  shape = {static_cast<std::int32_t>(volume_size[2]), static_cast<std::int32_t>(volume_size[1]),
           static_cast<std::int32_t>(volume_size[0])};
  const std::array<std::int64_t, 3> psf_size = {psf.size(1), psf.size(2), psf.size(3)};
  std::vector<PsfTaps> lists;
  if (formulation == AcquisitionFormulation::fast) {
    PsfSplit split = split_psfs(kName, psf.data_ptr<float>(), psf.size(0), psf_size);
    blur = std::move(split.blur);
    lists = std::move(split.remain);
    least_weight = least_weight_of(psf, resolution_ratio);
  } else {
    blur = {1.F};
    for (std::int64_t i = 0; i < psf.size(0); ++i) lists.push_back(nonzero_taps(psf[i].data_ptr<float>(), psf_size));
  }
  for (const PsfTaps& list : lists) psfs.push_back(spread_taps(list));
  taps.reserve(static_cast<std::size_t>(slices));
  for (std::int64_t slice = 0; slice < slices; ++slice) {
    psf_index.push_back(index.defined() ? static_cast<std::size_t>(index.data_ptr<std::int64_t>()[slice]) : 0);
    taps.emplace_back(psfs[psf_index.back()], matrices.data_ptr<float>() + 12 * slice, shape, width, height,
                      resolution_ratio);
  }
  find_pixels(slices_mask.defined() ? slices_mask.data_ptr<bool>() : nullptr);
}

const AcquisitionPlan::General& AcquisitionPlan::general() const {
  std::call_once(general_once_, [this] {
    const torch::NoGradGuard no_grad;
    if (type == torch::kFloat64) {
      auto plain = std::make_unique<PlainOperator<double>>(table(), transforms);
      general_.share = plain->weight({});
      general_.weight = volume_mask.defined() ? plain->weight(volume_mask) : general_.share;
      general_.linear = std::move(plain);
      return;
    }
    general_.share = pixel_weights(/*masked=*/false).to(device);
    general_.weight = volume_mask.defined() ? pixel_weights(/*masked=*/true).to(device) : general_.share;
#ifdef SVORT_WITH_CUDA
    if (device.is_cuda()) {
      general_.linear = device_operator(*table(), transforms);
      return;
    }
#endif
    general_.linear = std::make_unique<VectorOperator>(*this, table());
  });
  return general_;
}

torch::Tensor AcquisitionPlan::pixel_weights(bool masked) const {
  torch::Tensor weights = torch::zeros({slice_count(), 1, height, width}, torch::kFloat32);
  float* values = weights.data_ptr<float>();
  for (std::size_t slice = 0; slice < pixels.size(); ++slice) {
    const SlicePixels& of_slice = pixels[slice];
    for (std::size_t i = 0; i < of_slice.count(); ++i) {
      values[offset(static_cast<std::int64_t>(slice), i)] = masked ? of_slice.weight[i] : of_slice.share_of(i);
    }
  }
  return weights;
}

std::shared_ptr<const PixelTable> AcquisitionPlan::table() const {
  const auto table = std::make_shared<PixelTable>();
  table->slice_count = static_cast<std::int32_t>(slice_count());
  table->slice_width = width;
  table->slice_height = height;
  table->shape = shape;
  table->resolution_ratio = resolution_ratio;
  table->blur = blur;
  std::vector<std::int32_t> first_tap = {0};
  for (const PsfTaps& psf : psfs) {
    for (std::size_t t = 0; t < psf.count(); ++t) {
      table->taps.insert(table->taps.end(), psf.offset[t].begin(), psf.offset[t].end());
      table->taps.push_back(psf.value[t]);
    }
    first_tap.push_back(first_tap.back() + static_cast<std::int32_t>(psf.count()));
  }
  table->pixel_begin.push_back(0);
  for (std::size_t slice = 0; slice < pixels.size(); ++slice) {
    table->tap_begin.push_back(first_tap[psf_index[slice]]);
    table->tap_end.push_back(first_tap[psf_index[slice] + 1]);
    table->column.insert(table->column.end(), pixels[slice].column.begin(), pixels[slice].column.end());
    table->row.insert(table->row.end(), pixels[slice].row.begin(), pixels[slice].row.end());
    table->slice.insert(table->slice.end(), pixels[slice].count(), static_cast<std::int32_t>(slice));
    table->pixel_begin.push_back(static_cast<std::int32_t>(table->slice.size()));
  }
  for (const Tile& tile : tiles) {
    table->tiles.emplace_back();
    for (const GroupOfSlice& item : tile.groups) {
      const auto slice = static_cast<std::size_t>(item.slice);
      const PixelGroup& group = pixels[slice].groups[static_cast<std::size_t>(item.group)];
      const std::int32_t first = table->pixel_begin[slice];
      table->tiles.back().push_back({first + group.begin, first + group.end});
    }
  }
  table->colour = colour;
  return table;
}

void AcquisitionPlan::weigh_pixels(SlicePixels* of_slice, const SliceTaps& of_taps, const float* ones,
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

void AcquisitionPlan::find_pixels(const bool* slices_mask) {
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
    mask_values = volume_mask.to(torch::kCPU, torch::kFloat32).contiguous();
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

}  // namespace svort
