#pragma once

#include <filesystem>
#include <string>
#include <vector>

#include "svort_ros/geometry/anchor_points.h"
#include "svort_ros/io/tables.h"
#include "svort_ros/metrics/pose_error.h"

namespace svort {

/// Errors of one group of slices.
struct PoseScore {
  std::string scan_id;
  int stack = -1;                         ///< -1: all stacks of the scan
  std::size_t slices = 0;                 ///< estimated slices
  ErrorSummary ed, gd;                    ///< absolute, mm and rad
  ErrorSummary relative_ed, relative_gd;  ///< after one rigid transform over all slices of the scan
};

/// Scores of poses against the truth: for each scan all slices together, then stack by stack.
struct Evaluation {
  std::vector<PoseScore> scores;
  std::size_t missing = 0;  ///< slices of the truth without an estimate: not acquired, rejected, or lost
};

/// @throws std::runtime_error naming `poses_name` or `truth_name` and the slice: an estimate without truth, a slice
///         that is there twice, no slice at all
Evaluation evaluate_poses(const std::vector<PoseRow>& poses, const std::vector<PoseRow>& truth,
                          const AnchorFrame& frame, const std::string& poses_name, const std::string& truth_name);

/// Tables of the scores: Markdown for people, CSV for programs.
std::string to_markdown(const Evaluation& evaluation);
std::string to_csv(const Evaluation& evaluation);

/// The program svort_evaluate. @return 0, or 2 with a message on standard error if something is wrong with the input
int run_svort_evaluate(int argc, char** argv);

}  // namespace svort
