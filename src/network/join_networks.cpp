#include "svort_ros/network/join_networks.h"

#include <stdexcept>
#include <string>

namespace svort {
namespace {

Checkpoint read_live(const std::filesystem::path& file) {
  Checkpoint checkpoint = read_checkpoint(file);
  if (checkpoint.network != "live")
    throw std::runtime_error(file.string() + ": holds the network '" + checkpoint.network +
                             "'; only the live network has two parts that are trained apart");
  return checkpoint;
}

std::string origin(const Checkpoint& checkpoint, std::int64_t scans) {
  std::string text = "weights " + checkpoint.sha256 + ", after " + std::to_string(scans) + " scans";
  const auto seed = checkpoint.provenance.find("seed");
  if (seed != checkpoint.provenance.end()) text += ", seed " + seed->second;
  return text;
}

}  // namespace

JoinedNetwork join_live_networks(const std::filesystem::path& first, const std::filesystem::path& shared) {
  const Checkpoint of_first = read_live(first), of_shared = read_live(shared);
  JoinedNetwork joined;
  joined.network = network_from_checkpoint(of_first, first);
  const NetworkInstance other = network_from_checkpoint(of_shared, shared);
  for (const auto& [key, value] : joined.network.options) {
    const std::string mine = to_string(value), theirs = to_string(other.options.at(key));
    if (mine != theirs)
      throw std::runtime_error(shared.string() + ": option '" + key + "' is " + theirs + ", but " + mine + " in " +
                               first.string());
  }

  const torch::NoGradGuard no_grad;
  auto parameters = joined.network.module->named_parameters();
  for (const auto& entry : other.module->named_parameters())
    if (entry.key().rfind("shared_", 0) == 0) parameters[entry.key()].copy_(entry.value());

  const std::int64_t scans = scans_seen(of_first.provenance, first).value_or(0);
  const std::int64_t other_scans = scans_seen(of_shared.provenance, shared).value_or(0);
  const std::int64_t other_began = scans_seen(of_shared.provenance, shared, kProvenanceScansBefore).value_or(0);
  joined.provenance = of_first.provenance;
  joined.provenance[kProvenanceScans] = std::to_string(scans + other_scans - other_began);
  joined.provenance["first network"] = origin(of_first, scans);
  joined.provenance["shared network"] = origin(of_shared, other_scans);
  return joined;
}

}  // namespace svort
