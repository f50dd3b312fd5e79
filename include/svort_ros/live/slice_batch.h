#pragma once

#include <vector>

#include "svort_ros/geometry/image_grid.h"
#include "svort_ros/live/incremental_estimator.h"
#include "svort_ros/reconstruction/volume_estimation.h"
#include "svort_ros/sequence/slice_sequence.h"

namespace svort {

/// Slices of one thickness as tensors, ready for the forward model.
struct SliceBatch {
  std::vector<std::size_t> members;  ///< positions in the sequence, ascending
  SliceObservations observations;    ///< intensity divided by the sequence's scale; masks: the brain; unit: voxels
};

/// The whole sequence, grouped by slice thickness (the PSF differs), thinnest first.
///
/// @param poses one per slice of the sequence, in its order
/// @param grid  cubic voxels; the poses' brain frame is the frame the grid lives in
std::vector<SliceBatch> make_slice_batches(const SliceSequence& sequence, const std::vector<SliceEstimate>& poses,
                                           const ImageGrid& grid);

}  // namespace svort
