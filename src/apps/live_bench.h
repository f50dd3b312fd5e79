#pragma once

#include <string>
#include <vector>

namespace svort {

/// Lines of the usage text.
extern const char* const kLiveBenchUsage;

/// `svort_bench live`: times the live pipeline slice by slice, one JSON object per line.
/// @param arguments those after "live"
/// @throws std::invalid_argument if they are wrong
void run_live_bench(const std::vector<std::string>& arguments);

}  // namespace svort
