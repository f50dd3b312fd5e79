#pragma once

#include <torch/types.h>

#include <functional>

#include "svort_ros/reconstruction/volume_estimation.h"

namespace svort {

/// Applies a symmetric positive semi-definite operator to a tensor.
using LinearOperator = std::function<torch::Tensor(const torch::Tensor&)>;

/// Conjugate gradients for `apply`(x) = b from `start`; float32 vectors, float64 scalars.
///
/// Stops after options.iterations, at options.tolerance, or when no descent is left (residual or curvature 0).
/// The result does not depend on the number of threads.
torch::Tensor conjugate_gradient(const LinearOperator& apply, const torch::Tensor& b, const torch::Tensor& start,
                                 const ConjugateGradientOptions& options, ConjugateGradientReport* report);

/// The same as LibTorch operations, one after the other: part of the graph of `apply`, b and start, for every type and
/// device. Keeps all steps in memory if gradients are recorded.
torch::Tensor unrolled_conjugate_gradient(const LinearOperator& apply, const torch::Tensor& b,
                                          const torch::Tensor& start, const ConjugateGradientOptions& options,
                                          ConjugateGradientReport* report);

}  // namespace svort
