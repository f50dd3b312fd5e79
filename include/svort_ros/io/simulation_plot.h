#pragma once

#include <filesystem>
#include <string>

#include "svort_ros/simulation/scan_simulator.h"

namespace svort {

/// PNG of a simulated scan: slices in acquisition order with their flags, and the head's rotation and translation
/// (T_scanner_brain against the first slice) over time. @throws std::runtime_error naming the file
void plot_simulated_scan(const std::filesystem::path& path, const SimulatedScan& scan, const std::string& title);

}  // namespace svort
