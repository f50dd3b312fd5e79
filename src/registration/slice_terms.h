#pragma once

#include <Eigen/Core>
#include <Eigen/Geometry>
#include <vector>

#include "sampled_volume.h"
#include "svort_ros/geometry/pose.h"

namespace svort {

using Vector6d = Eigen::Matrix<double, 6, 1>;
using Matrix6d = Eigen::Matrix<double, 6, 6>;

/// A small motion: x -> exp(rotation) x + translation, (rx, ry, rz, tx, ty, tz), rad and mm.
Pose motion(const Vector6d& twist);
/// Inverse of motion().
Vector6d twist_of(const Pose& pose);

/// One slice at one level: its brain pixels as points.
struct SlicePoints {
  std::vector<Eigen::Vector2f> position;  ///< in the slice, mm
  std::vector<float> value;
};

/// Gauss-Hermite nodes of the slice profile along the normal, mm, and their weights (sum 1).
struct ProfileTaps {
  std::vector<float> offset, weight;
};
/// @param sigma_mm standard deviation of what is left of the profile after the volume's blur
ProfileTaps profile_taps(double sigma_mm);

/// Normal equations of one slice's image differences, in the six numbers of motion() applied after its pose.
struct SliceTerms {
  Matrix6d hessian = Matrix6d::Zero();
  Vector6d gradient = Vector6d::Zero();  ///< of the cost: a step solves hessian * step = -gradient
  double cost = 0.;                      ///< mean robust cost per pixel
  double ncc = 0.;                       ///< NaN without pixels or variation
  double gain = 1., offset = 0.;
};

struct SliceTermOptions {
  double image_scale = 0.1;       ///< Cauchy scale, intensity
  double gain_spread = 0.3;       ///< prior standard deviation of the gain around 1
  double offset_spread = 0.1;     ///< and of the offset around 0, in intensity
  double gain = 1., offset = 0.;  ///< where gain and offset stand
};

/// Differences r = gain x predicted + offset - pixel of a slice at `pose`; gain and offset are solved for as well and
/// eliminated, so that the step of the pose allows for them.
SliceTerms slice_terms(const SlicePoints& points, const ProfileTaps& taps, const SampledVolume& volume,
                       const Pose& pose, const SliceTermOptions& options);

}  // namespace svort
