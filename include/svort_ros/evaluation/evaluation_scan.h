#pragma once

#include <torch/types.h>

#include <cstdint>
#include <string>
#include <vector>

#include "svort_ros/acquisition/slice.h"
#include "svort_ros/geometry/pose.h"
#include "svort_ros/simulation/brain_volume.h"

namespace svort {

/// Which scan to simulate.
struct EvaluationScanOptions {
  std::string motion = "moderate";  ///< class, see motion_classes()
  /// See ScannerOptions::protocol. Slices carry the poses that the scanner prescribed in either case.
  std::string protocol = "scanner";
  int stacks = 3;  ///< the first so many of the three stacks of the same scan
  /// Masks as a segmentation that often fails makes them: 15 % of the slices have none, 25 % are cut, 20 % too small.
  bool damaged_masks = false;
  std::uint64_t seed = 1;
  std::uint64_t number = 0;  ///< same seed, another scan
};

/// A simulated scan as the live system receives it, and the truth.
struct EvaluationScan {
  std::string brain;
  EvaluationScanOptions options;
  std::vector<Slice> slices;  ///< in acquisition order, those that never arrive left out; 128 x 128 pixels of 1 mm
  std::vector<Pose> truth;    ///< T_brain_slice of each, mm
  torch::Tensor volume;       ///< D x H x W, the brain in the slices' contrast
  double voxel_mm = 0.8;      ///< of the volume
};

/// Three stacks of the brain as it is given, with the artifacts of docs/simulation.md.
/// @throws std::invalid_argument naming the option or volume that does not fit
EvaluationScan simulate_evaluation_scan(const BrainVolume& brain, const EvaluationScanOptions& options);

}  // namespace svort
