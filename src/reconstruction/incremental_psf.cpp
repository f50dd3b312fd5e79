#include "svort_ros/reconstruction/incremental_psf.h"

#include <torch/types.h>

#include <algorithm>
#include <stdexcept>
#include <string>

namespace svort {
namespace {

constexpr const char* kName = "IncrementalPsfReconstruction";

[[noreturn]] void reject(const std::string& what) { throw std::invalid_argument(std::string(kName) + ": " + what); }

}  // namespace

IncrementalPsfReconstruction::IncrementalPsfReconstruction(
    const torch::Tensor& slices, const AcquisitionGeometry& geometry, const std::array<std::int64_t, 3>& volume_shape,
    AcquisitionFormulation formulation, const AcquisitionMasks& masks, const IncrementalPsfOptions& options)
    : geometry_(geometry), volume_shape_(volume_shape), formulation_(formulation), masks_(masks), options_(options) {
  if (!slices.defined() || slices.dim() != 4) reject("slices must be n x 1 x h x w");
  if (options.rebuild_every < 1) {
    reject("rebuild_every is " + std::to_string(options.rebuild_every) + ", must be at least 1");
  }
  slices_ = slices.detach();
  if (geometry.transforms.defined()) geometry_.transforms = geometry.transforms.detach().clone();
  rebuild();
}

SliceAcquisition IncrementalPsfReconstruction::acquisition_of(const torch::Tensor& index,
                                                              const torch::Tensor& transforms) const {
  AcquisitionGeometry geometry = geometry_;
  geometry.transforms = transforms;
  if (geometry.psf_of_slice.defined()) geometry.psf_of_slice = geometry.psf_of_slice.index_select(0, index);
  AcquisitionMasks masks = masks_;
  if (masks.slices.defined()) masks.slices = masks.slices.index_select(0, index);
  return SliceAcquisition(geometry, static_cast<int>(slices_.size(2)), static_cast<int>(slices_.size(3)), volume_shape_,
                          formulation_, masks);
}

void IncrementalPsfReconstruction::rebuild() {
  const SliceAcquisition all(geometry_, static_cast<int>(slices_.size(2)), static_cast<int>(slices_.size(3)),
                             volume_shape_, formulation_, masks_);
  sums_ = all.empty_sums();
  all.add_to_sums(slices_, 1., &sums_);
  replaced_ = 0;
  ++rebuild_count_;
}

void IncrementalPsfReconstruction::replace(const std::vector<std::int64_t>& slices, const torch::Tensor& transforms) {
  std::vector<std::int64_t> sorted = slices;
  std::sort(sorted.begin(), sorted.end());
  if (!sorted.empty() && (sorted.front() < 0 || sorted.back() >= slices_.size(0))) {
    reject("slice " + std::to_string(sorted.front() < 0 ? sorted.front() : sorted.back()) + " of 0 .. " +
           std::to_string(slices_.size(0) - 1));
  }
  const auto twice = std::adjacent_find(sorted.begin(), sorted.end());
  if (twice != sorted.end()) reject("slice " + std::to_string(*twice) + " is given twice");
  if (!transforms.defined() || transforms.dim() != 3 ||
      transforms.size(0) != static_cast<std::int64_t>(slices.size())) {
    reject("transforms must be " + std::to_string(slices.size()) + " x 3 x 4, one per slice");
  }
  if (slices.empty()) return;
  const torch::Tensor index = torch::tensor(slices, torch::kInt64);
  // Both are checked before anything changes.
  const SliceAcquisition before = acquisition_of(index, geometry_.transforms.index_select(0, index));
  const SliceAcquisition after = acquisition_of(index, transforms);
  geometry_.transforms.index_copy_(0, index, transforms.detach());
  replaced_ += static_cast<std::int64_t>(slices.size());
  if (replaced_ >= options_.rebuild_every) {
    rebuild();
    return;
  }
  const torch::Tensor moved = slices_.index_select(0, index);
  before.add_to_sums(moved, -1., &sums_);
  after.add_to_sums(moved, 1., &sums_);
}

torch::Tensor IncrementalPsfReconstruction::volume() const {
  const torch::Tensor none = torch::empty({0}, torch::kInt64);
  return acquisition_of(none, geometry_.transforms.slice(0, 0, 0)).equalized_volume(sums_);
}

}  // namespace svort
