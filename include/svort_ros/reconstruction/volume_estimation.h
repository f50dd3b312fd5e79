#pragma once

#include <torch/types.h>

#include <array>
#include <cstdint>
#include <vector>

#include "svort_ros/acquisition/slice_acquisition.h"

namespace svort {

/// PSF reconstruction (paper, sec. 2.3): slices scattered with the PSF and divided by the weight that each voxel got.
/// Voxels that no slice reaches are 0. @return D x H x W
/// @throws std::invalid_argument if the slices do not fit the operator
torch::Tensor reconstruct_psf(const torch::Tensor& slices, const SliceAcquisition& acquisition);

/// The same with slices that count by their weights w: sum of w x PSF x pixel divided by the sum of w x PSF.
/// @param weights n, float32; undefined or all 1: as without
/// @throws std::invalid_argument if slices or weights do not fit, or a weight is negative or not finite
torch::Tensor reconstruct_psf(const torch::Tensor& slices, const SliceAcquisition& acquisition,
                              const torch::Tensor& weights);

/// When conjugate gradients stop.
struct ConjugateGradientOptions {
  int iterations = 2;     ///< at most so many; 0 returns the start
  double tolerance = 0.;  ///< stop when |r| <= tolerance * |b|; 0 never stops early
};

/// What a solve did.
struct ConjugateGradientReport {
  int iterations = 0;
  /// |r| / |b| before the first and after every iteration, b = A^T W y (|r| itself if b is 0). It is the residual of
  /// the linear system, before the clamp.
  std::vector<double> relative_residual;
};

/// Conjugate gradients on the paper's weighted inverse problem, argmin_x sum_i w_i |A_i x - y_i|^2.
///
/// Solves A^T W A x = A^T W y from `start`; the result is clamped at 0, as the public implementation does. The result
/// does not depend on the number of threads.
///
/// Differentiable with respect to slices, weights, start and the operator's poses where these require gradients: the
/// steps are unrolled, so the gradient is that of the result after so many steps (paper, sec. 2.3: training needs it in
/// w), not of the solution. The number of steps is a constant in it, and the clamp passes nothing where it cut.
///
/// All tensors have the operator's type and device.
/// @param slices  y, n x 1 x h x w
/// @param weights w, n; an undefined tensor means 1
/// @param start   D x H x W, usually reconstruct_psf()
/// @throws std::invalid_argument naming the argument if a shape, type or device does not fit, an option is out of
///         range, or a weight is negative or not finite
torch::Tensor solve_weighted_inverse(const torch::Tensor& slices, const SliceAcquisition& acquisition,
                                     const torch::Tensor& weights, const torch::Tensor& start,
                                     const ConjugateGradientOptions& options,
                                     ConjugateGradientReport* report = nullptr);

/// Gradient descent with an edge-preserving prior, for a last refinement.
struct EdgePreservingOptions {
  int iterations = 2;      ///< steps
  double step = 0.5;       ///< alpha: length of a step; lower it if slices have weights well above 1
  double strength = 0.02;  ///< beta: weight of the prior; raise it for noisy slices
  double edge = 0.1;       ///< delta: intensity difference that counts as an edge, in units of the volume
};

/// Steps x <- x - alpha (A^T W (A x - y) + beta delta^2 dR(x)), clamped at 0 in the end, with
/// dR(x)_v = sum over the 26 neighbours u of d / sqrt(1 + (x_v - x_u) d), d = (x_v - x_u) / (|v - u|^2 delta^2).
///
/// The rim of the volume, one voxel wide, has no prior. Matches the public implementation's gradient-descent mode.
/// Arguments and errors as in solve_weighted_inverse(), but for float32 on the CPU only; the result is detached.
torch::Tensor refine_edge_preserving(const torch::Tensor& slices, const SliceAcquisition& acquisition,
                                     const torch::Tensor& weights, const torch::Tensor& start,
                                     const EdgePreservingOptions& options);

}  // namespace svort
