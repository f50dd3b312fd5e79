#include "svort_ros/io/results.h"

#include <sys/resource.h>
#include <torch/version.h>

#include <algorithm>
#include <cmath>
#include <limits>
#include <map>
#include <numeric>
#include <stdexcept>

#include "svort_ros/io/atomic_file.h"
#include "svort_ros/io/decision_files.h"
#include "svort_ros/io/nifti.h"
#include "svort_ros/io/options_file.h"
#include "svort_ros/io/plots.h"
#include "svort_ros/io/report.h"
#include "svort_ros/io/tables.h"

namespace svort {
namespace {

using Json = nlohmann::ordered_json;

/// Linear interpolation between the sorted values, q in [0, 1].
double quantile(const std::vector<double>& sorted, double q) {
  const double position = q * static_cast<double>(sorted.size() - 1);
  const auto lower = static_cast<std::size_t>(position);
  const std::size_t upper = std::min(lower + 1, sorted.size() - 1);
  return sorted[lower] + (position - static_cast<double>(lower)) * (sorted[upper] - sorted[lower]);
}

/// Times and sizes to three decimals; NaN stays and becomes null.
double rounded(double value) { return std::round(value * 1000.) / 1000.; }

Json percentiles_to_json(const std::vector<double>& values) {
  const Percentiles p = percentiles(values);
  return Json{{"median", rounded(p.median)}, {"p95", rounded(p.p95)}, {"max", rounded(p.max)}};
}

Json ncc_to_json(std::vector<double> values) {
  values.erase(std::remove_if(values.begin(), values.end(), [](double v) { return std::isnan(v); }), values.end());
  const double nan = std::numeric_limits<double>::quiet_NaN();
  const double mean =
      values.empty() ? nan : std::accumulate(values.begin(), values.end(), 0.) / static_cast<double>(values.size());
  return Json{{"slices", values.size()}, {"mean", mean}, {"median", percentiles(values).median}};
}

Json latency_to_json(const Journal& journal) {
  std::vector<double> pose;
  std::vector<double> volume;
  std::vector<double> decision;
  std::vector<double> rejected;
  for (const JournalEntry& entry : journal.entries()) {
    (is_kept(entry.status) ? pose : rejected).push_back(entry.latency_ms);
    if (is_kept(entry.status)) volume.push_back(entry.volume_latency_ms);
    if (is_kept(entry.status)) decision.push_back(entry.decision_latency_ms);
  }
  return Json{{"pose_ms", percentiles_to_json(pose)},
              {"volume_ms", percentiles_to_json(volume)},
              {"decision_ms", percentiles_to_json(decision)},
              {"rejected_ms", percentiles_to_json(rejected)}};
}

Json quality_to_json(const Estimate& estimate) {
  std::vector<double> all;
  std::map<int, std::vector<double>> by_stack;
  for (const SliceEstimate& slice : estimate.slices) {
    all.push_back(slice.ncc);
    by_stack[slice.info.stack].push_back(slice.ncc);
  }
  Json json = ncc_to_json(all);
  Json stacks = Json::object();
  for (const auto& [stack, values] : by_stack) stacks[std::to_string(stack)] = ncc_to_json(values);
  json["stacks"] = stacks;
  json["note"] = "correlation of each slice with the volume that it is part of: an upper bound";
  return json;
}

std::string run_json(const LivePipeline& pipeline, const RunInfo& run, const DecisionEngine* decisions) {
  const SliceSequence& sequence = pipeline.sequence();
  Json arrivals = Json::object();
  for (const auto& [status, count] : sequence.arrivals()) arrivals[to_string(status)] = count;

  Json json;
  json["package"] = "svort_ros";
  json["version"] = SVORT_VERSION;
  json["libtorch"] = TORCH_VERSION;
  json["program"] = run.program;
  json["inputs"] = run.inputs;
  json["scan_id"] = sequence.scan_id();
  json["seed"] = run.seed;
  json["threads"] = run.threads;
  json["device"] = pipeline.device();
  json["estimator"] = {{"method", pipeline.options().estimator.method}, {"weights", nullptr}};
  const EstimatorNotes notes = pipeline.notes();
  if (!notes.network.empty()) {
    json["estimator"]["network"] = notes.network;
    json["estimator"]["weights"] = {{"file", pipeline.options().estimator.network.weights},
                                    {"sha256", notes.weights_sha256}};
  }
  if (!notes.warnings.empty()) json["estimator"]["warnings"] = notes.warnings;
  if (pipeline.options().estimator.method == "nominal")
    json["estimator"]["note"] = "poses are the scanner's prescription; no motion was estimated and no network was used";
  Json outliers = Json::array();
  for (const SliceEstimate& slice : pipeline.estimate().slices)
    if (!slice.reason.empty())
      outliers.push_back({{"stack", slice.info.stack}, {"slice", slice.info.index}, {"reason", slice.reason}});
  json["outliers"] = outliers;
  json["slices"] = sequence.slices().size();
  json["revision"] = pipeline.estimate().revision;
  json["final"] = pipeline.estimate().final;
  json["arrivals"] = arrivals;
  json["intensity_scale"] = sequence.intensity_scale();
  json["agreement"] = pipeline.estimate().agreement;  // null if it is not known
  json["ncc"] = quality_to_json(pipeline.estimate());
  json["latency"] = latency_to_json(pipeline.journal());
  json["wall_s"] = rounded(run.wall_s);
  json["peak_memory_mib"] = rounded(peak_memory_mib());
  json["options"] = options_to_json(pipeline.options());
  if (decisions) {
    json["options"]["decision"] = options_to_json(decisions->options());
    json["decisions"] = decisions_to_json(*decisions);
  }
  // A scan id may hold any bytes; what is not UTF-8 is replaced instead of losing the file.
  return json.dump(2, ' ', false, Json::error_handler_t::replace) + "\n";
}

}  // namespace

Percentiles percentiles(std::vector<double> values) {
  values.erase(std::remove_if(values.begin(), values.end(), [](double v) { return std::isnan(v); }), values.end());
  if (values.empty()) {
    const double nan = std::numeric_limits<double>::quiet_NaN();
    return {nan, nan, nan};
  }
  std::sort(values.begin(), values.end());
  return {quantile(values, 0.5), quantile(values, 0.95), values.back()};
}

double peak_memory_mib() {
  rusage usage{};
  if (getrusage(RUSAGE_SELF, &usage) != 0) return std::numeric_limits<double>::quiet_NaN();
  return static_cast<double>(usage.ru_maxrss) / 1024.;
}

void write_results(const std::filesystem::path& directory, const LivePipeline& pipeline, const RunInfo& run,
                   const DecisionEngine* decisions) {
  std::error_code error;
  std::filesystem::create_directories(directory, error);
  if (error || !std::filesystem::is_directory(directory))
    throw std::runtime_error(directory.string() +
                             ": cannot make this folder: " + (error ? error.message() : std::string("it is a file")));

  const bool has_slices = !pipeline.estimate().slices.empty();
  const bool has_volume = has_slices && !pipeline.volume().empty();
  // What this run does not write must not be left from an earlier one beside its run.json.
  const auto write_or_remove = [&](const char* name, bool wanted, const auto& write) {
    const std::filesystem::path path = directory / name;
    if (wanted) return write(path);
    std::error_code remove_error;
    std::filesystem::remove(path, remove_error);
    if (remove_error)
      throw std::runtime_error(path.string() + ": cannot remove the file of an earlier run: " + remove_error.message());
  };
  // run.json goes first and comes last, so that it always stands for a complete set.
  write_or_remove("run.json", false, [](const auto&) {});
  write_or_remove("poses.csv", has_slices, [&](const auto& path) { write_pose_table(path, pipeline.estimate()); });
  write_or_remove("updates.csv", true, [&](const auto& path) { write_update_table(path, pipeline.journal()); });
  write_or_remove("volume.nii.gz", has_volume, [&](const auto& path) { write_nifti(path, pipeline.volume()); });
  write_or_remove("volume.png", has_volume, [&](const auto& path) {
    plot_volume_views(path, pipeline.volume(),
                      "scan " + pipeline.sequence().scan_id() + ": " +
                          std::to_string(pipeline.estimate().slices.size()) + " slices, " +
                          pipeline.options().estimator.method + " poses");
  });
  write_or_remove("latency.png", has_slices, [&](const auto& path) { plot_latency(path, pipeline.journal()); });
  if (decisions) write_decisions(directory, pipeline.sequence().scan_id(), *decisions);
  write_or_remove("report.html", decisions && has_slices,
                  [&](const auto&) { write_report(directory, pipeline, run, *decisions); });
  write_or_remove("run.json", true, [&](const auto& path) { write_file(path, run_json(pipeline, run, decisions)); });
}

}  // namespace svort
