#pragma once

#include <cstdint>
#include <filesystem>
#include <limits>
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
  std::int64_t stamp_ns = 0;                ///< acquisition time, ns since the epoch; exact
  double stamp = 0.;                        ///< the same in s, to a microsecond or better
  Pose T_brain_slice = Pose::Identity();    ///< mm
  Pose T_scanner_brain = Pose::Identity();  ///< mm
  double weight = 1.;
  double ncc = 0.;
  std::string status;
  double radius_95_mm = std::numeric_limits<double>::quiet_NaN();
  bool displaced = false;  ///< truth.csv: the head moved since the slice's stack was planned
  bool voided = false;     ///< truth.csv, column void: signal void
  bool noisy = false;      ///< truth.csv: much more noise than the other slices
};

/// Writes poses.csv. All writers here write a temporary file and rename it, so a file is whole or not there.
/// @throws std::runtime_error naming the file and the reason
void write_pose_table(const std::filesystem::path& path, const Estimate& estimate);

/// Writes truth.csv: scan_id to qw as in poses.csv, then the flags displaced, void, noisy (0 or 1).
/// @throws std::runtime_error naming the file and the reason
void write_truth_table(const std::filesystem::path& path, const std::vector<PoseRow>& rows);

/// Reads poses.csv or truth.csv. Columns are found by their names; scan_id to qw must be there.
/// @throws std::runtime_error naming the file, the line and the column: missing, unknown or repeated column, wrong
///         number of fields, not a number, a pose that is not finite or a quaternion that is not of length 1 (1e-3)
std::vector<PoseRow> read_pose_table(const std::filesystem::path& path);

/// Writes updates.csv, one row per arrival. Rejected slices have a pose of nan.
/// @throws std::runtime_error naming the file and the reason
void write_update_table(const std::filesystem::path& path, const Journal& journal);

}  // namespace svort
