#pragma once

#include <filesystem>
#include <string>
#include <vector>

#include "svort_ros/Slice.h"

namespace svort_ros {

/// All slices of a bag in the order in which they were recorded. A leading slash of the topic makes no difference.
/// @throws std::runtime_error naming the file and the reason: unreadable, no such topic (the topics with slices are
///         named), another type or another version of the message
std::vector<Slice> read_slices(const std::filesystem::path& bag, const std::string& topic);

/// Writes a bag, whole or not at all, that keeps the order of the slices: record times are acquisition times, moved up
/// where those go back.
/// @throws std::runtime_error naming the file and the reason
void write_slices(const std::filesystem::path& bag, const std::vector<Slice>& slices, const std::string& topic);

}  // namespace svort_ros
