#include "device_operator.h"

#include <c10/cuda/CUDAGuard.h>
#include <c10/cuda/CUDAStream.h>
#include <torch/torch.h>

#include <algorithm>
#include <numeric>
#include <stdexcept>
#include <string>
#include <vector>

#include "device_kernels.h"

namespace svort {
namespace {

void require(const char* error) {
  if (error != nullptr) throw std::runtime_error(std::string("SliceAcquisition on CUDA: ") + error);
}

// A copy of an array on the device. LibTorch has no unsigned 16-bit integers: bits are what counts.
template <class Element>
torch::Tensor upload(const std::vector<Element>& values, torch::ScalarType type, const torch::Device& device) {
  torch::Tensor on_cpu = torch::empty({static_cast<std::int64_t>(values.size())}, type);
  std::copy(values.begin(), values.end(), static_cast<Element*>(on_cpu.data_ptr()));
  return on_cpu.to(device);
}

class DeviceOperator : public SliceOperator {
 public:
  DeviceOperator(const PixelTable& table, const torch::Tensor& transforms)
      : device_(transforms.device()),
        slices_shape_({table.slice_count, 1, table.slice_height, table.slice_width}),
        volume_shape_({table.shape.depth, table.shape.height, table.shape.width}),
        radius_(static_cast<std::int32_t>(table.blur.size()) - 1),
        transforms_(transforms.detach().clone(torch::MemoryFormat::Contiguous)),
        tap_begin_(upload(table.tap_begin, torch::kInt32, device_)),
        tap_end_(upload(table.tap_end, torch::kInt32, device_)),
        taps_(upload(table.taps, torch::kFloat32, device_)),
        slice_(upload(table.slice, torch::kInt32, device_)),
        pixel_begin_(upload(table.pixel_begin, torch::kInt32, device_)),
        blur_(upload(table.blur, torch::kFloat32, device_)) {
    // Row by row, so that threads side by side read voxels side by side.
    std::vector<std::size_t> order(table.slice.size());
    std::iota(order.begin(), order.end(), std::size_t{0});
    std::sort(order.begin(), order.end(), [&table](std::size_t a, std::size_t b) {
      if (table.slice[a] != table.slice[b]) return table.slice[a] < table.slice[b];
      return table.row[a] != table.row[b] ? table.row[a] < table.row[b] : table.column[a] < table.column[b];
    });
    std::vector<std::uint16_t> column(order.size()), row(order.size());
    for (std::size_t i = 0; i < order.size(); ++i) {
      column[i] = table.column[order[i]];
      row[i] = table.row[order[i]];
    }
    column_ = upload(column, torch::kInt16, device_);
    row_ = upload(row, torch::kInt16, device_);
    view_ = table.view(transforms_.data_ptr<float>());
    view_.tap_begin = tap_begin_.data_ptr<std::int32_t>();
    view_.tap_end = tap_end_.data_ptr<std::int32_t>();
    view_.taps = taps_.data_ptr<float>();
    view_.slice = slice_.data_ptr<std::int32_t>();
    view_.column = static_cast<const std::uint16_t*>(column_.data_ptr());
    view_.row = static_cast<const std::uint16_t*>(row_.data_ptr());
    view_.pixel_begin = pixel_begin_.data_ptr<std::int32_t>();
  }

  torch::Tensor gather(const torch::Tensor& volume) const override {
    const c10::cuda::CUDAGuard guard(device_);
    torch::Tensor slices = torch::zeros(slices_shape_, volume.options());
    require(device_gather(view_, volume.data_ptr<float>(), slices.data_ptr<float>(), stream()));
    return slices;
  }
  torch::Tensor scatter(const torch::Tensor& slices) const override {
    const torch::Tensor largest = slices.numel() > 0 ? slices.abs().max() : torch::zeros({}, slices.options());
    return scattered<float>(slices, largest, torch::kFloat32);
  }
  torch::Tensor scatter_terms(const torch::Tensor& slices, const torch::Tensor& largest) const override {
    return scattered<double>(slices, largest, torch::kFloat64);
  }
  torch::Tensor blur(const torch::Tensor& volume) const override {
    if (radius_ == 0) return volume;
    const c10::cuda::CUDAGuard guard(device_);
    torch::Tensor from = volume;
    for (int axis = 0; axis < 3; ++axis) {
      torch::Tensor to = torch::empty_like(from);
      require(device_blur(view_, blur_.data_ptr<float>(), radius_, axis, from.data_ptr<float>(), to.data_ptr<float>(),
                          stream()));
      from = to;
    }
    return from;
  }
  torch::Tensor pose_gradient(const torch::Tensor& volume, const torch::Tensor& coefficients) const override {
    const c10::cuda::CUDAGuard guard(device_);
    torch::Tensor gradient = torch::zeros({view_.slice_count, 3, 4}, volume.options().dtype(torch::kFloat64));
    require(device_pose_gradient(view_, volume.data_ptr<float>(), coefficients.data_ptr<float>(),
                                 gradient.data_ptr<double>(), stream()));
    return gradient.to(torch::kFloat32);
  }

 private:
  void* stream() const { return c10::cuda::getCurrentCUDAStream(device_.index()).stream(); }

  template <class Real>
  torch::Tensor scattered(const torch::Tensor& slices, const torch::Tensor& largest, torch::ScalarType type) const {
    const c10::cuda::CUDAGuard guard(device_);
    torch::Tensor sums = torch::zeros(volume_shape_, slices.options().dtype(torch::kInt64));
    torch::Tensor volume = torch::empty(volume_shape_, slices.options().dtype(type));
    require(device_scatter(view_, slices.data_ptr<float>(), largest.data_ptr<float>(), sums.data_ptr<std::int64_t>(),
                           stream()));
    require(device_sums(sums.data_ptr<std::int64_t>(), largest.data_ptr<float>(), view_.voxel_count(),
                        volume.data_ptr<Real>(), stream()));
    return volume;
  }

  torch::Device device_;
  std::vector<std::int64_t> slices_shape_, volume_shape_;
  std::int32_t radius_;
  torch::Tensor transforms_, tap_begin_, tap_end_, taps_, slice_, pixel_begin_, blur_, column_, row_;
  OperatorView<float> view_;
};

}  // namespace

std::unique_ptr<SliceOperator> device_operator(const PixelTable& table, const torch::Tensor& transforms) {
  return std::make_unique<DeviceOperator>(table, transforms);
}

}  // namespace svort
