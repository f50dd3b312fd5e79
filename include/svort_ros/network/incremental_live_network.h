#pragma once

#include <torch/types.h>

#include <cstddef>
#include <memory>
#include <optional>
#include <vector>

#include "svort_ros/geometry/pose.h"
#include "svort_ros/network/live_network.h"
#include "svort_ros/network/network_cache_options.h"

namespace svort {

/// What the network says about one slice, in the frame of the volume. Nothing where its points span no plane.
struct NetworkPlaces {
  std::optional<Pose> from_first;  ///< from where the first network alone, seeing this slice's image, puts it
  std::optional<Pose> from_start;  ///< from where it was thought to be; nothing without the shared network (K = 1)
};

/// LiveNetwork for a scan that grows, and whose other slices have poses already: it asks where the newest slice is.
///
/// Features for the first network are computed once per slice. The shared network's features, which see the volume at
/// the slice's place, are computed again for slices that moved, those that moved most first, and, in turns, for slices
/// whose view of the volume has changed; so the work of encoding per arrival is bounded. Both Transformers run over all
/// slices: that part grows with their number.
///
/// Runs on the CPU, without gradients. Slices that have no features yet for the shared network take no part in it. The
/// same calls give the same bytes. Not thread-safe: one owner.
class IncrementalLiveNetwork {
 public:
  /// @param iterations K: the first network, and K - 1 times the shared one; 0: as many as the network was made for
  /// @throws std::invalid_argument naming the option that is out of range
  IncrementalLiveNetwork(std::shared_ptr<LiveNetwork> network, const NetworkCacheOptions& options,
                         AcquisitionFormulation formulation, int iterations = 0);

  /// Takes in a slice and encodes it for the first network.
  /// @param position its place in acquisition order, 0 .. count()
  /// @param pixels   h x w, float32; any unit, 0 off the brain
  /// @throws std::invalid_argument if the slice cannot be brought to the network's input size
  void insert(std::size_t position, const torch::Tensor& pixels, double resolution_mm, double thickness_mm);

  /// Brings features for the shared network up to date, `refreshed` slices at most.
  /// @param newest left out: it has no pose that it should be encoded at
  /// @param T_volume_slice one per slice, mm; the volume is centred on its frame's origin
  /// @param volume d x d x d, float32, in the slices' unit
  void refresh(std::size_t newest, const std::vector<Pose>& T_volume_slice, const torch::Tensor& volume,
               double voxel_mm);

  /// Where the newest slice is, as both networks see it among the others.
  /// @param nominal all slices as prescribed, in a common frame; `slices` is not used
  /// @param T_volume_slice as for refresh(); at `newest`, where to start
  NetworkPlaces place(std::size_t newest, const NetworkInput& nominal, const std::vector<Pose>& T_volume_slice,
                      const torch::Tensor& volume, double voxel_mm);

  /// All slices and the volume have moved: features stay as they are.
  void move_frame(const Pose& T_new_old);

  std::size_t count() const { return kept_.size(); }
  /// Times that a slice was encoded, by either network, since the last call.
  std::size_t take_encoded();

 private:
  struct Kept {
    torch::Tensor reduced;  ///< 1 x 1 x p x p
    double thickness_mm = 3.;
    torch::Tensor first, placed;             ///< features, 1 x dim; `placed` is undefined until the first refresh()
    torch::Tensor view;                      ///< what `placed` was encoded with, 1 x kLiveSimulatedChannels x p x p
    Pose T_volume_slice = Pose::Identity();  ///< where
  };

  torch::Tensor views(const std::vector<std::size_t>& slices, const std::vector<Pose>& T_volume_slice,
                      const torch::Tensor& volume, double voxel_mm) const;

  std::shared_ptr<LiveNetwork> network_;
  NetworkCacheOptions options_;
  AcquisitionFormulation formulation_;
  int iterations_;
  std::vector<Kept> kept_;
  std::size_t turn_ = 0;  ///< the next slice to be looked at although it has not moved
  std::size_t encoded_ = 0;
};

}  // namespace svort
