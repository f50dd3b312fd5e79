#pragma once

#include <torch/types.h>

#include <array>
#include <cstdint>
#include <vector>

#include "svort_ros/acquisition/slice_acquisition.h"

namespace svort {

/// PSF reconstruction (paper, sec. 2.3): slices scattered with the PSF and divided by the weight that each voxel got.
/// Voxels that no slice reaches are 0. @return D x H x W
torch::Tensor reconstruct_psf(const torch::Tensor& slices, const AcquisitionGeometry& geometry,
                              const std::array<std::int64_t, 3>& volume_shape, const AcquisitionMasks& masks = {});

/// When conjugate gradients stop.
struct ConjugateGradientOptions {
  int iterations = 2;      ///< at most so many; 0 returns the start
  double tolerance = 0.;   ///< stop when |r| <= tolerance * |b|; 0 never stops early
};

/// What a solve did.
struct ConjugateGradientReport {
  int iterations = 0;
  std::vector<double> relative_residual;  ///< |r| / |b| before the first and after every iteration
};

/// Conjugate gradients on the paper's weighted inverse problem, argmin_x sum_i w_i |A_i x - y_i|^2.
///
/// Solves A^T W A x = A^T W y from `start`; the result is clamped at 0, as the public implementation does.
///
/// @param slices  y, n x 1 x h x w
/// @param weights w, n; an undefined tensor means 1
/// @param start   D x H x W, usually reconstruct_psf()
torch::Tensor solve_weighted_inverse(const torch::Tensor& slices, const AcquisitionGeometry& geometry,
                                     const torch::Tensor& weights, const torch::Tensor& start,
                                     const ConjugateGradientOptions& options, const AcquisitionMasks& masks = {},
                                     ConjugateGradientReport* report = nullptr);

/// A^T W A x, the normal operator of the weighted inverse problem.
torch::Tensor apply_normal_operator(const torch::Tensor& volume, const AcquisitionGeometry& geometry, int height,
                                    int width, const torch::Tensor& weights, const AcquisitionMasks& masks = {});

}  // namespace svort
