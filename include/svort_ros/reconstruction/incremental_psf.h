#pragma once

#include <torch/types.h>

#include <array>
#include <cstdint>
#include <vector>

#include "svort_ros/acquisition/slice_acquisition.h"

namespace svort {

struct IncrementalPsfOptions {
  /// Rebuild after so many slices were replaced. Rounding grows by about 1e-16 per replacement, so this only needs to
  /// be lowered for scans of many millions of them.
  std::int64_t rebuild_every = 10000;
};

/// PSF reconstruction of slices that move a few at a time: the terms of the slices that moved are replaced, the rest
/// stays. Equal to reconstruct_psf() of all slices at their current places, within rounding.
class IncrementalPsfReconstruction {
 public:
  /// @param slices n x 1 x h x w, float32, CPU; kept, not copied: do not change them
  /// @throws std::invalid_argument naming the argument that does not fit
  IncrementalPsfReconstruction(const torch::Tensor& slices, const AcquisitionGeometry& geometry,
                               const std::array<std::int64_t, 3>& volume_shape, AcquisitionFormulation formulation,
                               const AcquisitionMasks& masks = {}, const IncrementalPsfOptions& options = {});

  /// Moves slices. Nothing is changed if an exception is thrown.
  /// @param slices     numbers of the slices, 0 .. n - 1, each once
  /// @param transforms slices.size() x 3 x 4, their new places
  /// @throws std::invalid_argument if a number is out of range or given twice, or the transforms do not fit
  void replace(const std::vector<std::int64_t>& slices, const torch::Tensor& transforms);

  /// @return D x H x W
  torch::Tensor volume() const;

  /// Current places of all slices, n x 3 x 4.
  const torch::Tensor& transforms() const { return geometry_.transforms; }
  /// Complete sums so far, the first one included.
  std::int64_t rebuild_count() const { return rebuild_count_; }

 private:
  SliceAcquisition acquisition_of(const torch::Tensor& index, const torch::Tensor& transforms) const;
  void rebuild();

  torch::Tensor slices_;
  AcquisitionGeometry geometry_;
  std::array<std::int64_t, 3> volume_shape_;
  AcquisitionFormulation formulation_;
  AcquisitionMasks masks_;
  IncrementalPsfOptions options_;
  torch::Tensor sums_;
  std::int64_t replaced_ = 0, rebuild_count_ = 0;
};

}  // namespace svort
