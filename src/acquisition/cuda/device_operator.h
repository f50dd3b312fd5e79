#pragma once

#include <torch/types.h>

#include <memory>

#include "../slice_operator.h"

namespace svort {

/// The operator on the CUDA device of `transforms` (n x 3 x 4, float32), with a copy of the table there.
std::unique_ptr<SliceOperator> device_operator(const PixelTable& table, const torch::Tensor& transforms);

}  // namespace svort
