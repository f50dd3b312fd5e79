#pragma once

// A scan of an ellipsoid whose coverage can be told by hand.

#include <Eigen/Geometry>
#include <cmath>
#include <cstdint>
#include <string>
#include <vector>

#include "svort_ros/acquisition/slice.h"
#include "svort_ros/decision/decision_engine.h"
#include "svort_ros/live/live_pipeline.h"

namespace svort_test {

constexpr double kTrS = 1.5;
constexpr double kThicknessMm = 4.;
const Eigen::Vector3d kRadii(32., 28., 26.);  // of the ellipsoid, mm

/// Slice axes: 0 transverse, 1 coronal, 2 sagittal.
inline Eigen::Matrix3d stack_axes(int plane) {
  Eigen::Matrix3d axes;
  if (plane == 0) axes << 1, 0, 0, 0, 1, 0, 0, 0, 1;
  if (plane == 1) axes << 1, 0, 0, 0, 0, 1, 0, -1, 0;
  if (plane == 2) axes << 0, 0, 1, 1, 0, 0, 0, 1, 0;
  return axes;
}

struct ScanSlice {
  int stack = 0;
  int plane = 0;
  int index = 0;
  int slices = 16;
  double time_s = 0.;
  double gain = 1.;                                       ///< of the whole slice
  double hole_mm = 0.;                                    ///< radius of a dark spot in the middle of the slice
  double noise = 0.;                                      ///< deviation, of about 800
  svort::Pose T_scanner_brain = svort::Pose::Identity();  ///< where the ellipsoid is
};

inline svort::Slice make_slice(const ScanSlice& what) {
  constexpr int kSize = 48;
  constexpr double kPixel = 2.;
  svort::Slice slice;
  svort::SliceInfo& info = slice.info;
  info.scan_id = "ellipsoid";
  info.stack = what.stack;
  info.index = what.index;
  info.slices_in_stack = what.slices;
  info.stamp_ns = 1000000000 + std::llround(1e9 * what.time_s);
  info.pixel_spacing = {kPixel, kPixel};
  info.thickness = kThicknessMm;
  info.columns = info.rows = kSize;
  info.T_scanner_slice.linear() = stack_axes(what.plane);
  info.T_scanner_slice.translation() =
      stack_axes(what.plane).col(2) * kThicknessMm * (what.index - 0.5 * (what.slices - 1));
  const svort::Pose T_brain_slice = what.T_scanner_brain.inverse() * info.T_scanner_slice;
  std::uint32_t state = 1 + static_cast<std::uint32_t>(what.stack * 100 + what.index);
  for (int row = 0; row < kSize; ++row)
    for (int column = 0; column < kSize; ++column) {
      const Eigen::Vector3d in_slice((column - 23.5) * kPixel, (row - 23.5) * kPixel, 0.);
      const Eigen::Vector3d p = T_brain_slice * in_slice;
      const bool brain = p.cwiseQuotient(kRadii).squaredNorm() < 1.;
      double value =
          brain ? what.gain * (800. + 150. * std::sin(0.2 * p.x()) * std::cos(0.15 * p.y() + 0.1 * p.z())) : 0.;
      if (in_slice.norm() < what.hole_mm) value *= 0.1;
      state = state * 1664525U + 1013904223U;  // a fixed pattern, the same on every machine
      if (brain) value = std::abs(value + what.noise * 3.46 * (static_cast<double>(state >> 8) / 16777216. - 0.5));
      slice.pixels.push_back(static_cast<float>(value));
      slice.mask.push_back(brain ? 1 : 0);
    }
  return slice;
}

/// A whole stack, interleaved by 2, from `begin_s` on.
inline std::vector<ScanSlice> whole_stack(int stack, int plane, double begin_s, int slices = 16) {
  std::vector<ScanSlice> result;
  for (const int index : svort::interleaved_order(slices, 2)) {
    ScanSlice slice;
    slice.stack = stack;
    slice.plane = plane;
    slice.index = index;
    slice.slices = slices;
    slice.time_s = begin_s + kTrS * static_cast<double>(result.size());
    result.push_back(slice);
  }
  return result;
}

inline svort::PipelineOptions quick_pipeline() {
  svort::PipelineOptions options;
  options.sequence.size_px = 64;
  options.sequence.resolution_mm = 2.;
  options.estimator.method = "nominal";
  options.estimator.volume_resolution_mm = 2.;
  options.estimator.volume_size_mm = 96.;
  return options;
}

/// Coefficients of these tests' own, so that they do not depend on the calibration.
inline svort::SliceQualityOptions plain_quality() {
  svort::SliceQualityOptions options;
  options.intercept = 2.;
  options.weight = 1.;
  options.similarity = 0.5;
  options.void_volume = options.void_image = -6.;
  options.dark_volume = options.dark_image = -4.;
  options.noise = -2.;
  options.jump = -0.5;
  options.image_intercept = 3.;
  options.image_void = -6.;
  options.image_dark = -5.;
  options.image_noise = -2.5;
  return options;
}

/// What node and replay do with every slice.
inline void feed(const svort::Slice& slice, svort::LivePipeline* pipeline, svort::DecisionEngine* engine) {
  const svort::Arrival arrival = pipeline->add(slice);
  svort::JournalEntry entry;
  entry.info = slice.info;
  entry.status = arrival.status;
  pipeline->journal().add(entry);
  pipeline->update_volume();
  engine->update(*pipeline);
}

}  // namespace svort_test
