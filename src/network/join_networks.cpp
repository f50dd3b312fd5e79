#include "svort_ros/network/join_networks.h"

#include <algorithm>
#include <iterator>
#include <stdexcept>

namespace svort {
namespace {

constexpr const char* kParts[] = {"first", "shared", "frame"};

bool belongs_to(const std::string& name, const std::string& part) { return name.rfind(part + "_", 0) == 0; }

Checkpoint read_live(const std::filesystem::path& file) {
  Checkpoint checkpoint = read_checkpoint(file);
  if (checkpoint.network != "live")
    throw std::runtime_error(file.string() + ": holds the network '" + checkpoint.network +
                             "'; only the live network has parts that are trained apart");
  return checkpoint;
}

std::int64_t scans_of(const Checkpoint& checkpoint, const std::filesystem::path& file, const char* key) {
  return scans_seen(checkpoint.provenance, file, key).value_or(0);
}

std::string origin(const Checkpoint& checkpoint, const std::filesystem::path& file) {
  std::string text = "weights " + checkpoint.sha256 + ", after " +
                     std::to_string(scans_of(checkpoint, file, kProvenanceScans)) + " scans";
  const auto seed = checkpoint.provenance.find("seed");
  if (seed != checkpoint.provenance.end()) text += ", seed " + seed->second;
  return text;
}

bool has_part(const Checkpoint& checkpoint, const std::string& part) {
  return std::any_of(checkpoint.parameters.begin(), checkpoint.parameters.end(),
                     [&part](const auto& entry) { return belongs_to(entry.first, part); });
}

/// An option of a part that is not asked for, which the file may lack.
bool of_other_part(const std::string& option, const std::string& asked) {
  return std::any_of(std::begin(kParts), std::end(kParts),
                     [&](const char* part) { return part != asked && belongs_to(option, part); });
}

}  // namespace

JoinedNetwork join_live_networks(const std::filesystem::path& base,
                                 const std::map<std::string, std::filesystem::path>& parts) {
  for (const auto& [part, file] : parts) {
    if (std::find(std::begin(kParts), std::end(kParts), part) == std::end(kParts))
      throw std::invalid_argument("the live network has no part '" + part + "'; its parts are first, shared and frame");
  }
  Checkpoint joined = read_live(base);
  // Defaults stand beside what the file says, so that two files can be compared.
  joined.options = network_from_checkpoint(joined, base).options;
  const std::string of_base = origin(joined, base);
  std::int64_t scans = scans_of(joined, base, kProvenanceScans);
  for (const char* part : kParts) {
    const std::string key = std::string(part) + " network";
    const auto given = parts.find(part);
    if (given == parts.end()) {
      // What was joined before says where it comes from.
      if (has_part(joined, part)) joined.provenance.emplace(key, of_base);
      continue;
    }
    const std::filesystem::path& file = given->second;
    Checkpoint other = read_live(file);
    const OptionValues options = network_from_checkpoint(other, file).options;
    if (!has_part(other, part)) throw std::runtime_error(file.string() + ": has no " + part + " network");
    for (auto& [name, value] : joined.options) {
      const std::string mine = to_string(value), theirs = to_string(options.at(name));
      if (belongs_to(name, part))
        value = options.at(name);
      else if (mine != theirs && !of_other_part(name, part))
        throw std::runtime_error(file.string() + ": option '" + name + "' is " + theirs + ", but " + mine + " in " +
                                 base.string());
    }
    for (auto entry = joined.parameters.begin(); entry != joined.parameters.end();)
      entry = belongs_to(entry->first, part) ? joined.parameters.erase(entry) : std::next(entry);
    for (const auto& entry : other.parameters)
      if (belongs_to(entry.first, part)) joined.parameters.insert(entry);
    scans += scans_of(other, file, kProvenanceScans) - scans_of(other, file, kProvenanceScansBefore);
    joined.provenance[key] = origin(other, file);
  }
  joined.provenance[kProvenanceScans] = std::to_string(scans);
  return {network_from_checkpoint(joined, base), joined.provenance};
}

}  // namespace svort
