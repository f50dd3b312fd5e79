#pragma once

#include <cstdint>
#include <filesystem>
#include <string>

#include "svort_ros/ros/parameters.h"
#include "svort_ros/ros/stack_input.h"

namespace svort_ros {

/// What svort_replay is to do.
struct ReplayOptions {
  std::string bag;         ///< either this
  StackInput input;        ///< or these stacks
  std::string topic;       ///< of the slices in the bag
  std::string output;      ///< folder of the results
  std::string what_if;     ///< YAML file with other thresholds (section `decision`), to see what they would decide
  ServerOptions server;    ///< of `node` only `threads` matters here
  double realtime = 0.;    ///< 1 is the scanner's pace, 2 twice as fast; 0 is as fast as possible
  std::uint64_t seed = 0;  ///< written into run.json; the estimators draw no random numbers
};

/// What came out of it.
struct ReplaySummary {
  std::size_t arrivals = 0;
  std::size_t kept = 0;
  double wall_s = 0.;
  double scan_s = 0.;  ///< time between first and last acquisition
  std::vector<std::filesystem::path> folders;
  std::vector<std::string> warnings;  ///< about the estimator, e.g. that its weights are untrained
};

/// Feeds the slices to the live pipeline one by one, with a new volume after each, and writes the results: into
/// `output`, or, if the input holds several scans, into a folder of its own there for each.
/// @throws std::runtime_error, std::invalid_argument naming the file or the option
ReplaySummary replay(const ReplayOptions& options);

/// The program. @return 0, or 2 with a message on standard error if something is wrong with input or options
int run_svort_replay(int argc, char** argv);
/// Likewise nifti_to_bag.
int run_nifti_to_bag(int argc, char** argv);

}  // namespace svort_ros
