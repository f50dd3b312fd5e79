#pragma once

#include <torch/types.h>

#include <cstdint>
#include <vector>

#include "svort_ros/acquisition/slice_acquisition.h"
#include "svort_ros/geometry/pose.h"

namespace svort {

/// Slices put together, and how much each voxel received.
struct WeightedVolume {
  torch::Tensor sums;     ///< D x H x W; sum of weight x PSF x pixel
  torch::Tensor support;  ///< D x H x W; sum of weight x PSF

  /// PSF reconstruction: sums over support; 0 where the support is below a thousandth of its largest value.
  torch::Tensor mean() const;
};

/// The voxels of a contiguous float32 volume on the CPU.
std::vector<float> values_of(const torch::Tensor& volume);

/// @param slices  n x 1 x h x w
/// @param weights n
WeightedVolume weighted_volume(const torch::Tensor& slices, const SliceAcquisition& acquisition,
                               const std::vector<double>& weights);

/// Fast formulation, a cube of `size` voxels.
SliceAcquisition cube_acquisition(const torch::Tensor& masks, const std::vector<Pose>& poses,
                                  const std::vector<double>& thickness_mm, double pixel_mm, std::int64_t size,
                                  double voxel_mm);

}  // namespace svort
