#pragma once

#include <filesystem>

#include "svort_ros/network/checkpoint.h"

namespace svort {

/// A live network whose two parts were trained apart, each on a core of its own: they share no parameter, so the first
/// network's come from one file and the shared network's from the other.
struct JoinedNetwork {
  NetworkInstance network;
  /// The first file's, with the scans of both trainings added up (what they had started from counts once), and
  /// `first network` and `shared network`, which say where each part comes from.
  Provenance provenance;
};

/// @throws std::runtime_error naming the file that cannot be read, that is no live network, whose network has other
///         options than the first file's, or whose provenance gives a number of scans that is none
JoinedNetwork join_live_networks(const std::filesystem::path& first, const std::filesystem::path& shared);

}  // namespace svort
