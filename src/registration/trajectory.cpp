#include "trajectory.h"

#include <Eigen/Cholesky>
#include <cmath>
#include <stdexcept>

namespace svort {
namespace {

/// How a twist of the earlier slice acts on the difference to the later one: Ad(D) of our ordering (rotation first).
Matrix6d adjoint_of(const Pose& pose) {
  const Eigen::Matrix3d rotation = pose.linear();
  const Eigen::Vector3d t = pose.translation();
  Eigen::Matrix3d cross;
  cross << 0., -t.z(), t.y(), t.z(), 0., -t.x(), -t.y(), t.x(), 0.;
  Matrix6d result = Matrix6d::Zero();
  result.topLeftCorner<3, 3>() = rotation;
  result.bottomLeftCorner<3, 3>() = cross * rotation;
  result.bottomRightCorner<3, 3>() = rotation;
  return result;
}

}  // namespace

bool solve_block_tridiagonal(std::vector<Matrix6d> diagonal, const std::vector<Matrix6d>& upper,
                             std::vector<Vector6d>* right) {
  const std::size_t n = diagonal.size();
  if (right->size() != n || (n > 0 && upper.size() + 1 != n))
    throw std::logic_error("solve_block_tridiagonal: sizes do not fit");
  std::vector<Eigen::LLT<Matrix6d>> pivots(n);
  for (std::size_t i = 0; i < n; ++i) {
    if (i > 0) {
      const Matrix6d factor = pivots[i - 1].solve(upper[i - 1]);
      diagonal[i] -= upper[i - 1].transpose() * factor;
      (*right)[i] -= factor.transpose() * (*right)[i - 1];
    }
    pivots[i].compute(diagonal[i]);
    if (pivots[i].info() != Eigen::Success) return false;
  }
  for (std::size_t i = n; i-- > 0;) {
    if (i + 1 < n) (*right)[i] -= upper[i] * (*right)[i + 1];
    pivots[i].solveInPlace((*right)[i]);
  }
  return true;
}

std::vector<Matrix6d> block_tridiagonal_inverse(const std::vector<Matrix6d>& diagonal,
                                                const std::vector<Matrix6d>& upper) {
  const std::size_t n = diagonal.size();
  if (n > 0 && upper.size() + 1 != n) throw std::logic_error("block_tridiagonal_inverse: sizes do not fit");
  // What elimination from either end leaves of a block; together they are the block's Schur complement.
  std::vector<Matrix6d> from_front = diagonal, from_back = diagonal;
  Eigen::LLT<Matrix6d> pivot;
  for (std::size_t i = 1; i < n; ++i) {
    pivot.compute(from_front[i - 1]);
    if (pivot.info() != Eigen::Success) return {};
    from_front[i] -= upper[i - 1].transpose() * pivot.solve(upper[i - 1]);
  }
  for (std::size_t i = n; i-- > 1;) {
    pivot.compute(from_back[i]);
    if (pivot.info() != Eigen::Success) return {};
    from_back[i - 1] -= upper[i - 1] * pivot.solve(upper[i - 1].transpose());
  }
  std::vector<Matrix6d> inverse(n);
  for (std::size_t i = 0; i < n; ++i) {
    pivot.compute(from_front[i] + from_back[i] - diagonal[i]);
    if (pivot.info() != Eigen::Success) return {};
    inverse[i] = pivot.solve(Matrix6d::Identity());
  }
  return inverse;
}

double motion_size(const Vector6d& twist, double lever_mm) {
  return std::sqrt(lever_mm * lever_mm * twist.head<3>().squaredNorm() + twist.tail<3>().squaredNorm());
}

double expected_motion_size(const Matrix6d& covariance, double lever_mm) {
  return std::sqrt(lever_mm * lever_mm * covariance.diagonal().head<3>().sum() + covariance.diagonal().tail<3>().sum());
}

std::vector<Vector6d> solve_trajectory(const std::vector<SliceTerms>& terms, const std::vector<Pose>& motions,
                                       const std::vector<double>& spread_mm, const WalkOptions& options,
                                       std::vector<Matrix6d>* covariance) {
  const std::size_t n = terms.size();
  std::vector<Matrix6d> diagonal(n), upper(n > 0 ? n - 1 : 0, Matrix6d::Zero());
  std::vector<Vector6d> right(n);
  Vector6d metric;
  metric << Eigen::Vector3d::Constant(options.lever_mm * options.lever_mm), Eigen::Vector3d::Ones();
  for (std::size_t i = 0; i < n; ++i) {
    diagonal[i] = terms[i].hessian;
    right[i] = -terms[i].gradient;
  }
  for (std::size_t i = 0; i + 1 < n; ++i) {
    if (!std::isfinite(spread_mm[i])) continue;
    // d = log(M_{i+1} M_i^-1) changes by step_{i+1} - Ad(M_{i+1} M_i^-1) step_i.
    const Pose difference = motions[i + 1] * motions[i].inverse();
    const Vector6d twist = twist_of(difference);
    const double ratio = motion_size(twist, options.lever_mm) / (options.jump_mm * spread_mm[i]);
    const double weight = 1. / (1. + ratio * ratio) / (spread_mm[i] * spread_mm[i]);
    const Matrix6d earlier = adjoint_of(difference);
    const Matrix6d weights = (weight * metric).asDiagonal();
    diagonal[i + 1] += weights;
    diagonal[i] += earlier.transpose() * weights * earlier;
    upper[i] -= earlier.transpose() * weights;
    right[i + 1] -= weights * twist;
    right[i] += earlier.transpose() * (weights * twist);
  }
  // A whisper of damping: directions that neither images nor neighbours see stay where they are.
  for (Matrix6d& block : diagonal) block.diagonal() += 1e-6 * metric;
  if (covariance != nullptr) *covariance = block_tridiagonal_inverse(diagonal, upper);
  if (!solve_block_tridiagonal(diagonal, upper, &right)) right.assign(n, Vector6d::Zero());
  return right;
}

}  // namespace svort
