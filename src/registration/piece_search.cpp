#include "piece_search.h"

#include <torch/types.h>

#include <algorithm>
#include <cmath>
#include <cstdint>

#include "../acquisition/parallel.h"
#include "rotation_grid.h"
#include "trajectory.h"

namespace svort {
namespace {

constexpr double kVoxelBlur = 1.;  // fills the gaps between the slices of few pieces, voxels
constexpr double kLeastShare = 0.02;
constexpr int kRotations = 6300;  // all over SO(3), 13 degrees apart; 800 of them within the largest reach
constexpr std::size_t kRefined = 6;
constexpr double kDistinctRad = 0.35;
constexpr double kLeverMm = 40., kLargestStepMm = 6., kSmallStepMm = 0.2;
constexpr int kSteps = 8;
constexpr double kImageScale = 0.12;  // as RefinementOptions

/// Pearson's correlation from sums.
class Correlation {
 public:
  void add(double a, double b) {
    ++count_;
    a_ += a;
    b_ += b;
    aa_ += a * a;
    bb_ += b * b;
    ab_ += a * b;
  }
  double value() const {
    const double variances = (count_ * aa_ - a_ * a_) * (count_ * bb_ - b_ * b_);
    return variances > 0. ? (count_ * ab_ - a_ * b_) / std::sqrt(variances) : -1.;
  }

 private:
  double count_ = 0., a_ = 0., b_ = 0., aa_ = 0., bb_ = 0., ab_ = 0.;
};

double angle_of(const Pose& pose) { return Eigen::AngleAxisd(pose.linear()).angle(); }

/// All turns that may be tried.
const std::vector<Eigen::Quaterniond>& turns() {
  static const std::vector<Eigen::Quaterniond> turns = [] {
    std::vector<Eigen::Quaterniond> rotations = spread_rotations(kRotations);
    const auto angle = [](const Eigen::Quaterniond& rotation) {
      return rotation.angularDistance(Eigen::Quaterniond::Identity());
    };
    rotations.erase(
        std::remove_if(rotations.begin(), rotations.end(), [&](const auto& r) { return angle(r) > kLargestReachRad; }),
        rotations.end());
    return rotations;
  }();
  return turns;
}

}  // namespace

double piece_correlation(const Piece& piece, const Pose& motion, const SampledVolume& volume, std::size_t stride) {
  Correlation correlation;
  for (std::size_t i = 0; i < piece.points.size(); ++i) {
    const Eigen::Affine3f pose = (motion * piece.poses[i]).cast<float>();
    const SlicePoints& points = *piece.points[i];
    for (std::size_t k = 0; k < points.value.size(); k += stride) {
      const Eigen::Vector3f p(points.position[k].x(), points.position[k].y(), 0.F);
      correlation.add(static_cast<double>(volume.at(pose * p).value), static_cast<double>(points.value[k]));
    }
  }
  return correlation.value();
}

Eigen::Vector3d piece_centre(const Piece& piece) {
  Eigen::Vector3d sum = Eigen::Vector3d::Zero();
  double brightness = 0.;
  for (std::size_t i = 0; i < piece.points.size(); ++i) {
    const SlicePoints& points = *piece.points[i];
    for (std::size_t k = 0; k < points.value.size(); ++k) {
      const Eigen::Vector2d p = points.position[k].cast<double>();
      sum += static_cast<double>(points.value[k]) * (piece.poses[i] * Eigen::Vector3d(p.x(), p.y(), 0.));
      brightness += static_cast<double>(points.value[k]);
    }
  }
  return brightness > 0. ? Eigen::Vector3d(sum / brightness) : Eigen::Vector3d(Eigen::Vector3d::Zero());
}

Pose refine_piece(const Piece& piece, const SampledVolume& volume, Pose motion_of_piece) {
  // The blur in plane is far wider than a slice is thick: its profile need not be sampled.
  const ProfileTaps taps = profile_taps(0.);
  SliceTermOptions start;
  start.image_scale = kImageScale * piece.bright;
  start.offset_spread = 0.1 * piece.bright;
  std::vector<SliceTermOptions> options(piece.points.size(), start);
  for (int step = 0; step < kSteps; ++step) {
    Matrix6d hessian = Matrix6d::Zero();
    Vector6d gradient = Vector6d::Zero();
    for (std::size_t i = 0; i < options.size(); ++i) {
      const SliceTerms terms =
          slice_terms(*piece.points[i], taps, volume, motion_of_piece * piece.poses[i], options[i]);
      options[i].gain = terms.gain;
      options[i].offset = terms.offset;
      hessian += terms.hessian;
      gradient += terms.gradient;
    }
    hessian.diagonal() *= 1. + 1e-3;
    hessian.diagonal().array() += 1e-9;
    Vector6d change = -hessian.ldlt().solve(gradient);
    const double size_mm = motion_size(change, kLeverMm);
    if (size_mm > kLargestStepMm) change *= kLargestStepMm / size_mm;
    motion_of_piece = motion(change) * motion_of_piece;
    if (size_mm < kSmallStepMm) break;
  }
  return motion_of_piece;
}

Placing place_piece(const Piece& piece, const SampledVolume& volume, const Eigen::Vector3d& centre,
                    const std::vector<Pose>& motions, double reach_rad, double margin) {
  std::vector<Pose> tried = motions;
  const Eigen::Vector3d own_centre = piece_centre(piece);
  for (const Eigen::Quaterniond& rotation : turns()) {
    if (rotation.angularDistance(Eigen::Quaterniond::Identity()) > reach_rad) continue;
    Pose turn = Pose::Identity();
    turn.linear() = rotation.toRotationMatrix();
    turn.translation() = centre - turn.linear() * own_centre;
    tried.push_back(turn);
  }
  std::vector<PlacedPiece> candidates(tried.size());
  parallel_tasks(static_cast<std::int64_t>(tried.size()), [&](std::int64_t task) {
    const auto k = static_cast<std::size_t>(task);
    candidates[k] = {tried[k], piece_correlation(piece, tried[k], volume, 2)};
  });
  std::stable_sort(candidates.begin(), candidates.end(),
                   [](const PlacedPiece& a, const PlacedPiece& b) { return a.correlation > b.correlation; });
  std::vector<PlacedPiece> chosen(1);  // where it is comes first
  for (const PlacedPiece& candidate : candidates) {
    if (chosen.size() > kRefined) break;
    const bool distinct = std::all_of(chosen.begin() + 1, chosen.end(), [&](const PlacedPiece& other) {
      return angle_of(candidate.motion * other.motion.inverse()) > kDistinctRad;
    });
    if (distinct) chosen.push_back(candidate);
  }
  parallel_tasks(static_cast<std::int64_t>(chosen.size()), [&](std::int64_t task) {
    PlacedPiece& candidate = chosen[static_cast<std::size_t>(task)];
    candidate.motion = refine_piece(piece, volume, candidate.motion);
    candidate.correlation = piece_correlation(piece, candidate.motion, volume, 1);
  });
  Placing placing{chosen.front(), chosen.front()};
  for (const PlacedPiece& candidate : chosen)
    if (candidate.correlation > std::max(placing.best.correlation, placing.here.correlation + margin))
      placing.best = candidate;
  return placing;
}

SampledVolume faded_volume(const WeightedVolume& sums, double voxel_mm, Eigen::Vector3d* centre) {
  const auto size = static_cast<int>(sums.sums.size(0));
  std::vector<float> values = blurred(values_of(sums.sums), size, kVoxelBlur);
  const std::vector<float> seen_by = blurred(values_of(sums.support), size, kVoxelBlur);
  const float least =
      std::max(1e-12F, static_cast<float>(kLeastShare) * *std::max_element(seen_by.begin(), seen_by.end()));
  Eigen::Vector3d sum = Eigen::Vector3d::Zero();
  double brightness = 0.;
  std::size_t at = 0;
  for (int z = 0; z < size; ++z)
    for (int y = 0; y < size; ++y)
      for (int x = 0; x < size; ++x, ++at) {
        values[at] /= std::max(seen_by[at], least);
        sum += static_cast<double>(values[at]) * Eigen::Vector3d(x, y, z);
        brightness += static_cast<double>(values[at]);
      }
  *centre = Eigen::Vector3d::Zero();
  if (brightness > 0.) *centre = (sum / brightness - Eigen::Vector3d::Constant(0.5 * (size - 1))) * voxel_mm;
  return SampledVolume(std::move(values), size, voxel_mm);
}

}  // namespace svort
