#pragma once

#include <filesystem>
#include <string>
#include <vector>

#include "svort_ros/decision/decision_engine.h"
#include "svort_ros/live/live_pipeline.h"

namespace svort {

/// What run.json says beside what the pipeline knows.
struct RunInfo {
  std::string program;              ///< "svort_replay", "svort_node"
  std::vector<std::string> inputs;  ///< files or topics
  std::uint64_t seed = 0;
  int threads = 0;
  double wall_s = 0.;  ///< duration of the run, s
};

/// Writes poses.csv, updates.csv, volume.nii.gz, volume.png, latency.png and run.json into `directory`, which is made
/// if needed. Without slices, only updates.csv and run.json; files of an earlier run that this one does not write are
/// removed. Each file is whole or not there, and run.json comes last.
/// @param decisions if not null, also what write_decisions() writes, and report.html
/// @throws std::runtime_error naming the file and the reason
void write_results(const std::filesystem::path& directory, const LivePipeline& pipeline, const RunInfo& run,
                   const DecisionEngine* decisions = nullptr);

/// Median, 95th percentile and maximum; NaN values are left out, all NaN without any.
struct Percentiles {
  double median = 0.;
  double p95 = 0.;
  double max = 0.;
};
Percentiles percentiles(std::vector<double> values);

/// Peak resident memory of this process, MiB.
double peak_memory_mib();

}  // namespace svort
