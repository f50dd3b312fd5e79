#pragma once

#include <cstdint>
#include <string>
#include <vector>

#include "svort_ros/acquisition/slice.h"
#include "svort_ros/simulation/scan_simulator.h"

namespace svort {

/// How a simulated scan is handed out.
struct ScanSlicesOptions {
  std::string scan_id = "simulated";
  std::int64_t start_ns = 1000000000;  ///< stamp of the time 0 of the scan
  double brightest = 1000.;            ///< intensity of what is 1 in the scan
};

/// The slices of a scan as a scanner hands them out, in acquisition order: whole slices with masks, those that never
/// arrive (SimulatedScan::dropped) included. @throws std::invalid_argument if the scan was simulated prepared
std::vector<Slice> scan_slices(const SimulatedScan& scan, const ScanSlicesOptions& options = {});

}  // namespace svort
