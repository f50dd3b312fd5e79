#pragma once

#include <torch/types.h>

namespace svort {

/// Size of a slice for its anchor points: the paper's representation of a plane by three points.
struct AnchorFrame {
  int width = 128;          ///< pixels along x
  int height = 128;         ///< pixels along y
  double resolution = 1.0;  ///< pixel size, mm
};

/// Anchor points (n x 9: p1, p2, p3, each x, y, z, mm) of transforms (n x 3 x 4, trans_first, mm).
///
/// p1, p2, p3 are the images of (-(w-1)/2 r, -(h-1)/2 r, 0), (0, 0, 0) and (+(w-1)/2 r, -(h-1)/2 r, 0).
torch::Tensor anchor_points_from_matrix(const torch::Tensor& matrix, const AnchorFrame& frame);

/// Transforms (n x 3 x 4, trans_first, mm) of anchor points (n x 9, mm), which need not be rigid:
/// e_x ~ p3 - p1, e_z ~ (p3 - p1) x (p2 - p1), e_y ~ e_z x e_x, R = [e_x e_y e_z], t = R^T p2.
torch::Tensor matrix_from_anchor_points(const torch::Tensor& points);

}  // namespace svort
