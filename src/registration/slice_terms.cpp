#include "slice_terms.h"

#include <Eigen/Cholesky>
#include <algorithm>
#include <cmath>
#include <limits>

namespace svort {
namespace {

using Vector8d = Eigen::Matrix<double, 8, 1>;
using Matrix8d = Eigen::Matrix<double, 8, 8>;

struct Predicted {
  Eigen::Matrix<float, 6, 1> jacobian;
  float value;
};

}  // namespace

Pose motion(const Vector6d& twist) {
  Pose pose = Pose::Identity();
  const double angle = twist.head<3>().norm();
  if (angle > 0.) pose.linear() = Eigen::AngleAxisd(angle, twist.head<3>() / angle).toRotationMatrix();
  pose.translation() = twist.tail<3>();
  return pose;
}

Vector6d twist_of(const Pose& pose) {
  const Eigen::AngleAxisd rotation(pose.linear());
  Vector6d twist;
  twist << rotation.angle() * rotation.axis(), pose.translation();
  return twist;
}

ProfileTaps profile_taps(double sigma_mm) {
  const auto s = static_cast<float>(sigma_mm);
  if (sigma_mm < 0.05) return {{0.F}, {1.F}};
  // Five nodes are exact for polynomials of degree 9 along the normal.
  const float a = 1.35562618F * s, b = 2.85697001F * s;
  const float w0 = 0.53333333F, wa = 0.22207592F, wb = 0.01125741F;
  return {{0.F, a, -a, b, -b}, {w0, wa, wa, wb, wb}};
}

SliceTerms slice_terms(const SlicePoints& points, const ProfileTaps& taps, const SampledVolume& volume,
                       const Pose& pose, const SliceTermOptions& options) {
  SliceTerms terms;
  terms.gain = options.gain;
  terms.offset = options.offset;
  const std::size_t count = points.value.size();
  if (count < 2) {
    terms.ncc = std::numeric_limits<double>::quiet_NaN();
    return terms;
  }

  const Eigen::Matrix3f rotation = pose.linear().cast<float>();
  const Eigen::Vector3f centre = pose.translation().cast<float>();
  const Eigen::Vector3f normal = rotation.col(2);
  static thread_local std::vector<Predicted> predicted;
  predicted.resize(count);
  for (std::size_t i = 0; i < count; ++i) {
    const Eigen::Vector2f& p = points.position[i];
    const Eigen::Vector3f x = rotation.col(0) * p.x() + rotation.col(1) * p.y() + centre;
    float value = 0.F;
    Eigen::Vector3f force = Eigen::Vector3f::Zero(), torque = Eigen::Vector3f::Zero();
    for (std::size_t k = 0; k < taps.offset.size(); ++k) {
      const Eigen::Vector3f at = x + taps.offset[k] * normal;
      const SampledVolume::Sample sample = volume.at(at);
      const Eigen::Vector3f gradient = taps.weight[k] * sample.gradient;
      value += taps.weight[k] * sample.value;
      force += gradient;
      torque += at.cross(gradient);
    }
    predicted[i].value = value;
    for (int axis = 0; axis < 3; ++axis) {
      predicted[i].jacobian[axis] = torque[axis];
      predicted[i].jacobian[axis + 3] = force[axis];
    }
  }

  const double scale = options.image_scale;
  Matrix8d hessian = Matrix8d::Zero();
  Vector8d gradient = Vector8d::Zero();
  double cost = 0., sum_p = 0., sum_y = 0., sum_pp = 0., sum_yy = 0., sum_py = 0.;
  Vector8d row;
  for (std::size_t i = 0; i < count; ++i) {
    const double p = predicted[i].value, y = points.value[i];
    sum_p += p;
    sum_y += y;
    sum_pp += p * p;
    sum_yy += y * y;
    sum_py += p * y;
    const double difference = options.gain * p + options.offset - y;
    const double ratio = difference / scale;
    const double weight = 1. / (1. + ratio * ratio);
    cost += 0.5 * scale * scale * std::log1p(ratio * ratio);
    row.head<6>() = options.gain * predicted[i].jacobian.cast<double>();
    row(6) = p;
    row(7) = 1.;
    hessian.selfadjointView<Eigen::Lower>().rankUpdate(row, weight);
    gradient += (weight * difference) * row;
  }
  const auto n = static_cast<double>(count);
  hessian = hessian.selfadjointView<Eigen::Lower>();
  terms.cost = cost / n;
  const double variance = (n * sum_pp - sum_p * sum_p) * (n * sum_yy - sum_y * sum_y);
  terms.ncc =
      variance > 0. ? (n * sum_py - sum_p * sum_y) / std::sqrt(variance) : std::numeric_limits<double>::quiet_NaN();

  // Gain and offset, with priors that keep them defined for flat slices; eliminated by the Schur complement.
  Eigen::Matrix2d gains = hessian.bottomRightCorner<2, 2>();
  Eigen::Vector2d gains_gradient = gradient.tail<2>();
  const double noise = scale * scale;
  gains(0, 0) += noise / (options.gain_spread * options.gain_spread);
  gains(1, 1) += noise / (options.offset_spread * options.offset_spread);
  gains_gradient(0) += noise / (options.gain_spread * options.gain_spread) * (options.gain - 1.);
  gains_gradient(1) += noise / (options.offset_spread * options.offset_spread) * options.offset;
  const Eigen::Matrix2d inverse = gains.inverse();
  const Eigen::Matrix<double, 6, 2> cross = hessian.topRightCorner<6, 2>();
  terms.hessian = hessian.topLeftCorner<6, 6>() - cross * inverse * cross.transpose();
  terms.gradient = gradient.head<6>() - cross * inverse * gains_gradient;
  const Eigen::Vector2d change = -inverse * gains_gradient;
  terms.gain = std::clamp(options.gain + change(0), 0.2, 5.);
  terms.offset = options.offset + change(1);
  return terms;
}

}  // namespace svort
