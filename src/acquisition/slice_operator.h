#pragma once

#include <torch/types.h>

#include <cstdint>
#include <vector>

#include "pixel_math.h"
#include "psf_split.h"
#include "tap_sampler.h"

namespace svort {

/// The linear maps that A is made of, for tensors of one type on one device. With G the taps that remain after the
/// blur B (exact formulation: all taps, no blur), M the volume mask and W the PSF weights inside the volume,
/// A = W^-1 G B M. All results are detached.
class SliceOperator {
 public:
  virtual ~SliceOperator() = default;
  /// G x. @param volume D x H x W, contiguous @return n x 1 x h x w
  virtual torch::Tensor gather(const torch::Tensor& volume) const = 0;
  /// G^T y. @param slices n x 1 x h x w, contiguous @return D x H x W
  virtual torch::Tensor scatter(const torch::Tensor& slices) const = 0;
  /// scatter() in float64, for sums that are taken away again: adding the same slice gives the same terms in any
  /// company. @param largest no pixel's magnitude is above it
  virtual torch::Tensor scatter_terms(const torch::Tensor& slices, const torch::Tensor& largest) const = 0;
  /// B x.
  virtual torch::Tensor blur(const torch::Tensor& volume) const = 0;
  /// d (sum of coefficients x G volume) / d transforms, n x 3 x 4.
  virtual torch::Tensor pose_gradient(const torch::Tensor& volume, const torch::Tensor& coefficients) const = 0;
};

/// Slices, taps and pixels of an operator as flat arrays: what an OperatorView points into.
struct PixelTable {
  struct Range {
    std::int32_t begin = 0, end = 0;
  };
  std::vector<std::int32_t> tap_begin, tap_end;  // n
  std::vector<float> taps;                       // 4 per tap
  std::vector<std::int32_t> slice, pixel_begin;  // per pixel; n + 1
  std::vector<std::uint16_t> column, row;        // per pixel
  /// Pixels of each tile; tiles of colour c are [colour[c], colour[c + 1]), see TileGrid.
  std::vector<std::vector<Range>> tiles;
  std::array<std::size_t, 5> colour{};
  std::int32_t slice_count = 0, slice_width = 0, slice_height = 0;
  VolumeShape shape;
  double resolution_ratio = 1.;
  std::vector<float> blur;  ///< half kernel; {1} if there is none

  /// A view of these arrays; `transforms` is n x 12. Both must outlive it.
  template <class Real>
  OperatorView<Real> view(const Real* transforms) const {
    OperatorView<Real> view;
    view.transforms = transforms;
    view.tap_begin = tap_begin.data();
    view.tap_end = tap_end.data();
    view.taps = taps.data();
    view.slice = slice.data();
    view.column = column.data();
    view.row = row.data();
    view.pixel_begin = pixel_begin.data();
    view.slice_count = slice_count;
    view.pixel_count = static_cast<std::int32_t>(slice.size());
    view.slice_width = slice_width;
    view.slice_height = slice_height;
    view.width = shape.width;
    view.height = shape.height;
    view.depth = shape.depth;
    view.resolution_ratio = resolution_ratio;
    return view;
  }
};

}  // namespace svort
