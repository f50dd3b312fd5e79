#pragma once

#include <torch/types.h>

#include <cstdint>
#include <filesystem>
#include <map>
#include <optional>
#include <string>

#include "svort_ros/network/network_registry.h"

namespace svort {

/// How the weights are stored.
enum class WeightPrecision {
  single,  ///< float32
  half,    ///< float16: half the size; the network computes in float32 all the same
};

/// What else a checkpoint says: training data, steps, date, licence, .. as text. Key "untrained": see is_untrained().
using Provenance = std::map<std::string, std::string>;

/// The content of a checkpoint file.
///
/// The file is what torch::pickle_save writes, a zip archive that holds one dictionary with the keys `format`
/// ("svort_ros checkpoint"), `version` (1), `network`, `options` (dictionary; defaults hold for what is not in it),
/// `parameters` (dictionary of tensors, buffers included; float32 or float16), `provenance` (dictionary of text) and
/// `sha256` (of the parameters, see parameter_sha256()). torch.load of Python reads it too.
struct Checkpoint {
  std::string network;
  OptionValues options;
  std::map<std::string, torch::Tensor> parameters;
  Provenance provenance;
  std::string sha256;
};

/// SHA-256 over all parameters in alphabetical order: name, type and shape ("float32 64x3x7x7") each followed by a zero
/// byte, then the values, little-endian. @return 64 hexadecimal digits
std::string parameter_sha256(const std::map<std::string, torch::Tensor>& parameters);

/// Writes a file that load_network() reads; an existing one is replaced only when the new one is complete.
/// @throws std::runtime_error naming the file if it cannot be written
void save_network(const std::filesystem::path& file, const NetworkInstance& network, const Provenance& provenance,
                  WeightPrecision precision = WeightPrecision::single);

/// Reads a file, without making the network.
/// @throws std::runtime_error naming the file and what is wrong: unreadable, truncated, not a checkpoint, another
///         version, a key that is missing or unknown or of the wrong type, a hash that differs
Checkpoint read_checkpoint(const std::filesystem::path& file);

/// Makes the network and fills it.
/// @param file for messages
/// @throws std::runtime_error naming the file and the unknown network, the option, or the parameters that are missing,
///         too many, of another shape or not finite
NetworkInstance network_from_checkpoint(const Checkpoint& checkpoint, const std::filesystem::path& file);

/// Both in one. @param checkpoint if not null, receives the rest of the file, without the parameters
NetworkInstance load_network(const std::filesystem::path& file, Checkpoint* checkpoint = nullptr);

/// True if the checkpoint says that its weights have learnt nothing: provenance "untrained" is there.
bool is_untrained(const Provenance& provenance);

constexpr const char* kProvenanceScans = "scans";               ///< seen in training, all in all
constexpr const char* kProvenanceScansBefore = "scans before";  ///< seen by the weights that training started from

/// Scans that weights have seen in training, as the provenance says under `key`; nothing if it does not say.
/// @throws std::runtime_error naming the file if what it says is no number
std::optional<std::int64_t> scans_seen(const Provenance& provenance, const std::filesystem::path& file,
                                       const char* key = kProvenanceScans);

}  // namespace svort
