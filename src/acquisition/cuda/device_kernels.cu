#include "device_kernels.h"

#include <cuda_runtime_api.h>

namespace svort {
namespace {

constexpr int kThreads = 128;
constexpr int kGradientThreads = 128;  // one block per slice; a power of two

const char* status() {
  const cudaError_t error = cudaGetLastError();
  return error == cudaSuccess ? nullptr : cudaGetErrorString(error);
}

// Enough blocks for `count` threads, within what a grid may hold; kernels step over the rest.
unsigned blocks_for(std::int64_t count) {
  constexpr std::int64_t kMost = 1 << 20;
  const std::int64_t blocks = (count + kThreads - 1) / kThreads;
  return static_cast<unsigned>(blocks < kMost ? blocks : kMost);
}

__device__ std::int64_t first_item() { return std::int64_t{blockIdx.x} * blockDim.x + threadIdx.x; }
__device__ std::int64_t item_step() { return std::int64_t{gridDim.x} * blockDim.x; }

__global__ void gather_kernel(OperatorView<float> view, const float* volume, float* slices) {
  for (std::int64_t i = first_item(); i < view.pixel_count; i += item_step()) {
    const auto pixel = static_cast<std::int32_t>(i);
    slices[view.offset(pixel)] = gather_pixel(view, pixel, volume);
  }
}

__global__ void scatter_kernel(OperatorView<float> view, const float* slices, const float* largest,
                               std::int64_t* sums) {
  if (!isfinite(*largest)) return;
  const FixedPoint fixed(*largest);
  for (std::int64_t i = first_item(); i < view.pixel_count; i += item_step()) {
    const auto pixel = static_cast<std::int32_t>(i);
    const float value = slices[view.offset(pixel)];
    if (value == 0.F) continue;
    scatter_pixel(view, pixel, value, [=](std::int64_t voxel, float term) {
      // Two's complement: the sum of unsigned numbers is that of the signed ones.
      atomicAdd(reinterpret_cast<unsigned long long*>(sums + voxel), static_cast<unsigned long long>(fixed.from(term)));
    });
  }
}

template <class Real>
__global__ void sums_kernel(const std::int64_t* sums, const float* largest, std::int64_t count, Real* out) {
  const bool finite = isfinite(*largest);
  const FixedPoint fixed(finite ? *largest : 0.F);
  for (std::int64_t i = first_item(); i < count; i += item_step()) {
    out[i] = finite ? static_cast<Real>(fixed.to_double(sums[i])) : static_cast<Real>(NAN);
  }
}

__global__ void blur_kernel(OperatorView<float> view, const float* half, std::int32_t radius, std::int64_t stride,
                            std::int32_t length, const float* in, float* out) {
  const std::int64_t count = view.voxel_count();
  for (std::int64_t i = first_item(); i < count; i += item_step()) {
    out[i] = blur_voxel(in + i, half, radius, static_cast<std::int32_t>(i / stride % length), length, stride);
  }
}

__global__ void pose_gradient_kernel(OperatorView<float> view, const float* volume, const float* coefficients,
                                     double* gradient) {
  __shared__ double parts[kGradientThreads];
  const auto slice = static_cast<std::int32_t>(blockIdx.x);
  double own[12] = {};
  for (std::int32_t i = view.pixel_begin[slice] + static_cast<std::int32_t>(threadIdx.x);
       i < view.pixel_begin[slice + 1]; i += kGradientThreads) {
    const float coefficient = coefficients[view.offset(i)];
    if (coefficient != 0.F) add_pose_gradient(view, i, volume, coefficient, own);
  }
  // One order of additions, whatever runs first.
  for (int element = 0; element < 12; ++element) {
    parts[threadIdx.x] = own[element];
    __syncthreads();
    for (unsigned half = kGradientThreads / 2; half > 0; half /= 2) {
      if (threadIdx.x < half) parts[threadIdx.x] += parts[threadIdx.x + half];
      __syncthreads();
    }
    if (threadIdx.x == 0) gradient[12 * std::int64_t{slice} + element] = parts[0];
    __syncthreads();
  }
}

template <class Real>
const char* convert_sums(const std::int64_t* sums, const float* largest, std::int64_t count, Real* out, void* stream) {
  if (count == 0) return nullptr;
  sums_kernel<<<blocks_for(count), kThreads, 0, static_cast<cudaStream_t>(stream)>>>(sums, largest, count, out);
  return status();
}

}  // namespace

const char* device_gather(const OperatorView<float>& view, const float* volume, float* slices, void* stream) {
  if (view.pixel_count == 0) return nullptr;
  gather_kernel<<<blocks_for(view.pixel_count), kThreads, 0, static_cast<cudaStream_t>(stream)>>>(view, volume, slices);
  return status();
}

const char* device_scatter(const OperatorView<float>& view, const float* slices, const float* largest,
                           std::int64_t* sums, void* stream) {
  if (view.pixel_count == 0) return nullptr;
  scatter_kernel<<<blocks_for(view.pixel_count), kThreads, 0, static_cast<cudaStream_t>(stream)>>>(view, slices,
                                                                                                   largest, sums);
  return status();
}

const char* device_sums(const std::int64_t* sums, const float* largest, std::int64_t count, float* out, void* stream) {
  return convert_sums(sums, largest, count, out, stream);
}

const char* device_sums(const std::int64_t* sums, const float* largest, std::int64_t count, double* out, void* stream) {
  return convert_sums(sums, largest, count, out, stream);
}

const char* device_blur(const OperatorView<float>& view, const float* half, std::int32_t radius, int axis,
                        const float* in, float* out, void* stream) {
  const std::int64_t strides[3] = {1, view.width, std::int64_t{view.width} * view.height};
  const std::int32_t lengths[3] = {view.width, view.height, view.depth};
  blur_kernel<<<blocks_for(view.voxel_count()), kThreads, 0, static_cast<cudaStream_t>(stream)>>>(
      view, half, radius, strides[axis], lengths[axis], in, out);
  return status();
}

const char* device_pose_gradient(const OperatorView<float>& view, const float* volume, const float* coefficients,
                                 double* gradient, void* stream) {
  if (view.slice_count == 0) return nullptr;
  pose_gradient_kernel<<<static_cast<unsigned>(view.slice_count), kGradientThreads, 0,
                         static_cast<cudaStream_t>(stream)>>>(view, volume, coefficients, gradient);
  return status();
}

}  // namespace svort
