#pragma once

#include <Eigen/Core>
#include <cstddef>
#include <vector>

#include "registration_level.h"
#include "sampled_volume.h"
#include "svort_ros/geometry/pose.h"
#include "weighted_volume.h"

namespace svort {

/// How slices and volumes are seen when they are looked for far away, and how far that is.
constexpr double kSearchPixelMm = 4., kSearchBlurMm = 6., kLargestReachRad = 1.4;

/// Slices that move together, and where they are.
struct Piece {
  std::vector<const SlicePoints*> points;
  std::vector<Pose> poses;
  double bright = 1.;  ///< 0.99 quantile of the brain's pixels
};

/// A motion of a piece, and how well it then correlates with the volume.
struct PlacedPiece {
  Pose motion = Pose::Identity();
  double correlation = -1.;
};

/// Pearson's correlation of all pixels of the piece with the volume; -1 without variation.
/// @param stride 2 takes every second pixel
double piece_correlation(const Piece& piece, const Pose& motion, const SampledVolume& volume, std::size_t stride);

/// Centre of brightness, mm.
Eigen::Vector3d piece_centre(const Piece& piece);

/// The motion, close to `start`, after which the differences of piece and volume are smallest; each slice with a gain
/// and an offset of its own.
Pose refine_piece(const Piece& piece, const SampledVolume& volume, Pose start = Pose::Identity());

struct Placing {
  PlacedPiece here;  ///< where the piece was, refined
  PlacedPiece best;  ///< may be the same
};

/// Where the piece fits the volume best: as it is, after one of the motions, or after a turn by up to `reach_rad` (at
/// most kLargestReachRad) about its centre, which then lies in the volume's. The best of them are refined,
/// Gauss-Newton.
///
/// @param centre of the volume's brightness, mm
/// @param margin what it must correlate better by to go elsewhere
Placing place_piece(const Piece& piece, const SampledVolume& volume, const Eigen::Vector3d& centre,
                    const std::vector<Pose>& motions, double reach_rad, double margin);

/// Mean of what slices have seen, fading where that is next to nothing, with the gaps between few slices filled.
/// @param sums   see WeightedVolume, a cube
/// @param centre gets its centre of brightness, mm
SampledVolume faded_volume(const WeightedVolume& sums, double voxel_mm, Eigen::Vector3d* centre);

}  // namespace svort
