#pragma once

#include <cstdint>

#include "../pixel_math.h"

namespace svort {

// The kernels of SliceAcquisition on a CUDA device, behind plain functions: no LibTorch and no CUDA header is needed to
// call them. All pointers are to device memory; `stream` is a cudaStream_t. The calls only queue work. They return
// null, or what CUDA says is wrong. Results are the same bytes in every run: sums from many threads are integers.

/// slices[pixel] = PSF-weighted sum of the volume. @param slices n x h x w, zero
const char* device_gather(const OperatorView<float>& view, const float* volume, float* slices, void* stream);

/// Adds PSF value x pixel to the sums, in units of FixedPoint(*largest).
/// @param sums D x H x W, zero at first
const char* device_scatter(const OperatorView<float>& view, const float* slices, const float* largest,
                           std::int64_t* sums, void* stream);

/// What device_scatter() summed up. NaN everywhere if *largest is not finite: so was a pixel.
const char* device_sums(const std::int64_t* sums, const float* largest, std::int64_t count, float* out, void* stream);
const char* device_sums(const std::int64_t* sums, const float* largest, std::int64_t count, double* out, void* stream);

/// One axis of the blur, out of place. @param half radius + 1 values
const char* device_blur(const OperatorView<float>& view, const float* half, std::int32_t radius, int axis,
                        const float* in, float* out, void* stream);

/// gradient[slice] = d (sum of coefficients x gather) / d transform.
/// @param coefficients n x h x w @param gradient n x 12
const char* device_pose_gradient(const OperatorView<float>& view, const float* volume, const float* coefficients,
                                 double* gradient, void* stream);

}  // namespace svort
