#pragma once

#include <vector>

#include "svort_ros/acquisition/slice_acquisition.h"
#include "svort_ros/geometry/image_grid.h"
#include "svort_ros/live/incremental_estimator.h"
#include "svort_ros/sequence/slice_sequence.h"

namespace svort {

// What all estimators do alike.

/// @throws std::invalid_argument naming the option if one that all estimators share is out of range
void validate(const EstimatorOptions& options);

/// The cube that EstimatorOptions ask for, centred on the brain frame.
ImageGrid volume_grid(const EstimatorOptions& options);

/// Estimate::agreement of poses.
/// @param slices one per slice of the sequence, in its order
double agreement_of(const SliceSequence& sequence, const std::vector<SliceEstimate>& slices);

/// Volume from the slices' current poses and weights; sets each slice's ncc.
///
/// @param slices        one per slice of the sequence, in its order; weights count in the volume
/// @param cg_iterations conjugate-gradient steps after the PSF reconstruction
/// @throws std::invalid_argument if the counts differ or are zero
Volume estimate_volume(const SliceSequence& sequence, const ImageGrid& grid, AcquisitionFormulation formulation,
                       int cg_iterations, std::vector<SliceEstimate>* slices);

/// The final volume (see reconstruct_final_volume()) from the slices' current poses and weights, on the cube that the
/// options ask for, at final_volume.resolution_mm; sets each slice's ncc.
/// @throws std::invalid_argument if the counts differ or are zero
Volume estimate_final_volume(const SliceSequence& sequence, const EstimatorOptions& options,
                             std::vector<SliceEstimate>* slices);

}  // namespace svort
