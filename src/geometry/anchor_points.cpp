#include "svort_ros/geometry/anchor_points.h"

#include <torch/types.h>

#include <stdexcept>

#include "svort_ros/geometry/rigid_transform.h"
#include "tensor_checks.h"

namespace svort {

torch::Tensor anchor_points_from_matrix(const torch::Tensor& matrix, const AnchorFrame& frame) {
  check_batch(matrix, {3, 4}, "anchor_points_from_matrix", "matrix");
  if (frame.width < 2 || frame.height < 2 || !(frame.resolution > 0.)) {
    throw std::invalid_argument("anchor_points_from_matrix: a slice of " + std::to_string(frame.width) + " x " +
                                std::to_string(frame.height) + " pixels of " + std::to_string(frame.resolution) +
                                " mm spans no plane");
  }
  const double x = (frame.width - 1) / 2. * frame.resolution;
  const double y = (frame.height - 1) / 2. * frame.resolution;
  const torch::Tensor points =
      torch::tensor({-x, -y, 0., 0., 0., 0., x, -y, 0.}, torch::kFloat64).view({1, 3, 3}).to(matrix.options());
  return transform_points(matrix, points).reshape({-1, 9});
}

torch::Tensor matrix_from_anchor_points(const torch::Tensor& points) {
  check_batch(points, {9}, "matrix_from_anchor_points", "points");
  const auto corners = points.reshape({-1, 3, 3}).unbind(1);
  const torch::Tensor& centre = corners[1];
  const torch::Tensor x = corners[2] - corners[0];
  const torch::Tensor z = torch::cross(x, centre - corners[0], 1);
  const torch::Tensor y = torch::cross(z, x, 1);
  const torch::Tensor axes = torch::stack({x, y, z}, -1);
  const torch::Tensor rotation = axes / axes.norm(2, {-2}, /*keepdim=*/true);
  return torch::cat({rotation, torch::matmul(rotation.transpose(-2, -1), centre.unsqueeze(-1))}, -1);
}

}  // namespace svort
