#pragma once

#include <filesystem>
#include <map>
#include <string>

#include "svort_ros/network/checkpoint.h"

namespace svort {

/// A live network whose parts were trained apart, each on a core of its own: they share no parameter, so each can come
/// from another file.
struct JoinedNetwork {
  NetworkInstance network;
  /// The base's, with the scans of all trainings added up (what they had started from counts once), and `first
  /// network`, `shared network` and `frame network`, which say where each part comes from.
  Provenance provenance;
};

/// @param base  the parts that no other file gives, and the options
/// @param parts files by the part that is taken from them: first, shared or frame. Options whose names begin with the
///              part's come from its file too, so that a part may be added that the base does not have.
/// @throws std::invalid_argument if a part's name is none of these
/// @throws std::runtime_error naming the file that cannot be read, that is no live network, that lacks its part, whose
///         network has other options than the base, or whose provenance gives a number of scans that is none
JoinedNetwork join_live_networks(const std::filesystem::path& base,
                                 const std::map<std::string, std::filesystem::path>& parts);

}  // namespace svort
