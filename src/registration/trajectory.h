#pragma once

#include <vector>

#include "slice_terms.h"

namespace svort {

/// Solves a symmetric, positive definite, block-tridiagonal system. Block i has `diagonal[i]`, and `upper[i]` couples i
/// with i + 1. @return false if a pivot is not positive definite; then `right` is undefined, otherwise the solution
bool solve_block_tridiagonal(std::vector<Matrix6d> diagonal, const std::vector<Matrix6d>& upper,
                             std::vector<Vector6d>* right);

/// The random walk of the head in acquisition order.
struct WalkOptions {
  double lever_mm = 40.;
  double jump_mm = 2.;
};

/// Steps of all slices, solved together.
///
/// @param terms     image terms, already divided by the noise variance
/// @param motions   T_brain_scanner of each slice: how the head has moved; consecutive ones are tied
/// @param spread_mm n - 1, expected motion between a slice and the next; infinite: not tied
/// @param covariance if not null, receives each slice's block of the inverse of the whole system: how far its pose is
///                   still uncertain if the terms' noise is as stated
/// @return n steps (see motion()), unbounded
std::vector<Vector6d> solve_trajectory(const std::vector<SliceTerms>& terms, const std::vector<Pose>& motions,
                                       const std::vector<double>& spread_mm, const WalkOptions& options,
                                       std::vector<Matrix6d>* covariance = nullptr);

/// Diagonal blocks of the inverse of a symmetric, positive definite, block-tridiagonal matrix.
/// @return empty if a pivot is not positive definite
std::vector<Matrix6d> block_tridiagonal_inverse(const std::vector<Matrix6d>& diagonal,
                                                const std::vector<Matrix6d>& upper);

/// Size of a motion in mm: root of the squared translation and the squared rotation at the lever.
double motion_size(const Vector6d& twist, double lever_mm);
/// Root of the expected square of motion_size() of a twist with this covariance, mm.
double expected_motion_size(const Matrix6d& covariance, double lever_mm);

}  // namespace svort
