#include "svort_ros/geometry/rigid_transform.h"

#include <torch/types.h>

#include <Eigen/LU>
#include <Eigen/SVD>
#include <stdexcept>

#include "tensor_checks.h"

namespace svort {
namespace {

// Switch of the public implementation, on |r|^2 for axis-angle and on the squared vector part for quaternions. Below it
// a rotation is 1 + [r]x, which is within 5e-7 of the exact matrix.
constexpr double kSmallSquaredNorm = 1e-6;

torch::Tensor rotation_of(const torch::Tensor& matrix) { return matrix.slice(-1, 0, 3); }

torch::Tensor translation_of(const torch::Tensor& matrix) { return matrix.slice(-1, 3, 4); }

torch::Tensor join(const torch::Tensor& rotation, const torch::Tensor& translation) {
  return torch::cat({rotation, translation}, -1);
}

// Nine tensors of length n, row by row, to n x 3 x 3.
torch::Tensor stack_matrix(const std::vector<torch::Tensor>& entries) {
  return torch::stack(entries, -1).view({-1, 3, 3});
}

}  // namespace

torch::Tensor axisangle_to_matrix(const torch::Tensor& axisangle) {
  check_batch(axisangle, {6}, "axisangle_to_matrix", "axisangle");
  const torch::Tensor rotation = axisangle.slice(1, 0, 3);
  const torch::Tensor squared_angle = rotation.square().sum(1, /*keepdim=*/true);
  const torch::Tensor is_small = squared_angle <= kSmallSquaredNorm;
  // The branch that is not taken must still have finite derivatives, hence the harmless angle of 1.
  const torch::Tensor angle = torch::where(is_small, torch::ones_like(squared_angle), squared_angle).sqrt();
  const auto axis = (rotation / angle).unbind(1);
  const torch::Tensor sine = angle.sin().squeeze(1);
  const torch::Tensor cosine = angle.cos().squeeze(1);
  const torch::Tensor versine = 1 - cosine;
  const torch::Tensor &x = axis[0], &y = axis[1], &z = axis[2];
  const torch::Tensor rodrigues = stack_matrix({
      cosine + x * x * versine, x * y * versine - z * sine, y * sine + x * z * versine,  //
      z * sine + x * y * versine, cosine + y * y * versine, y * z * versine - x * sine,  //
      x * z * versine - y * sine, x * sine + y * z * versine, cosine + z * z * versine,  //
  });
  const auto r = rotation.unbind(1);
  const torch::Tensor one = torch::ones_like(r[0]);
  const torch::Tensor first_order = stack_matrix({one, -r[2], r[1], r[2], one, -r[0], -r[1], r[0], one});
  return join(torch::where(is_small.unsqueeze(-1), first_order, rodrigues), axisangle.slice(1, 3, 6).unsqueeze(-1));
}

torch::Tensor matrix_to_axisangle(const torch::Tensor& matrix) {
  check_batch(matrix, {3, 4}, "matrix_to_axisangle", "matrix");
  const auto entry = [&matrix](std::int64_t row, std::int64_t column) {
    return matrix.select(1, row).select(1, column);
  };
  const torch::Tensor r00 = entry(0, 0), r01 = entry(0, 1), r02 = entry(0, 2);
  const torch::Tensor r10 = entry(1, 0), r11 = entry(1, 1), r12 = entry(1, 2);
  const torch::Tensor r20 = entry(2, 0), r21 = entry(2, 1), r22 = entry(2, 2);
  // A rotation gives its quaternion (w, x, y, z) in four ways, each 4 q_k q for one component q_k; the one whose q_k is
  // large is well conditioned. The thresholds are those of the public implementation.
  const torch::Tensor by_w = torch::stack({1 + r00 + r11 + r22, r21 - r12, r02 - r20, r10 - r01}, 1);
  const torch::Tensor by_x = torch::stack({r21 - r12, 1 + r00 - r11 - r22, r01 + r10, r02 + r20}, 1);
  const torch::Tensor by_y = torch::stack({r02 - r20, r01 + r10, 1 - r00 + r11 - r22, r12 + r21}, 1);
  const torch::Tensor by_z = torch::stack({r10 - r01, r02 + r20, r12 + r21, 1 - r00 - r11 + r22}, 1);
  const torch::Tensor z_down = (r22 < kSmallSquaredNorm).unsqueeze(1);
  const torch::Tensor x_over_y = (r00 > r11).unsqueeze(1);
  const torch::Tensor x_under_minus_y = (r00 < -r11).unsqueeze(1);
  torch::Tensor quaternion =
      torch::where(z_down, torch::where(x_over_y, by_x, by_y), torch::where(x_under_minus_y, by_z, by_w));
  const torch::Tensor pivot =
      torch::where(z_down.squeeze(1), torch::where(x_over_y.squeeze(1), by_x.select(1, 1), by_y.select(1, 2)),
                   torch::where(x_under_minus_y.squeeze(1), by_z.select(1, 3), by_w.select(1, 0)));
  quaternion = quaternion / (2 * pivot.sqrt()).unsqueeze(1);
  // q and -q are the same rotation; w >= 0 keeps the angle in [0, pi].
  quaternion = torch::where((quaternion.select(1, 0) < 0).unsqueeze(1), -quaternion, quaternion);
  const torch::Tensor w = quaternion.select(1, 0);
  const torch::Tensor vector_part = quaternion.slice(1, 1, 4);
  const torch::Tensor squared_sine = vector_part.square().sum(1);
  const torch::Tensor is_small = squared_sine <= kSmallSquaredNorm;
  const torch::Tensor sine = torch::where(is_small, torch::ones_like(squared_sine), squared_sine).sqrt();
  // w is 0 only for a half turn, where the other branch is taken.
  const torch::Tensor safe_w = torch::where(is_small, w, torch::ones_like(w));
  const torch::Tensor factor = torch::where(is_small, 2 / safe_w, 2 * torch::atan2(sine, w) / sine);
  return torch::cat({vector_part * factor.unsqueeze(1), translation_of(matrix).squeeze(-1)}, 1);
}

torch::Tensor trans_first_to_last(const torch::Tensor& matrix) {
  check_batch(matrix, {3, 4}, "trans_first_to_last", "matrix");
  const torch::Tensor rotation = rotation_of(matrix);
  return join(rotation, torch::matmul(rotation, translation_of(matrix)));
}

torch::Tensor trans_last_to_first(const torch::Tensor& matrix) {
  check_batch(matrix, {3, 4}, "trans_last_to_first", "matrix");
  const torch::Tensor rotation = rotation_of(matrix);
  return join(rotation, torch::matmul(rotation.transpose(-2, -1), translation_of(matrix)));
}

torch::Tensor inverse_transform(const torch::Tensor& matrix) {
  check_batch(matrix, {3, 4}, "inverse_transform", "matrix");
  const torch::Tensor rotation = rotation_of(matrix);
  // y = R (x + t)  <=>  x = R^T (y - R t)
  return join(rotation.transpose(-2, -1), -torch::matmul(rotation, translation_of(matrix)));
}

torch::Tensor compose_transforms(const torch::Tensor& a, const torch::Tensor& b) {
  check_batch(a, {3, 4}, "compose_transforms", "a");
  check_batch(b, {3, 4}, "compose_transforms", "b");
  const torch::Tensor rotation_b = rotation_of(b);
  // R_a (R_b (x + t_b) + t_a) = R_a R_b (x + t_b + R_b^T t_a)
  return join(torch::matmul(rotation_of(a), rotation_b),
              translation_of(b) + torch::matmul(rotation_b.transpose(-2, -1), translation_of(a)));
}

torch::Tensor change_resolution(const torch::Tensor& matrix, double resolution_from, double resolution_to) {
  check_batch(matrix, {3, 4}, "change_resolution", "matrix");
  if (!(resolution_from > 0.) || !(resolution_to > 0.)) {
    throw std::invalid_argument("change_resolution: resolutions must be positive, got " +
                                std::to_string(resolution_from) + " and " + std::to_string(resolution_to));
  }
  return join(rotation_of(matrix), translation_of(matrix) * (resolution_from / resolution_to));
}

torch::Tensor transform_points(const torch::Tensor& matrix, const torch::Tensor& points) {
  check_batch(matrix, {3, 4}, "transform_points", "matrix");
  const bool one_each = points.dim() == 2;
  if ((!one_each && points.dim() != 3) || points.size(-1) != 3) {
    throw std::invalid_argument("transform_points: points must be n x 3 or n x m x 3, got " + shape_text(points));
  }
  // Points are rows here: (R (x + t))^T = (x + t)^T R^T.
  const torch::Tensor rows = one_each ? points.unsqueeze(1) : points;
  const torch::Tensor moved =
      torch::matmul(rows + translation_of(matrix).transpose(-2, -1), rotation_of(matrix).transpose(-2, -1));
  return one_each ? moved.squeeze(1) : moved;
}

torch::Tensor tensor_from_pose(const Pose& pose) {
  const TransFirst matrix = trans_first_from_pose(pose);
  torch::Tensor tensor = torch::empty({1, 3, 4}, torch::kFloat32);
  auto values = tensor.accessor<float, 3>();
  for (int row = 0; row < 3; ++row) {
    for (int column = 0; column < 4; ++column) values[0][row][column] = static_cast<float>(matrix(row, column));
  }
  return tensor;
}

Pose pose_from_tensor(const torch::Tensor& matrix) {
  const bool single = matrix.dim() == 2;
  check_batch(single ? matrix.unsqueeze(0) : matrix, {3, 4}, "pose_from_tensor", "matrix");
  if (!single && matrix.size(0) != 1) {
    throw std::invalid_argument("pose_from_tensor: matrix must be 3 x 4 or 1 x 3 x 4, got " + shape_text(matrix));
  }
  const torch::Tensor host = matrix.detach().to(torch::kCPU, torch::kFloat64).reshape({3, 4}).contiguous();
  const auto values = host.accessor<double, 2>();
  TransFirst trans_first;
  for (int row = 0; row < 3; ++row) {
    for (int column = 0; column < 4; ++column) trans_first(row, column) = values[row][column];
  }
  if (!trans_first.allFinite())
    throw std::invalid_argument("pose_from_tensor: matrix holds values that are not finite");
  const Eigen::Matrix3d linear = trans_first.leftCols<3>();
  if (!(linear.determinant() > 0.)) {
    throw std::invalid_argument("pose_from_tensor: the linear part is no rotation, its determinant is " +
                                std::to_string(linear.determinant()));
  }
  // The nearest rotation in the Frobenius norm; the determinant above excludes a reflection.
  const Eigen::JacobiSVD<Eigen::Matrix3d> svd(linear, Eigen::ComputeFullU | Eigen::ComputeFullV);
  trans_first.leftCols<3>() = svd.matrixU() * svd.matrixV().transpose();
  return pose_from_trans_first(trans_first);
}

torch::Tensor tensor_from_poses(const std::vector<Pose>& poses) {
  torch::Tensor tensor = torch::empty({static_cast<std::int64_t>(poses.size()), 3, 4}, torch::kFloat32);
  for (std::size_t i = 0; i < poses.size(); ++i)
    tensor[static_cast<std::int64_t>(i)] = tensor_from_pose(poses[i]).squeeze(0);
  return tensor;
}

std::vector<Pose> poses_from_tensor(const torch::Tensor& matrices) {
  check_batch(matrices, {3, 4}, "poses_from_tensor", "matrices");
  std::vector<Pose> poses;
  const torch::Tensor host = matrices.detach().to(torch::kCPU);
  for (std::int64_t i = 0; i < host.size(0); ++i) poses.push_back(pose_from_tensor(host[i]));
  return poses;
}

}  // namespace svort
