#pragma once

#include <string>
#include <vector>

namespace svort {

/// Lines of the usage text.
extern const char* const kMemoryBenchUsage;

/// `svort_bench memory`: resident memory of pipeline and decisions over thousands of slices, one JSON object per line.
/// @param arguments those after "memory"
/// @throws std::invalid_argument if they are wrong
/// @throws std::runtime_error if memory has grown by more than the limit
void run_memory_bench(const std::vector<std::string>& arguments);

}  // namespace svort
