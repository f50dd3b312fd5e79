#pragma once

#include <torch/types.h>

#include <array>
#include <cstdint>
#include <memory>
#include <mutex>
#include <string>
#include <vector>

#include "parallel.h"
#include "pixel_plan.h"
#include "psf_split.h"
#include "slice_operator.h"
#include "svort_ros/acquisition/slice_acquisition.h"
#include "tap_kernels.h"
#include "tap_sampler.h"

namespace svort {

/// Pixels with less than this share of the PSF inside the volume are not scattered (rule of the public implementation).
constexpr float kSmallestShare = 0.5F;

[[noreturn]] void reject_acquisition(const std::string& what);

/// @throws std::invalid_argument unless `tensor` has the type, device and shape (-1: any size)
void check_acquisition_tensor(const torch::Tensor& tensor, const char* name, torch::ScalarType type,
                              const torch::Device& device, const std::vector<std::int64_t>& shape);

/// One group of pixels of one slice.
struct GroupOfSlice {
  std::int32_t slice = 0, group = 0;
};

/// What one thread works on at a time.
struct Tile {
  std::int64_t pixels = 0;
  std::vector<GroupOfSlice> groups;
};

/// What the calls of a SliceAcquisition share.
class AcquisitionPlan {
 public:
  /// Arguments and errors as in SliceAcquisition's constructor.
  AcquisitionPlan(const AcquisitionGeometry& geometry, int height, int width,
                  const std::array<std::int64_t, 3>& volume_shape, AcquisitionFormulation formulation,
                  const AcquisitionMasks& masks);
  AcquisitionPlan(const AcquisitionPlan&) = delete;
  AcquisitionPlan& operator=(const AcquisitionPlan&) = delete;

  AcquisitionFormulation formulation = AcquisitionFormulation::exact;
  torch::ScalarType type = torch::kFloat32;  ///< of transforms, volumes and slices
  torch::Device device = torch::kCPU;
  torch::Tensor transforms;  ///< n x 3 x 4, as given: part of the caller's graph if it has one
  VolumeShape shape;
  std::int32_t height = 0, width = 0;
  double resolution_ratio = 1.;
  float least_weight = 0.F;             ///< voxels that receive no more are empty after the equalised scatter
  std::vector<float> blur;              ///< half kernel; {1} in the exact formulation
  std::vector<PsfTaps> psfs;            ///< `taps` point into it
  std::vector<std::size_t> psf_index;   ///< one per slice
  std::vector<SliceTaps> taps;          ///< one per slice, in float32
  std::vector<SlicePixels> pixels;      ///< one per slice
  std::vector<Tile> tiles;              ///< those that hold pixels, colour by colour, the fullest first
  std::array<std::size_t, 5> colour{};  ///< tiles of colour c are [colour[c], colour[c + 1])
  torch::Tensor volume_mask;            ///< D x H x W, bool, or undefined

  bool blurs() const { return blur.size() > 1; }
  std::array<std::int64_t, 3> volume_shape() const { return {shape.depth, shape.height, shape.width}; }
  std::int64_t slice_count() const { return static_cast<std::int64_t>(taps.size()); }
  torch::TensorOptions options() const { return torch::TensorOptions().dtype(type).device(device); }
  torch::Tensor new_slices() const { return torch::zeros({slice_count(), 1, height, width}, options()); }
  torch::Tensor new_volume() const { return torch::zeros({shape.depth, shape.height, shape.width}, options()); }
  void check_slices(const torch::Tensor& slices) const {
    check_acquisition_tensor(slices, "slices", type, device, {slice_count(), 1, height, width});
  }
  void check_volume(const torch::Tensor& volume) const {
    check_acquisition_tensor(volume, "volume", type, device, {shape.depth, shape.height, shape.width});
  }
  std::int64_t offset(std::int64_t slice, std::size_t pixel) const {
    const SlicePixels& of_slice = pixels[static_cast<std::size_t>(slice)];
    return (slice * height + of_slice.row[pixel]) * width + of_slice.column[pixel];
  }

  /// The kernels of tap_kernels.h do for this type and device; everything else takes general().
  bool vectorised() const { return type == torch::kFloat32 && device.is_cpu(); }

  /// The operator's parts as tensors that autograd can be put on.
  struct General {
    std::unique_ptr<SliceOperator> linear;
    torch::Tensor weight, share;  ///< PSF weight inside the volume and its mask, and inside the volume; n x 1 x h x w
  };
  /// Made by the first call.
  const General& general() const;

  /// PSF weight of each pixel inside the volume (`masked`: and its mask), n x 1 x h x w, float32, on the CPU.
  torch::Tensor pixel_weights(bool masked) const;
  /// Slices, taps and pixels as flat arrays.
  std::shared_ptr<const PixelTable> table() const;

  /// Calls visit(slice, kernel's taps, first pixel, batch) for all batches, in parallel, for visitors that write to
  /// their own pixels only.
  template <class Visit>
  void for_each_batch(const Visit& visit) const {
    parallel_tasks(static_cast<std::int64_t>(tiles.size()),
                   [&](std::int64_t tile) { visit_tile(tiles[static_cast<std::size_t>(tile)], visit); });
  }
  /// The same such that no two visitors at a time have taps in the same voxel.
  template <class Visit>
  void for_each_batch_exclusively(const Visit& visit) const {
    for (std::size_t c = 0; c < 4; ++c) {
      parallel_tasks(static_cast<std::int64_t>(colour[c + 1] - colour[c]),
                     [&](std::int64_t tile) { visit_tile(tiles[colour[c] + static_cast<std::size_t>(tile)], visit); });
    }
  }
  /// slices[pixel] = finish(slice, pixel, PSF-weighted sum of the volume); float32, CPU.
  template <class Finish>
  void gather(const float* volume, float* slices, const Finish& finish) const {
    const TapKernels& kernels = tap_kernels();
    for_each_batch([&](std::size_t slice, const TapList& list, std::size_t first, const PixelBatch& batch) {
      alignas(32) float sums[kLanes];
      kernels.gather(list, batch, volume, sums);
      for (std::size_t lane = 0; lane < batch.count; ++lane) {
        slices[offset(static_cast<std::int64_t>(slice), first + lane)] =
            finish(pixels[slice], first + lane, sums[lane]);
      }
    });
  }
  /// Adds PSF value x value(slice, pixel, slices[pixel]) to the volume; float32, CPU.
  template <class Value>
  void scatter(const float* slices, float* volume, const Value& value) const {
    const TapKernels& kernels = tap_kernels();
    for_each_batch_exclusively([&](std::size_t slice, const TapList& list, std::size_t first, const PixelBatch& batch) {
      alignas(32) float values[kLanes] = {};
      bool adds = false;  // a pixel of value 0 adds nothing to a plain sum
      for (std::size_t lane = 0; lane < batch.count; ++lane) {
        values[lane] =
            value(pixels[slice], first + lane, slices[offset(static_cast<std::int64_t>(slice), first + lane)]);
        adds = adds || values[lane] != 0.F;
      }
      if (adds) kernels.scatter(list, batch, values, volume);
    });
  }

 private:
  template <class Visit>
  void visit_tile(const Tile& tile, const Visit& visit) const {
    for (const GroupOfSlice& item : tile.groups) {
      const auto slice = static_cast<std::size_t>(item.slice);
      const PixelGroup& group = pixels[slice].groups[static_cast<std::size_t>(item.group)];
      const TapList list = taps[slice].list();
      for (std::int32_t first = group.begin; first < group.end; first += static_cast<std::int32_t>(kLanes)) {
        visit(slice, list, static_cast<std::size_t>(first), batch_of(taps[slice], pixels[slice], group, first));
      }
    }
  }
  void find_pixels(const bool* slices_mask);
  void weigh_pixels(SlicePixels* of_slice, const SliceTaps& of_taps, const float* ones, const float* mask_values) const;

  mutable std::once_flag general_once_;
  mutable General general_;
};

}  // namespace svort
