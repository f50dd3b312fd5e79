#include "svort_ros/network/network_registry.h"

#include <sstream>
#include <stdexcept>

#include "svort_ros/network/baselines.h"
#include "svort_ros/network/live_network.h"
#include "svort_ros/network/svort.h"

namespace svort {
namespace {

struct Entry {
  const char* name;
  const char* description;
  bool common_frame;  ///< see NetworkInstance
  NetworkInstance (*make)(const std::string& name, const OptionValues& options);
};

/// Network is constructible from Options; defaults() are the options of the registered name.
template <class Network, class Options, Options (*defaults)()>
NetworkInstance make(const std::string& name, const OptionValues& values) {
  Options options = defaults();
  try {
    assign_options(values, &options);
    return {name, option_values(options), std::make_shared<Network>(options), true};
  } catch (const std::invalid_argument& error) {
    throw std::invalid_argument("network " + name + ": " + error.what());
  }
}

LiveNetworkOptions live_options() { return {}; }
BaselineOptions baseline_options() { return {}; }

// Every network that a checkpoint may name. To add one: its name, a sentence, whether its stacks share
// a frame, its class, options and their defaults.
constexpr Entry kNetworks[] = {
    {"v1", "SVoRT version 1, of the paper: a network for each iteration, and one for the slices' quality", false,
     &make<SvortV1, SvortOptions, &svort_v1_options>},
    {"v2", "SVoRT version 2: one network without a volume, and one with a volume for all later iterations", false,
     &make<SvortV2, SvortOptions, &svort_v2_options>},
    {"live", "the network for live use: each slice is encoded once, and any part of a scan has an answer", true,
     &make<LiveNetwork, LiveNetworkOptions, &live_options>},
    {"svrnet", "baseline of the paper: a VGG network that sees each slice alone", false,
     &make<SvrNet, BaselineOptions, &baseline_options>},
    {"planeinvol", "baseline of the paper: a network whose attention pools over the set of slices", false,
     &make<PlaneInVol, BaselineOptions, &baseline_options>},
};

const Entry& find(const std::string& name) {
  std::string known;
  for (const Entry& entry : kNetworks) {
    if (name == entry.name) return entry;
    known += (known.empty() ? "" : ", ") + std::string(entry.name);
  }
  throw std::invalid_argument("there is no network '" + name + "'; known: " + known);
}

}  // namespace

std::string to_string(const OptionValue& value) {
  std::ostringstream text;
  text << std::boolalpha;
  std::visit([&text](const auto& held) { text << held; }, value);
  return text.str();
}

std::vector<std::string> network_names() {
  std::vector<std::string> names;
  for (const Entry& entry : kNetworks) names.emplace_back(entry.name);
  return names;
}

std::string describe_network(const std::string& name) { return find(name).description; }

NetworkInstance make_network(const std::string& name, const OptionValues& options) {
  const Entry& entry = find(name);
  NetworkInstance network = entry.make(name, options);
  network.common_frame = entry.common_frame;
  return network;
}

}  // namespace svort
