#pragma once

#include <Eigen/Geometry>
#include <cmath>
#include <cstddef>
#include <map>
#include <utility>
#include <vector>

#include "registration/registration_fixture.h"
#include "svort_ros/live/live_pipeline.h"

namespace svort_test {

inline svort::PipelineOptions quick_options() {
  svort::PipelineOptions options;
  options.sequence.size_px = 48;
  options.sequence.resolution_mm = 2.;
  options.estimator.method = "registration";
  options.estimator.volume_resolution_mm = 2.;
  options.estimator.volume_size_mm = 96.;
  options.estimator.registration.finest_mm = 2.;
  options.estimator.final_volume.resolution_mm = 2.;
  return options;
}

/// The phantom's scan as a scanner would send it, in a scanner whose axes are not the head's.
struct MovingScan {
  std::vector<svort::Slice> slices;
  std::vector<svort::Pose> truth;  ///< T_head_slice
};

/// @param jump of the head before slice number `jump_at`
inline MovingScan moving_scan(int stacks = 3, std::size_t jump_at = 0,
                              const svort::Pose& jump = svort::Pose::Identity(), int slices_per_stack = 16) {
  SimulatedScanOptions options;
  options.slices = slices_per_stack;
  options.stacks = stacks;
  options.jump_at = jump_at;
  options.jump = jump;
  options.between_mm = 6.;
  const SimulatedScan simulated = simulated_scan(options);
  svort::Pose T_scanner_world = svort::Pose::Identity();
  T_scanner_world.linear() = Eigen::AngleAxisd(1.1, Eigen::Vector3d(1., 2., -1.).normalized()).toRotationMatrix();
  T_scanner_world.translation() = Eigen::Vector3d(20., -35., 60.);
  MovingScan scan;
  scan.truth = simulated.truth;
  std::map<int, int> next;
  for (std::size_t i = 0; i < simulated.truth.size(); ++i) {
    svort::Slice slice;
    slice.info.scan_id = "moving";
    slice.info.stack = simulated.input.stack[i];
    const int order = next[slice.info.stack]++;
    slice.info.index = svort::interleaved_order(options.slices, 2)[static_cast<std::size_t>(order)];
    slice.info.slices_in_stack = options.slices;
    slice.info.stamp_ns = std::llround((100. + simulated.input.time_s[i]) * 1e9);
    slice.info.T_scanner_slice = T_scanner_world * simulated.input.T_world_slice[i];
    slice.info.pixel_spacing = {2., 2.};
    slice.info.thickness = 3.;
    slice.info.columns = slice.info.rows = 64;
    const auto row = static_cast<std::int64_t>(i);
    const float* pixels = simulated.input.slices[row].data_ptr<float>();
    slice.pixels.assign(pixels, pixels + 64 * 64);
    for (float& value : slice.pixels) value *= 800.F;
    const bool* mask = simulated.input.masks[row].data_ptr<bool>();
    for (int k = 0; k < 64 * 64; ++k) slice.mask.push_back(mask[k] ? 1 : 0);
    scan.slices.push_back(std::move(slice));
  }
  return scan;
}

}  // namespace svort_test
