#pragma once

#include "svort_ros/evaluation/accuracy.h"

namespace svort_test {

/// A phantom brain of 60 mm, which scans and registers quickly.
inline svort::BrainVolume small_brain() {
  svort::PhantomOptions options;
  options.length_mm = 60.;
  svort::BrainVolume brain = svort::make_phantom(options);
  brain.name = "phantom";
  return brain;
}

/// Settings for it: pixels and voxels of 2 mm, one pass for the final volume.
inline svort::AccuracySetup quick_setup() {
  svort::AccuracySetup setup;
  svort::EstimatorOptions& estimator = setup.pipeline.estimator;
  setup.pipeline.sequence.size_px = 64;
  setup.pipeline.sequence.resolution_mm = 2.;
  estimator.registration.finest_mm = 2.;
  estimator.volume_resolution_mm = estimator.final_volume.resolution_mm = 2.;
  estimator.final_volume.passes = 1;
  return setup;
}

}  // namespace svort_test
