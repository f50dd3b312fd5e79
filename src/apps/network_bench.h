#pragma once

#include <string>
#include <vector>

namespace svort {

/// Lines of the usage text.
extern const char* const kNetworkBenchUsage;

/// `svort_bench network`: times each stage of the pose networks, one JSON object per line.
/// @param arguments those after "network"
/// @throws std::invalid_argument if they are wrong
void run_network_bench(const std::vector<std::string>& arguments);

}  // namespace svort
