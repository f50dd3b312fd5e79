#pragma once

#include <atomic>
#include <cstddef>
#include <vector>

#include "piece_search.h"
#include "registration_level.h"
#include "sampled_volume.h"
#include "svort_ros/geometry/pose.h"
#include "weighted_volume.h"

namespace svort {

/// A scan cut into pieces: runs of slices that were acquired one after another, short enough for the head to have lain
/// nearly still. Interleaved acquisition spreads each over much of the brain, so that a piece can be found in the
/// volume of the others however far the head has jumped before it.
///
/// Outlines count (SliceContent::outline): blurred slices of few millimetres look alike inside the brain.
class ScanPieces {
 public:
  /// @param input            stays the caller's; must outlive this object
  /// @param slices_per_piece about; each stack is cut into equal runs
  ScanPieces(const RegistrationInput& input, int slices_per_piece, double pixel_mm, double blur_mm);

  /// How well the pieces fit each other: the correlation of each piece with the volume of all others, mean over pixels.
  /// A slice says nothing for itself or for its piece, so neither scattered slices nor a displaced piece look good.
  /// @return in [-1, 1]; -1 if there are fewer than two pieces with brain in them
  double agreement(const std::vector<Pose>& poses) const;

  /// Piece after piece, tries motions of the whole piece: where its neighbours in time are, and turns by up to 80
  /// degrees about the brain's centre; the best are refined, and the one that fits the volume of the others best is
  /// taken. Some sweeps over all pieces.
  /// @param stop if not null, once it is set no further piece is looked at
  /// @return one pose per slice
  std::vector<Pose> search(std::vector<Pose> poses, const std::atomic<bool>* stop = nullptr) const;

 private:
  struct Seen {
    WeightedVolume volume;
    double correlation = 1.;
  };
  /// Shifted so that the brain lies around the origin, where the volumes are.
  std::vector<Pose> centred(std::vector<Pose> poses) const;
  Seen see(std::size_t piece, const std::vector<Pose>& poses) const;
  /// The volume of all pieces but one, and its centre of brightness.
  SampledVolume others(const std::vector<Seen>& seen, std::size_t piece, Eigen::Vector3d* centre) const;
  Piece piece_of(const std::vector<std::size_t>& slices, const std::vector<Pose>& poses) const;
  /// How the head had moved at this slice, T_brain_scanner.
  Pose head(std::size_t slice, const std::vector<Pose>& poses) const;
  /// One motion for the whole piece.
  void place(std::size_t piece, std::vector<Seen>* seen, std::vector<Pose>* poses) const;
  /// The head may have jumped within the piece: slices that fit better where the piece before or after is go there.
  void share_out(std::size_t piece, std::vector<Seen>* seen, std::vector<Pose>* poses) const;

  const RegistrationInput& input_;
  RegistrationLevel level_;
  std::vector<std::vector<std::size_t>> pieces_;  ///< places in the scan; those without brain are left out
  int size_ = 0;                                  ///< of the volume, voxels
};

}  // namespace svort
