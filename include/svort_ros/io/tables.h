#pragma once

#include <cstdint>
#include <filesystem>
#include <string>
#include <vector>

#include "svort_ros/live/incremental_estimator.h"
#include "svort_ros/live/journal.h"

namespace svort {

/// One row of poses.csv; docs/files.md describes the columns. Missing trailing columns (truth.csv) keep their defaults.
struct PoseRow {
  std::string scan_id;
  int stack = 0;
  int slice = 0;
  double stamp = 0.;                        ///< s
  Pose T_brain_slice = Pose::Identity();    ///< mm
  Pose T_scanner_brain = Pose::Identity();  ///< mm
  double weight = 1.;
  double ncc = 0.;
  std::string status;
};

/// Writes poses.csv. All writers here write a temporary file and rename it, so a file is whole or not there.
/// @throws std::runtime_error naming the file and the reason
void write_pose_table(const std::filesystem::path& path, const Estimate& estimate);

/// Reads poses.csv or truth.csv. @throws std::runtime_error naming the file, the line and the column
std::vector<PoseRow> read_pose_table(const std::filesystem::path& path);

/// Writes updates.csv.
void write_update_table(const std::filesystem::path& path, const Journal& journal);

}  // namespace svort
