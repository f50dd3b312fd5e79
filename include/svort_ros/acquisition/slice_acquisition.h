#pragma once

#include <torch/types.h>

#include <array>
#include <cstdint>
#include <memory>
#include <string>

namespace svort {

/// Optional binary masks; an undefined tensor means "everything".
struct AcquisitionMasks {
  torch::Tensor slices;  ///< n x 1 x h x w, bool
  torch::Tensor volume;  ///< D x H x W, bool
};

/// Geometry shared by the acquisition operator and its adjoint. Works in voxels.
struct AcquisitionGeometry {
  torch::Tensor transforms;       ///< n x 3 x 4, trans_first, translation in voxels: slice coordinates -> volume
  torch::Tensor psf;              ///< z x y x x, float32, see gaussian_psf; or m x z x y x x, stacked by stack_psfs
  double resolution_ratio = 1.0;  ///< slice pixel / voxel size
  torch::Tensor psf_of_slice{};   ///< n, int64: which of the m each slice has; undefined if psf is a single one
};

/// How A is computed.
enum class AcquisitionFormulation {
  exact,  ///< every tap of the PSF for every pixel, as the public implementation does
  /// The PSF, a Gaussian, as an isotropic blur of the volume, once per call, and the few taps that remain along the
  /// slice's normal. About ten times faster; differs from exact by about 0.3 % (relative L2, see docs/performance.md).
  fast,
};

const char* to_string(AcquisitionFormulation formulation);

/// @throws std::invalid_argument unless `name` is "exact" or "fast"
AcquisitionFormulation acquisition_formulation(const std::string& name);

class AcquisitionPlan;

/// A = D B T of the paper (sec. 2) for one set of slices, its adjoint and the normal operator.
///
/// A pixel is the PSF-weighted mean of the volume (trilinear), normalised by the PSF weight that falls inside the
/// volume (and its mask). Pixels outside the slice mask, or with no weight, are 0. A tap counts only if all 8 voxels
/// that it interpolates between exist.
///
/// What the calls share (pixels to work on, their weights, the split of the work) is computed once, by the constructor.
/// All results are the same bytes for any number of threads. Copies share their data; all members are safe to call from
/// several threads.
///
/// Type and device are those of geometry.transforms, for volumes, slices, weights and results alike: float32 on the CPU
/// (vectorised), float64 on the CPU (pixel by pixel, about ten times slower: for checks of gradients), or float32 on a
/// CUDA device if the package was built with SVORT_WITH_CUDA.
///
/// forward(), adjoint() and normal() are part of the graph of their arguments and of geometry.transforms where those
/// require gradients, and cost what they cost without gradients where none does. The gradient of a pose is the slope of
/// the trilinear interpolation at every tap; it knows nothing of the jumps when a tap crosses the border of the volume,
/// or when a pixel's weight passes 0 or 0.5. Second derivatives are not defined.
class SliceAcquisition {
 public:
  /// @param height, width  slice size in pixels
  /// @param volume_shape   D, H, W
  /// @throws std::invalid_argument naming the argument if a shape, type or device does not fit; or, in the fast
  ///         formulation, if a PSF is not a Gaussian with its axes along the slice's (see gaussian_psf)
  SliceAcquisition(const AcquisitionGeometry& geometry, int height, int width,
                   const std::array<std::int64_t, 3>& volume_shape, AcquisitionFormulation formulation,
                   const AcquisitionMasks& masks = {});

  /// A x: the slices that the scanner would see.
  /// @param volume x, D x H x W
  /// @param weight if not null, receives the PSF weight inside the volume, n x 1 x h x w, detached
  /// @return n x 1 x h x w
  /// @throws std::invalid_argument if shape, type or device does not fit
  torch::Tensor forward(const torch::Tensor& volume, torch::Tensor* weight = nullptr) const;

  /// A^T y: spreads the slices into a volume with the same taps.
  ///
  /// As in the public implementation, pixels with less than half of their PSF inside the volume are left out, and a
  /// volume mask suppresses voxels without changing a pixel's normalisation. So <A x, y> = <x, A^T y> holds exactly
  /// when there is no volume mask and every pixel in the slice mask has a weight of at least 0.5.
  ///
  /// @param slices   y, n x 1 x h x w
  /// @param equalize divide each voxel by the weight it received (PSF reconstruction); otherwise the plain sum
  /// @return D x H x W; voxels that no pixel reaches are 0
  /// @throws std::invalid_argument if shape, type or device does not fit
  torch::Tensor adjoint(const torch::Tensor& slices, bool equalize) const;

  /// A^T W A x, in one pass over the pixels.
  /// @param volume  x, D x H x W
  /// @param weights w, n; an undefined tensor means 1
  /// @throws std::invalid_argument if shape, type or device does not fit
  torch::Tensor normal(const torch::Tensor& volume, const torch::Tensor& weights = {}) const;

  /// Sums for equalized_volume(), to be added to or taken from: D x H x W x 2, float64, zero, detached. In the last
  /// dimension the sum of PSF weight x pixel, and the sum of PSF weights.
  torch::Tensor empty_sums() const;

  /// sums += factor x what these slices contribute. Adding slices and later taking the same away (factor -1) leaves
  /// float64 rounding, about 1e-16 of the sums.
  /// @param sums from empty_sums() of an operator with the same volume shape, formulation and PSFs
  void add_to_sums(const torch::Tensor& slices, double factor, torch::Tensor* sums) const;

  /// The volume that sums stand for: equal to adjoint(slices, true), up to rounding, if the sums hold those slices.
  /// @return D x H x W
  torch::Tensor equalized_volume(const torch::Tensor& sums) const;

  std::int64_t slice_count() const;
  std::int64_t height() const;
  std::int64_t width() const;
  std::array<std::int64_t, 3> volume_shape() const;
  AcquisitionFormulation formulation() const;
  /// Type and device of all volumes and slices.
  torch::TensorOptions options() const;
  /// Whether the poses are part of a graph.
  bool requires_grad() const;

  /// For this library's own sources and tests.
  const AcquisitionPlan& plan() const { return *plan_; }

 private:
  std::shared_ptr<const AcquisitionPlan> plan_;
};

/// SliceAcquisition::forward(), exact, for a single call.
torch::Tensor acquire_slices(const torch::Tensor& volume, const AcquisitionGeometry& geometry, int height, int width,
                             const AcquisitionMasks& masks = {}, torch::Tensor* weight = nullptr);

/// SliceAcquisition::adjoint(), exact, for a single call.
torch::Tensor scatter_slices(const torch::Tensor& slices, const AcquisitionGeometry& geometry,
                             const std::array<std::int64_t, 3>& volume_shape, bool equalize,
                             const AcquisitionMasks& masks = {});

}  // namespace svort
