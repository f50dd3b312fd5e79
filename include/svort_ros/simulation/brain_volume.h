#pragma once

#include <torch/types.h>

#include <cstdint>
#include <filesystem>
#include <string>
#include <vector>

#include "svort_ros/simulation/scanner.h"

namespace svort {

/// A brain to simulate scans of, in the canonical frame: axes along LPS, origin at the centre of the array.
struct BrainVolume {
  std::string name;
  torch::Tensor image;        ///< D x H x W, float32, any unit, not negative
  torch::Tensor mask;         ///< D x H x W, bool: the brain
  torch::Tensor labels;       ///< D x H x W, uint8: tissue classes, 0 = none; undefined if there is no parcellation
  double resolution_mm = 1.;  ///< voxel size
};

/// @throws std::invalid_argument naming the volume and what does not fit (shape, type, values, a mask without brain,
///         more than 32 classes)
void check(const BrainVolume& volume);

/// Box around the mask, mm.
BrainExtent brain_extent(const BrainVolume& volume);

/// Several volumes in one file, for machines that have no NIfTI library: a dict of tensors that torch.load() reads too.
/// @throws std::runtime_error naming the file and the reason
void save_brain_volumes(const std::filesystem::path& path, const std::vector<BrainVolume>& volumes);
/// @throws std::runtime_error naming the file and what is wrong with it
std::vector<BrainVolume> load_brain_volumes(const std::filesystem::path& path);

/// Shape of the built-in phantom.
struct PhantomOptions {
  double length_mm = 80.;     ///< front to back; width and height follow
  double resolution_mm = 1.;  ///< voxel size
  double fold_mm = 2.5;       ///< depth of the folds of the cortex; 0 is a smooth brain, as before 24 weeks
  std::uint64_t seed = 1;     ///< individual folds and proportions

  template <class Visitor>
  void visit(Visitor&& v) {
    v("length_mm", length_mm, "front to back, mm");
    v("resolution_mm", resolution_mm, "voxel size, mm");
    v("fold_mm", fold_mm, "depth of the folds of the cortex, mm");
    v("seed", seed, "individual folds and proportions");
  }
};

/// A brain made of formulas, with tissue classes: hemispheres with a folded cortex and a fissure between them,
/// ventricles, deep grey matter, cerebellum and brainstem, in a layer of fluid, with T2-like contrast. Left and right
/// differ (ventricle size, a fold), so that a mirrored pose is a wrong pose. For tests, and for users without data.
/// @throws std::invalid_argument naming the option that is out of range
BrainVolume make_phantom(const PhantomOptions& options);

/// Tissue classes of the phantom, and of parcellations that are translated into them.
enum class Tissue : std::uint8_t {
  none = 0,
  fluid = 1,  ///< around the brain and in its ventricles
  cortex = 2,
  white = 3,  ///< white matter and its precursors
  deep_grey = 4,
  cerebellum = 5,
  brainstem = 6,
};

}  // namespace svort
