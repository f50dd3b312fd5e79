#pragma once

#include <torch/types.h>

#include <memory>

#include "acquisition_plan.h"

namespace svort {

// SliceAcquisition's calls as compositions of AcquisitionPlan::general(), for every type and device, and part of the
// graph of their arguments and of the plan's transforms. Arguments have been checked.

torch::Tensor general_forward(const std::shared_ptr<const AcquisitionPlan>& plan, const torch::Tensor& volume);
torch::Tensor general_adjoint(const std::shared_ptr<const AcquisitionPlan>& plan, const torch::Tensor& slices,
                              bool equalize);

/// The inverse of each pixel's PSF weight inside the volume where the pixel is scattered, else 0; n x 1 x h x w.
torch::Tensor scatter_scale(const std::shared_ptr<const AcquisitionPlan>& plan);

/// Divides sums by weights, both already blurred, where the mask and the least weight allow it.
torch::Tensor divide_by_weights(const AcquisitionPlan& plan, const torch::Tensor& sums, const torch::Tensor& weights);

}  // namespace svort
