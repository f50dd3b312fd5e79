#pragma once

#include <torch/types.h>

#include <cstdint>
#include <vector>

#include "svort_ros/network/pose_network.h"
#include "svort_ros/simulation/brain_volume.h"

namespace svort {

/// Variation of the given brains beyond the few that there are.
struct AnatomyOptions {
  double scale_min = 0.9;           ///< size, against the given volume
  double scale_max = 1.1;           ///< size
  double aspect = 0.04;             ///< standard deviation of each axis's own scale
  double elastic_mm = 2.5;          ///< root mean square displacement of the smooth deformation, per axis
  double elastic_spacing_mm = 30.;  ///< distance of the deformation's control points
  double contrast = 0.12;           ///< standard deviation of each tissue's own factor; needs labels
  double rim_share = 0.;            ///< share of brains whose mask reaches into the skull and the scalp
  double rim_mm = 8.;               ///< such a rim's largest mean thickness

  template <class Visitor>
  void visit(Visitor&& v) {
    v("scale_min", scale_min, "smallest size, against the given volume");
    v("scale_max", scale_max, "largest size");
    v("aspect", aspect, "standard deviation of each axis's own scale");
    v("elastic_mm", elastic_mm, "root mean square displacement of the smooth deformation, per axis, mm");
    v("elastic_spacing_mm", elastic_spacing_mm, "distance of the deformation's control points, mm");
    v("contrast", contrast, "standard deviation of each tissue's own factor (volumes with labels)");
    v("rim_share", rim_share, "share of brains whose mask reaches into the skull and the scalp");
    v("rim_mm", rim_mm, "such a rim's largest mean thickness, mm");
  }
};

/// No variation: the given volume on another grid.
AnatomyOptions no_anatomy_variation();

/// One brain on the simulator's grid.
struct Anatomy {
  torch::Tensor image;  ///< D x H x W, float32, 0 off the mask, 1 at the 0.99 quantile of the given volume's brain
  torch::Tensor mask;   ///< D x H x W, bool: the brain, and its rim if it has one
  BrainExtent extent;   ///< of the mask
};

/// Makes anatomies from given brains, on one device.
class AnatomySource {
 public:
  /// Low-passes the volumes to the grid's voxel size, once.
  /// @throws std::invalid_argument naming the volume or the option that does not fit
  AnatomySource(const std::vector<BrainVolume>& volumes, const NetworkGrid& grid, const AnatomyOptions& options,
                torch::Device device);

  /// Anatomy `number`: always the same for the same seed. Volumes take turns.
  Anatomy make(std::uint64_t seed, std::uint64_t number) const;

  std::size_t volume_count() const { return sources_.size(); }
  /// Which of the volumes anatomy `number` comes from.
  std::size_t volume_of(std::uint64_t number) const { return static_cast<std::size_t>(number % sources_.size()); }

 private:
  struct Source {
    torch::Tensor channels;  ///< (mask, then one per tissue class) x d x h x w
    double resolution_mm = 1.;
    BrainExtent extent;
  };
  NetworkGrid grid_;
  AnatomyOptions options_;
  torch::Device device_;
  std::vector<Source> sources_;
};

}  // namespace svort
