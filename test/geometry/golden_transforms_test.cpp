#include <gtest/gtest.h>

#include "golden_data.h"
#include "svort_ros/geometry/anchor_points.h"
#include "svort_ros/geometry/rigid_transform.h"

namespace svort {
namespace {

constexpr double kMatrixTolerance = 1e-6;
constexpr double kTranslationTolerance = 1e-5;  // mm; the last bit of 30 mm in float32 is 2e-6
constexpr double kPointTolerance = 1e-3;        // mm
constexpr double kAngleTolerance = 1e-5;        // rad
constexpr double kNearHalfTurn = 0.01;          // rad from pi: the axis has two signs there, matrices are compared

struct TransformDeviation {
  double rotation, translation;
};

TransformDeviation transform_deviation(const torch::Tensor& actual, const torch::Tensor& expected) {
  EXPECT_EQ(actual.sizes(), expected.sizes());
  return {deviation(actual.slice(2, 0, 3), expected.slice(2, 0, 3)).maximum,
          deviation(actual.slice(2, 3, 4), expected.slice(2, 3, 4)).maximum};
}

class GoldenTransforms : public testing::Test {
 protected:
  void check_matrix(const torch::Tensor& actual, const std::string& key) {
    const TransformDeviation d = transform_deviation(actual, data_.at(key));
    rotation_.check(d.rotation, key);
    translation_.check(d.translation, key);
  }

  // Axis-angle: numbers where the axis is unique, matrices everywhere.
  void check_axisangle(const torch::Tensor& actual, const std::string& key) {
    const torch::Tensor expected = data_.at(key);
    ASSERT_EQ(actual.sizes(), expected.sizes()) << key;
    const torch::Tensor angle = expected.slice(1, 0, 3).norm(2, 1);
    // Only `ax_res` keeps angles beyond a half turn, as it never was a matrix; those too are compared as matrices.
    const torch::Tensor unique = angle < M_PI - kNearHalfTurn;
    ASSERT_GT(unique.sum().item<std::int64_t>(), 0) << key;
    angle_.check(deviation(actual.slice(1, 0, 3).index({unique}), expected.slice(1, 0, 3).index({unique})).maximum,
                 key);
    // Near pi, the axis of a float32 matrix is known to about 1e-7 / (pi - angle); the rotation itself is not in doubt.
    const TransformDeviation d = transform_deviation(axisangle_to_matrix(actual), axisangle_to_matrix(expected));
    angle_as_matrix_.check(d.rotation, key);
    translation_.check(d.translation, key);
  }

  const GoldenData data_{"transforms.pt"};
  WorstDeviation rotation_{"rotation matrices, maximum", kMatrixTolerance};
  WorstDeviation translation_{"translations, maximum (mm)", kTranslationTolerance};
  WorstDeviation angle_{"axis-angle away from pi, maximum (rad)", kAngleTolerance};
  WorstDeviation angle_as_matrix_{"axis-angle compared as matrices, maximum", kAngleTolerance};
};

TEST_F(GoldenTransforms, AxisAngleAndMatrices) {
  const torch::Tensor ax = data_.at("ax"), mat = data_.at("mat");
  ASSERT_GE(ax.size(0), 1);
  check_matrix(axisangle_to_matrix(ax), "mat");
  check_axisangle(matrix_to_axisangle(mat), "ax_back");
  check_matrix(trans_first_to_last(mat), "mat_last");
  check_axisangle(matrix_to_axisangle(trans_first_to_last(mat)), "ax_last");
  const torch::Tensor first_of_last = trans_last_to_first(axisangle_to_matrix(ax));
  check_matrix(first_of_last, "mat_first_of_last");
  check_axisangle(matrix_to_axisangle(first_of_last), "ax_first_of_last");
  check_matrix(inverse_transform(mat), "inv_mat");
  check_axisangle(matrix_to_axisangle(inverse_transform(mat)), "inv_ax");
  const torch::Tensor composed = compose_transforms(mat, mat.index_select(0, data_.at("perm").to(torch::kLong)));
  check_matrix(composed, "compose_mat");
  check_axisangle(matrix_to_axisangle(composed), "compose_ax");
  check_matrix(change_resolution(mat, 1.0, 0.8), "mat_res");
  check_axisangle(matrix_to_axisangle(change_resolution(mat, 1.0, 0.8)), "ax_res");
}

TEST_F(GoldenTransforms, Points) {
  const torch::Tensor mat = data_.at("mat"), x = data_.at("x");
  WorstDeviation worst("points, maximum (mm)", kPointTolerance);
  worst.check(deviation(transform_points(mat, x), data_.at("x_first")).maximum, "x_first");
  worst.check(deviation(transform_points(trans_last_to_first(mat), x), data_.at("x_last")).maximum, "x_last");
  int configurations = 0;
  for (; data_.has("pt_cfg_" + std::to_string(configurations)); ++configurations) {
    const std::string index = std::to_string(configurations);
    const torch::Tensor cfg = data_.at("pt_cfg_" + index).to(torch::kFloat64);
    // The pixel size came from a float32 file: 0.8 reads as 0.800000012.
    const AnchorFrame frame{static_cast<int>(cfg[0].item<double>()), static_cast<int>(cfg[1].item<double>()),
                            cfg[2].item<double>()};
    worst.check(deviation(anchor_points_from_matrix(mat, frame), data_.at("pt_" + index)).maximum, "pt_" + index);
    check_matrix(matrix_from_anchor_points(data_.at("pt_" + index)), "mat_of_pt_" + index);
  }
  EXPECT_GE(configurations, 1);
  check_matrix(matrix_from_anchor_points(data_.at("pt_noisy")), "mat_of_pt_noisy");
  check_axisangle(matrix_to_axisangle(matrix_from_anchor_points(data_.at("pt_noisy"))), "ax_of_pt_noisy");
}

}  // namespace
}  // namespace svort
