#pragma once

#include <Eigen/Geometry>
#include <vector>

namespace svort {

/// Rotations spread evenly and deterministically over SO(3): a spiral on the 3-sphere whose two angles advance by
/// irrational steps (super-Fibonacci sampling, Alexa, CVPR 2022). Unit quaternions.
std::vector<Eigen::Quaterniond> spread_rotations(int count);

}  // namespace svort
