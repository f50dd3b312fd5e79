#include "svort_ros/geometry/rigid_transform.h"

#include <gtest/gtest.h>
#include <torch/types.h>

#include <cmath>
#include <functional>
#include <stdexcept>

#include "svort_ros/geometry/anchor_points.h"

namespace svort {
namespace {

double largest(const torch::Tensor& difference) { return difference.abs().max().item<double>(); }

// Analytic derivative of sum(weights * f(x)) against central differences, in float64.
void expect_gradient(const std::function<torch::Tensor(const torch::Tensor&)>& f, const torch::Tensor& at,
                     double tolerance) {
  const torch::Tensor x = at.clone().set_requires_grad(true);
  const torch::Tensor y = f(x);
  const torch::Tensor weights = torch::randn_like(y).detach();
  (y * weights).sum().backward();
  ASSERT_TRUE(torch::isfinite(x.grad()).all().item<bool>());
  const torch::NoGradGuard no_grad;
  constexpr double kStep = 1e-6;
  for (std::int64_t i = 0; i < at.numel(); ++i) {
    torch::Tensor up = at.clone(), down = at.clone();
    up.view({-1})[i] += kStep;
    down.view({-1})[i] -= kStep;
    const double numeric = ((f(up) - f(down)) * weights).sum().item<double>() / (2 * kStep);
    EXPECT_NEAR(x.grad().reshape({-1})[i].item<double>(), numeric, tolerance * (1. + std::abs(numeric))) << i;
  }
}

class RigidTransform : public testing::TestWithParam<torch::ScalarType> {
 protected:
  void SetUp() override {
    torch::manual_seed(3);
    axisangle_ = torch::cat({torch::randn({40, 3}), torch::randn({40, 3}) * 30}, 1).to(GetParam());
    matrix_ = axisangle_to_matrix(axisangle_);
    tolerance_ = GetParam() == torch::kFloat32 ? 2e-5 : 1e-12;  // translations of up to 100 mm
  }
  torch::Tensor axisangle_, matrix_;
  double tolerance_ = 0.;
};

TEST_P(RigidTransform, KeepsTypeAndIsARotation) {
  EXPECT_EQ(matrix_.scalar_type(), GetParam());
  const torch::Tensor rotation = matrix_.slice(2, 0, 3);
  EXPECT_LT(largest(torch::matmul(rotation, rotation.transpose(1, 2)) - torch::eye(3, matrix_.options())), tolerance_);
  EXPECT_LT(largest(axisangle_to_matrix(matrix_to_axisangle(matrix_)) - matrix_), tolerance_);
}

TEST_P(RigidTransform, GroupLaws) {
  const torch::Tensor other = matrix_.flip({0}), points = torch::randn({40, 5, 3}, matrix_.options()) * 40;
  EXPECT_LT(largest(transform_points(compose_transforms(matrix_, other), points) -
                    transform_points(matrix_, transform_points(other, points))),
            4 * tolerance_);
  EXPECT_LT(largest(transform_points(inverse_transform(matrix_), transform_points(matrix_, points)) - points),
            4 * tolerance_);
  EXPECT_LT(largest(trans_last_to_first(trans_first_to_last(matrix_)) - matrix_), 4 * tolerance_);
  const torch::Tensor last = trans_first_to_last(matrix_);
  EXPECT_LT(largest(torch::matmul(points, last.slice(2, 0, 3).transpose(1, 2)) + last.slice(2, 3, 4).transpose(1, 2) -
                    transform_points(matrix_, points)),
            4 * tolerance_);
  EXPECT_LT(largest(transform_points(matrix_, points.select(1, 2)) - transform_points(matrix_, points).select(1, 2)),
            tolerance_);
}

TEST_P(RigidTransform, AnchorPointsRoundTrip) {
  const torch::Tensor points = anchor_points_from_matrix(matrix_, AnchorFrame{96, 128, 0.9});
  EXPECT_EQ(points.sizes(), (std::vector<std::int64_t>{40, 9}));
  EXPECT_LT(largest(matrix_from_anchor_points(points) - matrix_), 5 * tolerance_);
}

INSTANTIATE_TEST_SUITE_P(Types, RigidTransform, testing::Values(torch::kFloat32, torch::kFloat64));

TEST(RigidTransformGradients, MatchCentralDifferences) {
  torch::manual_seed(4);
  const auto wide = torch::TensorOptions().dtype(torch::kFloat64);
  // Generic, zero, tiny, near pi with each axis largest: every branch of the conversions.
  torch::Tensor axisangle = torch::randn({6, 6}, wide);
  axisangle[1].slice(0, 0, 3).zero_();
  axisangle[2].slice(0, 0, 3).fill_(1e-4);
  for (std::int64_t axis = 0; axis < 3; ++axis) {
    axisangle[3 + axis].slice(0, 0, 3).fill_(0.3);
    axisangle[3 + axis][axis] = 2.9;
  }
  // First order below |r|^2 = 1e-6: the derivative is right to |r|.
  expect_gradient(axisangle_to_matrix, axisangle, 3e-4);
  const torch::Tensor matrix = axisangle_to_matrix(axisangle);
  expect_gradient(matrix_to_axisangle, matrix, 1e-4);
  expect_gradient(matrix_from_anchor_points, anchor_points_from_matrix(matrix, AnchorFrame{}), 1e-6);
  expect_gradient([](const torch::Tensor& m) { return compose_transforms(inverse_transform(m), m.flip({0})); }, matrix,
                  1e-6);
}

TEST(RigidTransformPoses, TensorAndPose) {
  Pose pose(Eigen::AngleAxisd(2.1, Eigen::Vector3d(1., 2., 3.).normalized()));
  pose.translation() = Eigen::Vector3d(40., -3., 17.);
  const torch::Tensor tensor = tensor_from_pose(pose);
  EXPECT_EQ(tensor.scalar_type(), torch::kFloat32);
  EXPECT_TRUE(pose_from_tensor(tensor).isApprox(pose, 1e-6));
  const Pose restored = pose_from_tensor(tensor[0]);
  EXPECT_TRUE(is_rigid(restored, 1e-14));  // re-orthonormalised in float64
  const torch::Tensor many = tensor_from_poses({Pose::Identity(), pose});
  EXPECT_EQ(many.sizes(), torch::IntArrayRef({2, 3, 4}));
  EXPECT_TRUE(torch::equal(many[1], tensor[0]));
  EXPECT_TRUE(poses_from_tensor(many).at(1).isApprox(pose, 1e-6));
  EXPECT_TRUE(poses_from_tensor(tensor_from_poses({})).empty());
  const torch::Tensor point = torch::tensor({{1.F, 2.F, 3.F}});
  const Eigen::Vector3d expected = pose * Eigen::Vector3d(1., 2., 3.);
  const torch::Tensor moved = transform_points(tensor, point);
  for (int axis = 0; axis < 3; ++axis) EXPECT_NEAR(moved[0][axis].item<double>(), expected[axis], 1e-5);
}

TEST(RigidTransformErrors, NameTheArgument) {
  EXPECT_THROW(axisangle_to_matrix(torch::zeros({2, 5})), std::invalid_argument);
  EXPECT_THROW(matrix_to_axisangle(torch::zeros({3, 4})), std::invalid_argument);
  EXPECT_THROW(matrix_to_axisangle(torch::Tensor()), std::invalid_argument);
  EXPECT_THROW(inverse_transform(torch::zeros({2, 3, 4}, torch::kInt32)), std::invalid_argument);
  EXPECT_THROW(change_resolution(torch::zeros({2, 3, 4}), 1., 0.), std::invalid_argument);
  EXPECT_THROW(transform_points(torch::zeros({2, 3, 4}), torch::zeros({2, 4})), std::invalid_argument);
  EXPECT_THROW(matrix_from_anchor_points(torch::zeros({2, 6})), std::invalid_argument);
  EXPECT_THROW(anchor_points_from_matrix(torch::zeros({2, 3, 4}), AnchorFrame{1, 128, 1.}), std::invalid_argument);
  EXPECT_THROW(pose_from_tensor(torch::zeros({2, 3, 4})), std::invalid_argument);
  EXPECT_THROW(pose_from_tensor(torch::zeros({3, 4})), std::invalid_argument);
  EXPECT_THROW(poses_from_tensor(torch::zeros({3, 4})), std::invalid_argument);
  EXPECT_THROW(pose_from_tensor(torch::full({3, 4}, NAN)), std::invalid_argument);
}

}  // namespace
}  // namespace svort
