#pragma once

#include <torch/types.h>

#include <Eigen/Geometry>
#include <cmath>
#include <cstddef>
#include <cstdint>
#include <random>
#include <vector>

#include "svort_ros/acquisition/point_spread_function.h"
#include "svort_ros/acquisition/slice.h"
#include "svort_ros/acquisition/slice_acquisition.h"
#include "svort_ros/geometry/rigid_transform.h"
#include "svort_ros/registration/registration_input.h"

namespace svort_test {

/// Brightness of a head without symmetry at a point, mm; 0 outside its ellipsoid of 25 x 31 x 22 mm.
inline double brain_intensity(const Eigen::Vector3d& p) {
  const double r2 = p.cwiseQuotient(Eigen::Vector3d(25., 31., 22.)).squaredNorm();
  if (r2 > 1.) return 0.;
  const auto blob = [&](double x, double y, double z, double size) {
    return std::exp(-0.5 * (p - Eigen::Vector3d(x, y, z)).squaredNorm() / (size * size));
  };
  return 0.45 + 0.12 * std::sin(.31 * p.x() + .4) * std::cos(.27 * p.y()) +
         0.1 * std::sin(.33 * p.z() + .01 * p.x() * p.y()) + 0.4 * blob(9., 12., 4., 5.) -
         0.35 * blob(-10., -4., 6., 6.) + 0.3 * blob(-4., 16., -8., 4.) + 0.3 * blob(6., -18., -3., 5.);
}

/// The head on a cube of voxels centred on the origin, [z][y][x].
inline torch::Tensor brain_volume(std::int64_t size, double voxel_mm,
                                  const svort::Pose& T_volume_head = svort::Pose::Identity()) {
  torch::Tensor volume = torch::empty({size, size, size}, torch::kFloat32);
  float* value = volume.data_ptr<float>();
  const svort::Pose T_head_volume = T_volume_head.inverse();
  for (std::int64_t z = 0; z < size; ++z)
    for (std::int64_t y = 0; y < size; ++y)
      for (std::int64_t x = 0; x < size; ++x) {
        const Eigen::Vector3d at =
            (Eigen::Vector3d(static_cast<double>(x), static_cast<double>(y), static_cast<double>(z)).array() -
             0.5 * static_cast<double>(size - 1))
                .matrix() *
            voxel_mm;
        *value++ = static_cast<float>(brain_intensity(T_head_volume * at));
      }
  return volume;
}

struct SimulatedScanOptions {
  int stacks = 3;
  int slices = 16;         ///< per stack, 3 mm apart
  double walk_mm = 0.5;    ///< head motion from slice to slice
  double between_mm = 2.;  ///< and from stack to stack
  double noise = 0.01;
  unsigned seed = 1;
  std::size_t jump_at = 0;  ///< number of the slice before which the head jumps
  svort::Pose jump = svort::Pose::Identity();
};

struct SimulatedScan {
  svort::RegistrationInput input;
  std::vector<svort::Pose> truth;  ///< T_head_slice
};

inline svort::Pose small_motion(std::mt19937& random, double size_mm) {
  std::normal_distribution<double> normal(0., 1.);
  const auto draw = [&](double scale) -> Eigen::Vector3d {
    return Eigen::Vector3d(normal(random), normal(random), normal(random)) * scale;
  };
  svort::Pose pose = svort::Pose::Identity();
  const Eigen::Vector3d rotation = draw(size_mm / 40. / std::sqrt(6.));
  if (rotation.norm() > 0.)
    pose.linear() = Eigen::AngleAxisd(rotation.norm(), rotation.normalized()).toRotationMatrix();
  pose.translation() = draw(size_mm / std::sqrt(6.));
  return pose;
}

/// A scan of the head that moves, in three nearly orthogonal interleaved stacks, 64 x 64 pixels of 2 mm.
inline SimulatedScan simulated_scan(const SimulatedScanOptions& options) {
  constexpr std::int64_t kVolume = 72;
  constexpr double kVoxel = 1., kPixel = 2., kThickness = 3.;
  std::mt19937 random(options.seed);
  SimulatedScan scan;
  svort::Pose T_head_scanner = svort::Pose::Identity();
  for (int stack = 0; stack < options.stacks; ++stack) {
    Eigen::Matrix3d axes = Eigen::AngleAxisd(.1 * stack, Eigen::Vector3d(1., 2., 3.).normalized()).toRotationMatrix();
    if (stack % 3 == 1) axes = axes * Eigen::AngleAxisd(M_PI / 2., Eigen::Vector3d::UnitX()).toRotationMatrix();
    if (stack % 3 == 2) axes = axes * Eigen::AngleAxisd(M_PI / 2., Eigen::Vector3d::UnitY()).toRotationMatrix();
    if (stack > 0) T_head_scanner = small_motion(random, options.between_mm) * T_head_scanner;
    for (const int index : svort::interleaved_order(options.slices, 2)) {
      T_head_scanner = small_motion(random, options.walk_mm) * T_head_scanner;
      if (scan.truth.size() == options.jump_at) T_head_scanner = options.jump * T_head_scanner;
      svort::Pose nominal = svort::Pose::Identity();
      nominal.linear() = axes;
      nominal.translation() = axes.col(2) * (3. * (index - .5 * (options.slices - 1)));
      scan.input.T_world_slice.push_back(nominal);
      scan.input.stack.push_back(stack);
      scan.input.time_s.push_back(1.2 * static_cast<double>(scan.input.time_s.size()));
      scan.input.thickness_mm.push_back(kThickness);
      scan.truth.push_back(T_head_scanner * nominal);
    }
  }
  const auto n = static_cast<std::int64_t>(scan.truth.size());
  svort::AcquisitionGeometry geometry;
  geometry.resolution_ratio = kPixel / kVoxel;
  geometry.psf = svort::gaussian_psf({kPixel / kVoxel, kPixel / kVoxel, kThickness / kVoxel});
  geometry.transforms = torch::empty({n, 3, 4}, torch::kFloat32);
  for (std::int64_t i = 0; i < n; ++i)
    geometry.transforms[i].copy_(svort::tensor_from_pose(scan.truth[static_cast<std::size_t>(i)]).squeeze(0));
  const svort::SliceAcquisition acquisition(geometry, 64, 64, {kVolume, kVolume, kVolume},
                                            svort::AcquisitionFormulation::fast);
  const torch::Tensor volume = brain_volume(kVolume, kVoxel);
  torch::manual_seed(options.seed);
  const torch::Tensor clean = acquisition.forward(volume);
  const torch::Tensor gain = 1. + 0.05 * torch::randn({n, 1, 1, 1});
  scan.input.masks = (acquisition.forward((volume > 0.).to(torch::kFloat32)) > 0.5).contiguous();
  scan.input.slices =
      ((clean * gain + options.noise * torch::randn_like(clean)).clamp_min(0.) * scan.input.masks).contiguous();
  scan.input.resolution_mm = kPixel;
  return scan;
}

/// Mean distance (mm) of the planes' corners 40 mm from their centres, after the best global rigid motion.
inline double relative_error_mm(const std::vector<svort::Pose>& poses, const std::vector<svort::Pose>& truth) {
  const auto n = static_cast<Eigen::Index>(poses.size());
  Eigen::Matrix3Xd a(3, 3 * n), b(3, 3 * n);
  const Eigen::Vector3d corner[] = {{-40., -40., 0.}, {0., 0., 0.}, {40., -40., 0.}};
  for (Eigen::Index i = 0; i < n; ++i)
    for (Eigen::Index j = 0; j < 3; ++j) {
      a.col(3 * i + j) = poses[static_cast<std::size_t>(i)] * corner[j];
      b.col(3 * i + j) = truth[static_cast<std::size_t>(i)] * corner[j];
    }
  const svort::Pose fit(Eigen::umeyama(a, b, false));
  return ((fit.linear() * a).colwise() + fit.translation() - b).colwise().norm().mean();
}

}  // namespace svort_test
