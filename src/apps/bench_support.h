#pragma once

#include <cstdint>
#include <string>
#include <vector>

namespace svort {

// What the benchmarks share.

/// The parts of a list that is separated by commas.
std::vector<std::string> list_items(const std::string& text);

/// @param name of the option, for messages
/// @throws std::invalid_argument unless `text` is a list of integers from 1 to `largest`
std::vector<std::int64_t> positive_integers(const std::string& name, const std::string& text, std::int64_t largest);

/// Model name of the processor.
std::string processor();

/// Resident memory of this process, now and at its largest, in MB.
double resident_memory_mb();
double peak_memory_mb();

}  // namespace svort
