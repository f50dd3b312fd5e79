#pragma once

#include <torch/types.h>

#include <vector>

#include "svort_ros/geometry/pose.h"

namespace svort {

// Batches of rigid transforms as tensors, differentiable, in the conventions of the public SVoRT implementation.
//
// A transform is n x 3 x 4, [R|t]; *trans_first* means y = R (x + t), *trans_last* y = R x + t. Axis-angle is n x 6,
// (rx, ry, rz) in rad and (tx, ty, tz) in mm. Everything is trans_first unless the name says otherwise. float32 and
// float64 are accepted; the result has the type and device of the argument.

/// n x 6 -> n x 3 x 4. Translation is copied. Series expansion near zero rotation.
torch::Tensor axisangle_to_matrix(const torch::Tensor& axisangle);

/// n x 3 x 4 -> n x 6, rotation angle in [0, pi].
torch::Tensor matrix_to_axisangle(const torch::Tensor& matrix);

torch::Tensor trans_first_to_last(const torch::Tensor& matrix);
torch::Tensor trans_last_to_first(const torch::Tensor& matrix);

/// Inverse of each transform.
torch::Tensor inverse_transform(const torch::Tensor& matrix);

/// a after b: x -> a(b(x)).
torch::Tensor compose_transforms(const torch::Tensor& a, const torch::Tensor& b);

/// Translation re-expressed in voxels of another size: t * (resolution_from / resolution_to).
torch::Tensor change_resolution(const torch::Tensor& matrix, double resolution_from, double resolution_to);

/// Points n x m x 3 (or n x 3) under each transform.
torch::Tensor transform_points(const torch::Tensor& matrix, const torch::Tensor& points);

/// One pose as a 1 x 3 x 4 float32 trans_first tensor, translation in mm.
torch::Tensor tensor_from_pose(const Pose& pose);

/// Inverse of tensor_from_pose; the argument is 3 x 4 or 1 x 3 x 4. The rotation is re-orthonormalised.
Pose pose_from_tensor(const torch::Tensor& matrix);

/// The same for many: n x 3 x 4, on the CPU; and back.
torch::Tensor tensor_from_poses(const std::vector<Pose>& poses);
std::vector<Pose> poses_from_tensor(const torch::Tensor& matrices);

}  // namespace svort
