#include "plain_operator.h"

#include <torch/types.h>

#include <array>
#include <utility>

#include "parallel.h"

namespace svort {

template <class Real>
PlainOperator<Real>::PlainOperator(std::shared_ptr<const PixelTable> table, const torch::Tensor& transforms)
    : table_(std::move(table)),
      transforms_(transforms.detach().to(torch::CppTypeToScalarType<Real>()).clone(torch::MemoryFormat::Contiguous)),
      view_(table_->view(transforms_.data_ptr<Real>())) {}

template <class Real>
torch::Tensor PlainOperator<Real>::new_slices() const {
  return torch::zeros({table_->slice_count, 1, table_->slice_height, table_->slice_width}, transforms_.scalar_type());
}

template <class Real>
torch::Tensor PlainOperator<Real>::new_volume(torch::ScalarType type) const {
  return torch::zeros({table_->shape.depth, table_->shape.height, table_->shape.width}, type);
}

template <class Real>
torch::Tensor PlainOperator<Real>::gather(const torch::Tensor& volume) const {
  torch::Tensor slices = new_slices();
  const Real* voxels = volume.data_ptr<Real>();
  Real* values = slices.data_ptr<Real>();
  parallel_chunks(view_.pixel_count, [&](std::int64_t begin, std::int64_t end) {
    for (auto i = static_cast<std::int32_t>(begin); i < end; ++i) {
      values[view_.offset(i)] = gather_pixel(view_, i, voxels);
    }
  });
  return slices;
}

template <class Real>
template <class Sum>
void PlainOperator<Real>::scatter_into(const torch::Tensor& slices, Sum* sums) const {
  const Real* values = slices.data_ptr<Real>();
  // Tiles of one colour have no voxel in common.
  for (std::size_t c = 0; c < 4; ++c) {
    parallel_tasks(static_cast<std::int64_t>(table_->colour[c + 1] - table_->colour[c]), [&](std::int64_t tile) {
      for (const PixelTable::Range& range : table_->tiles[table_->colour[c] + static_cast<std::size_t>(tile)]) {
        for (std::int32_t i = range.begin; i < range.end; ++i) {
          const Real value = values[view_.offset(i)];
          if (value == Real{0}) continue;
          scatter_pixel(view_, i, value, [sums](std::int64_t voxel, Real term) { sums[voxel] += Sum{term}; });
        }
      }
    });
  }
}

template <class Real>
torch::Tensor PlainOperator<Real>::scatter(const torch::Tensor& slices) const {
  torch::Tensor volume = new_volume(transforms_.scalar_type());
  scatter_into(slices, volume.data_ptr<Real>());
  return volume;
}

template <class Real>
torch::Tensor PlainOperator<Real>::scatter_terms(const torch::Tensor& slices, const torch::Tensor&) const {
  torch::Tensor volume = new_volume(torch::kFloat64);
  scatter_into(slices, volume.data_ptr<double>());
  return volume;
}

template <class Real>
torch::Tensor PlainOperator<Real>::blur(const torch::Tensor& volume) const {
  torch::Tensor from = volume;
  const auto radius = static_cast<std::int32_t>(table_->blur.size()) - 1;
  if (radius == 0) return from;
  const VolumeShape& shape = table_->shape;
  const std::array<std::int32_t, 3> count = {shape.width, shape.height, shape.depth};
  const std::array<std::int64_t, 3> stride = {1, shape.stride_y(), shape.stride_z()};
  for (std::size_t axis = 0; axis < 3; ++axis) {
    torch::Tensor to = torch::empty_like(from);
    const Real* in = from.data_ptr<Real>();
    Real* out = to.data_ptr<Real>();
    parallel_chunks(shape.voxel_count(), [&](std::int64_t begin, std::int64_t end) {
      for (std::int64_t i = begin; i < end; ++i) {
        const auto index = static_cast<std::int32_t>(i / stride[axis] % count[axis]);
        out[i] = blur_voxel(in + i, table_->blur.data(), radius, index, count[axis], stride[axis]);
      }
    });
    from = to;
  }
  return from;
}

template <class Real>
torch::Tensor PlainOperator<Real>::pose_gradient(const torch::Tensor& volume, const torch::Tensor& coefficients) const {
  torch::Tensor gradient = torch::zeros({table_->slice_count, 3, 4}, torch::kFloat64);
  const Real* voxels = volume.data_ptr<Real>();
  const Real* values = coefficients.data_ptr<Real>();
  double* out = gradient.data_ptr<double>();
  parallel_tasks(table_->slice_count, [&](std::int64_t slice) {
    for (std::int32_t i = view_.pixel_begin[slice]; i < view_.pixel_begin[slice + 1]; ++i) {
      const Real value = values[view_.offset(i)];
      if (value != Real{0}) add_pose_gradient(view_, i, voxels, value, out + 12 * slice);
    }
  });
  return gradient.to(transforms_.scalar_type());
}

template <class Real>
torch::Tensor PlainOperator<Real>::weight(const torch::Tensor& volume_mask) const {
  if (volume_mask.defined()) return gather(blur(volume_mask.to(transforms_.scalar_type())));
  if (table_->blur.size() > 1) return gather(blur(torch::ones_like(new_volume(transforms_.scalar_type()))));
  torch::Tensor weights = new_slices();
  Real* values = weights.data_ptr<Real>();
  parallel_chunks(view_.pixel_count, [&](std::int64_t begin, std::int64_t end) {
    for (auto i = static_cast<std::int32_t>(begin); i < end; ++i) values[view_.offset(i)] = weigh_pixel(view_, i);
  });
  return weights;
}

template class PlainOperator<float>;
template class PlainOperator<double>;

}  // namespace svort
