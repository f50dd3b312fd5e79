#pragma once

#include <torch/types.h>

#include <memory>

#include "slice_operator.h"

namespace svort {

/// The operator on the CPU without vector instructions, pixel by pixel, for float32 and float64. The same functions of
/// pixel_math.h run in the CUDA kernels. Results are the same bytes for any number of threads.
template <class Real>
class PlainOperator : public SliceOperator {
 public:
  /// @param transforms n x 3 x 4; copied
  PlainOperator(std::shared_ptr<const PixelTable> table, const torch::Tensor& transforms);

  torch::Tensor gather(const torch::Tensor& volume) const override;
  torch::Tensor scatter(const torch::Tensor& slices) const override;
  torch::Tensor scatter_terms(const torch::Tensor& slices, const torch::Tensor& largest) const override;
  torch::Tensor blur(const torch::Tensor& volume) const override;
  torch::Tensor pose_gradient(const torch::Tensor& volume, const torch::Tensor& coefficients) const override;

  /// PSF weight of each pixel inside the volume and, if it is defined, the mask (D x H x W), n x 1 x h x w; 0 for
  /// pixels that are left out.
  torch::Tensor weight(const torch::Tensor& volume_mask) const;

 private:
  template <class Sum>
  void scatter_into(const torch::Tensor& slices, Sum* sums) const;
  torch::Tensor new_slices() const;
  torch::Tensor new_volume(torch::ScalarType type) const;

  std::shared_ptr<const PixelTable> table_;
  torch::Tensor transforms_;
  OperatorView<Real> view_;
};

extern template class PlainOperator<float>;
extern template class PlainOperator<double>;

}  // namespace svort
