#pragma once

#include <torch/types.h>

#include <array>
#include <cstdint>

namespace svort {

/// Optional binary masks; an undefined tensor means "everything".
struct AcquisitionMasks {
  torch::Tensor slices;  ///< n x 1 x h x w, bool
  torch::Tensor volume;  ///< D x H x W, bool
};

/// Geometry shared by the acquisition operator and its adjoint. Works in voxels.
struct AcquisitionGeometry {
  torch::Tensor transforms;       ///< n x 3 x 4, trans_first, translation in voxels: slice coordinates -> volume
  torch::Tensor psf;              ///< z x y x x, see gaussian_psf; or m x z x y x x, stacked by stack_psfs
  double resolution_ratio = 1.0;  ///< slice pixel / voxel size
  torch::Tensor psf_of_slice{};   ///< n, int64: which of the m each slice has; undefined if psf is a single one
};

/// A = D B T of the paper (sec. 2): the slices that the scanner would see of `volume`, exact formulation.
///
/// Each pixel is the PSF-weighted mean of the volume (trilinear), normalised by the PSF weight that falls inside the
/// volume (and its mask). Pixels outside the slice mask, or with no weight, are 0. A tap counts only if all 8 voxels
/// that it interpolates between exist. Same bytes for any number of threads; no gradients (the result is detached).
///
/// @param volume D x H x W, float32, CPU
/// @param height, width  slice size in pixels
/// @param weight if not null, receives the PSF weight inside the volume, n x 1 x h x w
/// @return n x 1 x h x w
/// @throws std::invalid_argument naming the argument if a shape, type or device does not fit
torch::Tensor acquire_slices(const torch::Tensor& volume, const AcquisitionGeometry& geometry, int height, int width,
                             const AcquisitionMasks& masks = {}, torch::Tensor* weight = nullptr);

/// Adjoint of A: spreads the slices into a volume with the same taps. Same bytes for any number of threads.
///
/// As in the public implementation, pixels with less than half of their PSF inside the volume are left out, and a
/// volume mask suppresses voxels without changing a pixel's normalisation. So <A x, y> = <x, A^T y> holds exactly when
/// there is no volume mask and every pixel in the slice mask has a weight of at least 0.5.
///
/// @param slices   n x 1 x h x w, float32, CPU
/// @param volume_shape D, H, W
/// @param equalize divide each voxel by the weight it received (PSF reconstruction); otherwise the plain sum
/// @return D x H x W; voxels that no pixel reaches are 0
/// @throws std::invalid_argument as acquire_slices()
torch::Tensor scatter_slices(const torch::Tensor& slices, const AcquisitionGeometry& geometry,
                             const std::array<std::int64_t, 3>& volume_shape, bool equalize,
                             const AcquisitionMasks& masks = {});

}  // namespace svort
