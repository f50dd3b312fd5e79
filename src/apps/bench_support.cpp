#include "bench_support.h"

#include <fstream>
#include <sstream>
#include <stdexcept>

namespace svort {
namespace {

double memory_mb(const std::string& key) {
  std::ifstream status("/proc/self/status");
  for (std::string line; std::getline(status, line);) {
    if (line.rfind(key, 0) == 0) return std::stod(line.substr(key.size())) / 1024.;
  }
  throw std::runtime_error("/proc/self/status has no line " + key);
}

}  // namespace

std::vector<std::string> list_items(const std::string& text) {
  std::vector<std::string> list;
  std::istringstream stream(text);
  for (std::string item; std::getline(stream, item, ',');) list.push_back(item);
  return list;
}

std::vector<std::int64_t> positive_integers(const std::string& name, const std::string& text, std::int64_t largest) {
  std::vector<std::int64_t> values;
  for (const std::string& item : list_items(text)) {
    std::istringstream stream(item);
    std::int64_t value = 0;
    if (!(stream >> value) || !stream.eof() || value < 1 || value > largest)
      throw std::invalid_argument(name + " takes integers from 1 to " + std::to_string(largest) + ", got '" + text +
                                  "'");
    values.push_back(value);
  }
  if (values.empty()) throw std::invalid_argument(name + " needs a value");
  return values;
}

std::string processor() {
  std::ifstream file("/proc/cpuinfo");
  for (std::string line; std::getline(file, line);) {
    const std::size_t colon = line.find(": ");
    if (line.rfind("model name", 0) == 0 && colon != std::string::npos) return line.substr(colon + 2);
  }
  return "unknown processor";
}

double resident_memory_mb() { return memory_mb("VmRSS:"); }

double peak_memory_mb() { return memory_mb("VmHWM:"); }

}  // namespace svort
