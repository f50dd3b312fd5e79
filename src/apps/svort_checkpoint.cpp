// Files of network weights: what is in one, which parameters a network has, and weights that have learnt nothing.

#include <torch/types.h>

#include <filesystem>
#include <iomanip>
#include <iostream>
#include <map>
#include <sstream>
#include <stdexcept>
#include <string>
#include <vector>

#include "svort_ros/network/checkpoint.h"
#include "svort_ros/network/deterministic_weights.h"
#include "svort_ros/network/join_networks.h"
#include "svort_ros/network/network_registry.h"

namespace {

constexpr const char* kUsage =
    "usage: svort_checkpoint info FILE\n"
    "       svort_checkpoint parameters NETWORK\n"
    "       svort_checkpoint untrained NETWORK FILE\n"
    "       svort_checkpoint join BASE PART=FILE... OUT\n"
    "  info        checks a file completely (hash, network, options, every parameter) and prints what it says\n"
    "  parameters  names and shapes of a network's parameters, as JSON\n"
    "  untrained   writes v1 or v2 with weights that follow from a rule: to test programs, not to register anything\n"
    "  join        writes a live network whose parts were trained apart (docs/training.md): BASE, but for the parts "
    "that\n"
    "              other files give; PART is first, shared or frame\n";

struct UsageError : std::runtime_error {
  using std::runtime_error::runtime_error;
};

void print_info(const std::string& file) {
  svort::Checkpoint checkpoint;
  const svort::NetworkInstance network = svort::load_network(file, &checkpoint);
  std::int64_t values = 0;
  std::size_t count = 0;
  for (const torch::Tensor& parameter : network.module->parameters()) {
    values += parameter.numel();
    ++count;
  }
  std::cout << "network: " << network.name << "\n"
            << "description: " << svort::describe_network(network.name) << "\n"
            << "parameters: " << count << " tensors, " << values << " values\n"
            << "sha256: " << checkpoint.sha256 << "\n";
  std::cout << "crc32: " << std::hex << std::setw(8) << std::setfill('0') << svort::parameter_checksum(*network.module)
            << std::dec << "\n";
  std::cout << "trained: "
            << (svort::is_untrained(checkpoint.provenance) ? "NO, these weights have learnt nothing" : "yes") << "\n";
  std::cout << "options:\n";
  for (const auto& [key, value] : network.options) std::cout << "  " << key << ": " << svort::to_string(value) << "\n";
  std::cout << "provenance:\n";
  for (const auto& [key, value] : checkpoint.provenance) std::cout << "  " << key << ": " << value << "\n";
}

void print_parameters(const std::string& name) {
  const svort::NetworkInstance network = svort::make_network(name);
  std::string text;
  for (const auto& entry : network.module->named_parameters()) {
    text += (text.empty() ? "[" : ",\n ") + ("[\"" + entry.key()) + "\", [";
    for (std::int64_t i = 0; i < entry.value().dim(); ++i)
      text += (i > 0 ? ", " : "") + std::to_string(entry.value().size(i));
    text += "]]";
  }
  std::cout << text << "]\n";
}

void write_untrained(const std::string& name, const std::string& file) {
  const svort::NetworkInstance network = svort::make_network(name);
  svort::fill_deterministically(*network.module);
  svort::save_network(file, network, {{"untrained", "weights follow from a rule and have learnt nothing"}});
}

/// @param arguments BASE PART=FILE... OUT
void join(const std::vector<std::string>& arguments) {
  std::map<std::string, std::filesystem::path> parts;
  for (std::size_t i = 1; i + 1 < arguments.size(); ++i) {
    const std::size_t equal = arguments[i].find('=');
    if (equal == std::string::npos) throw UsageError("'" + arguments[i] + "' is not PART=FILE");
    if (!parts.emplace(arguments[i].substr(0, equal), arguments[i].substr(equal + 1)).second)
      throw UsageError("'" + arguments[i] + "' gives a part a second time");
  }
  const std::string& file = arguments.back();
  const svort::JoinedNetwork joined = svort::join_live_networks(arguments.front(), parts);
  svort::save_network(file, joined.network, joined.provenance, svort::WeightPrecision::half);
}

void run(const std::vector<std::string>& arguments) {
  const std::string command = arguments.empty() ? "" : arguments[0];
  if (command == "info" && arguments.size() == 2)
    print_info(arguments[1]);
  else if (command == "parameters" && arguments.size() == 2)
    print_parameters(arguments[1]);
  else if (command == "untrained" && arguments.size() == 3)
    write_untrained(arguments[1], arguments[2]);
  else if (command == "join" && arguments.size() >= 4)
    join({arguments.begin() + 1, arguments.end()});
  else
    throw UsageError(command.empty() ? "a command is missing" : "'" + command + "' is unknown, or its arguments are");
}

}  // namespace

int main(int argc, char** argv) {
  const std::vector<std::string> arguments(argv + 1, argv + argc);
  if (arguments.size() == 1 && (arguments[0] == "--help" || arguments[0] == "-h")) {
    std::cout << kUsage;
    return 0;
  }
  try {
    run(arguments);
  } catch (const UsageError& error) {
    std::cerr << "svort_checkpoint: " << error.what() << "\n" << kUsage;
    return 2;
  } catch (const std::exception& error) {
    std::cerr << "svort_checkpoint: " << error.what() << "\n";
    return 2;
  }
  return 0;
}
