#pragma once

#include <torch/types.h>

#include <cstdint>
#include <vector>

#include "svort_ros/geometry/anchor_points.h"
#include "svort_ros/geometry/pose.h"

namespace svort {

/// Poses as the functions below take them: n x 3 x 4, trans_first, mm, float64.
torch::Tensor poses_tensor(const std::vector<Pose>& poses);

/// Errors of poses, slice by slice (paper, sec. 3).
struct PoseErrors {
  torch::Tensor points;  ///< n x 3, distance of each anchor point from its true place, mm
  torch::Tensor ed;      ///< n, their mean: Euclidean distance, mm
  torch::Tensor gd;      ///< n, geodesic distance of the rotations, rad, 0 .. pi
};

/// @param estimated n x 3 x 4, trans_first, mm; float32 or float64 (the result is float64, on the CPU)
/// @param truth     the same
/// @throws std::invalid_argument if the shapes do not fit
PoseErrors pose_errors(const torch::Tensor& estimated, const torch::Tensor& truth, const AnchorFrame& frame);

/// The rigid transform that brings the estimated anchor points of all slices together as near to the true ones as one
/// transform can (least squares; Kabsch): T with T * estimated ~ truth. The brain frame of a method that knows no
/// atlas is arbitrary; what is left after this is its relative error.
/// @throws std::invalid_argument if the shapes do not fit or n is 0
Pose global_alignment(const torch::Tensor& estimated, const torch::Tensor& truth, const AnchorFrame& frame);

/// transform * each pose; n x 3 x 4, trans_first, mm, float64.
torch::Tensor transformed_poses(const Pose& transform, const torch::Tensor& poses);

/// pose_errors() after global_alignment().
PoseErrors relative_pose_errors(const torch::Tensor& estimated, const torch::Tensor& truth, const AnchorFrame& frame);

/// Mean, standard deviation (n - 1), median and maximum of finite values; NaN without any.
struct ErrorSummary {
  std::int64_t count = 0;
  double mean = 0., deviation = 0., median = 0., maximum = 0.;
};
ErrorSummary summarise(const torch::Tensor& values);

}  // namespace svort
