#pragma once

#include <cstddef>
#include <memory>
#include <string>

#include "ros/synthetic_scan.h"
#include "svort_ros/live/live_pipeline.h"

namespace svort_test {

/// Quick: coarse, and without registration.
inline svort::PipelineOptions small_pipeline() {
  svort::PipelineOptions options;
  options.estimator.method = "nominal";
  options.sequence.size_px = 32;
  options.sequence.resolution_mm = 3.;
  options.estimator.volume_resolution_mm = 4.;
  options.estimator.volume_size_mm = 96.;
  options.estimator.final_volume.resolution_mm = 4.;
  return options;
}

/// The phantom's scan, its first `slices` slices (24 at most).
inline std::unique_ptr<svort::LivePipeline> pipeline_with(const std::string& scan_id, std::size_t slices = 3,
                                                          const svort::PipelineOptions& options = small_pipeline()) {
  auto pipeline = std::make_unique<svort::LivePipeline>(options);
  SyntheticScanOptions scan;
  scan.scan_id = scan_id;
  scan.pixels = 24;
  scan.pixel_mm = 4.;
  for (const svort::Slice& slice : synthetic_scan(scan)) {
    if (pipeline->sequence().slices().size() == slices) break;
    pipeline->add(slice);
  }
  return pipeline;
}

}  // namespace svort_test
