#pragma once

#include <torch/types.h>

#include <vector>

#include "svort_ros/acquisition/slice_acquisition.h"
#include "svort_ros/geometry/image_grid.h"
#include "svort_ros/live/incremental_estimator.h"
#include "svort_ros/sequence/slice_sequence.h"

namespace svort {

/// The whole sequence as tensors, ready for the forward model and the networks.
struct SliceBatch {
  torch::Tensor pixels;          ///< n x 1 x h x w, float32, intensity divided by the sequence's scale
  torch::Tensor weights;         ///< n, float32, the slices' estimated quality
  AcquisitionMasks masks;        ///< slice masks: the brain pixels
  AcquisitionGeometry geometry;  ///< slice crops -> voxels of the grid; one PSF per slice thickness
};

/// @param poses one per slice of the sequence, in its order
/// @param grid  cubic voxels; the poses' brain frame is the frame the grid lives in
/// @throws std::invalid_argument if the counts differ or are zero
SliceBatch make_slice_batch(const SliceSequence& sequence, const std::vector<SliceEstimate>& poses,
                            const ImageGrid& grid);

}  // namespace svort
