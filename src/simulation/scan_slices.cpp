#include "svort_ros/simulation/scan_slices.h"

#include <torch/types.h>

#include <cmath>
#include <stdexcept>

namespace svort {

std::vector<Slice> scan_slices(const SimulatedScan& scan, const ScanSlicesOptions& options) {
  if (scan.dropped.size() != scan.plan.acquired.size())
    throw std::invalid_argument("scan_slices: the scan was simulated prepared; its slices are not whole");
  const torch::Tensor images = (scan.input.slices * options.brightest).to(torch::kCPU).contiguous();
  const torch::Tensor masks = scan.masks.to(torch::kCPU, torch::kUInt8).contiguous();
  const std::int64_t rows = images.size(2), columns = images.size(3);
  std::vector<Slice> slices;
  for (std::size_t i = 0; i < scan.plan.acquired.size(); ++i) {
    const PlannedSlice& planned = scan.plan.acquired[i];
    Slice slice;
    slice.info.scan_id = options.scan_id;
    slice.info.stack = planned.stack;
    slice.info.index = planned.index;
    slice.info.slices_in_stack = planned.slices_in_stack;
    slice.info.stamp_ns = options.start_ns + static_cast<std::int64_t>(std::llround(planned.time_s * 1e9));
    slice.info.T_scanner_slice = planned.T_scanner_slice;
    slice.info.pixel_spacing.setConstant(scan.input.slice_resolution_mm);
    slice.info.thickness = scan.plan.thickness_mm;
    slice.info.columns = static_cast<int>(columns);
    slice.info.rows = static_cast<int>(rows);
    const std::int64_t first = static_cast<std::int64_t>(i) * rows * columns;
    const float* pixels = images.data_ptr<float>() + first;
    const std::uint8_t* mask = masks.data_ptr<std::uint8_t>() + first;
    slice.pixels.assign(pixels, pixels + rows * columns);
    slice.mask.assign(mask, mask + rows * columns);
    slices.push_back(std::move(slice));
  }
  return slices;
}

}  // namespace svort
