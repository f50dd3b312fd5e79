#pragma once

#include <memory>
#include <string>
#include <vector>

#include "svort_ros/network/option_values.h"
#include "svort_ros/network/pose_network.h"

namespace svort {

/// A network together with what is needed to make it again.
struct NetworkInstance {
  std::string name;                     ///< of the registry
  OptionValues options;                 ///< all of them
  std::shared_ptr<PoseNetwork> module;  ///< float32, on the CPU unless moved
  /// It wants all stacks' transforms in one frame (NetworkInput::common_frame); false: each stack in its own.
  bool common_frame = true;
};

/// Names of all networks, e.g. "v1".
std::vector<std::string> network_names();

/// One sentence about a network. @throws std::invalid_argument naming the known networks
std::string describe_network(const std::string& name);

/// A network with random weights (of LibTorch's generator).
/// @param options those that differ from the network's defaults
/// @throws std::invalid_argument naming the network or the option
NetworkInstance make_network(const std::string& name, const OptionValues& options = {});

}  // namespace svort
