#include "svort_ros/io/evaluation.h"

#include <torch/types.h>

#include <CLI/CLI.hpp>
#include <cstdio>
#include <exception>
#include <map>
#include <set>
#include <sstream>
#include <stdexcept>
#include <tuple>

#include "svort_ros/io/atomic_file.h"
#include "svort_ros/io/evaluation_table.h"
#include "svort_ros/io/options_file.h"

namespace svort {
namespace {

constexpr int kBadInput = 2;

using SliceKey = std::tuple<std::string, int, int>;  // scan, stack, slice

std::string describe(const SliceKey& key) {
  return "slice " + std::to_string(std::get<2>(key)) + " of stack " + std::to_string(std::get<1>(key)) + " of scan '" +
         std::get<0>(key) + "'";
}

std::map<SliceKey, Pose> by_slice(const std::vector<PoseRow>& rows, const std::string& name) {
  if (rows.empty()) throw std::runtime_error(name + ": holds no slice");
  std::map<SliceKey, Pose> result;
  for (const PoseRow& row : rows) {
    const SliceKey key{row.scan_id, row.stack, row.slice};
    if (!result.emplace(key, row.T_brain_slice).second)
      throw std::runtime_error(name + ": " + describe(key) + " is there twice");
  }
  return result;
}

std::string fixed(double value, int decimals) {
  char buffer[64];
  std::snprintf(buffer, sizeof buffer, "%.*f", decimals, value);
  return buffer;
}

std::string exact(double value) {
  char buffer[64];
  std::snprintf(buffer, sizeof buffer, "%.9g", value);
  return buffer;
}

std::string stack_name(const PoseScore& score) { return score.stack < 0 ? "all" : std::to_string(score.stack); }

}  // namespace

Evaluation evaluate_poses(const std::vector<PoseRow>& poses, const std::vector<PoseRow>& truth,
                          const AnchorFrame& frame, const std::string& poses_name, const std::string& truth_name) {
  const std::map<SliceKey, Pose> estimated = by_slice(poses, poses_name), known = by_slice(truth, truth_name);
  struct Scan {
    std::vector<Pose> estimated, truth;
    std::vector<int> stacks;
  };
  std::map<std::string, Scan> scans;
  for (const auto& [key, pose] : estimated) {
    const auto found = known.find(key);
    if (found == known.end()) throw std::runtime_error(poses_name + ": " + describe(key) + " is not in " + truth_name);
    Scan& scan = scans[std::get<0>(key)];
    scan.estimated.push_back(pose);
    scan.truth.push_back(found->second);
    scan.stacks.push_back(std::get<1>(key));
  }

  Evaluation evaluation;
  for (const auto& entry : known)
    if (!estimated.count(entry.first)) ++evaluation.missing;
  for (const auto& [scan_id, scan] : scans) {
    const torch::Tensor a = poses_tensor(scan.estimated), b = poses_tensor(scan.truth);
    const PoseErrors absolute = pose_errors(a, b, frame), relative = relative_pose_errors(a, b, frame);
    std::set<int> groups(scan.stacks.begin(), scan.stacks.end());
    groups.insert(-1);
    for (const int stack : groups) {
      std::vector<std::int64_t> members;
      for (std::size_t i = 0; i < scan.stacks.size(); ++i)
        if (stack < 0 || scan.stacks[i] == stack) members.push_back(static_cast<std::int64_t>(i));
      const torch::Tensor index = torch::tensor(members, torch::kInt64);
      const auto of = [&index](const torch::Tensor& values) { return summarise(values.index_select(0, index)); };
      evaluation.scores.push_back(
          {scan_id, stack, members.size(), of(absolute.ed), of(absolute.gd), of(relative.ed), of(relative.gd)});
    }
  }
  return evaluation;
}

std::string to_markdown(const Evaluation& evaluation) {
  std::ostringstream text;
  text << "| scan | stack | slices | ED, mm | GD, rad | relative ED, mm | relative GD, rad |\n"
       << "|---|---|---|---|---|---|---|\n";
  for (const PoseScore& score : evaluation.scores) {
    const auto cell = [](const ErrorSummary& summary, int decimals) {
      return fixed(summary.mean, decimals) + " (" + fixed(summary.deviation, decimals) + "), median " +
             fixed(summary.median, decimals);
    };
    text << "| " << score.scan_id << " | " << stack_name(score) << " | " << score.slices << " | " << cell(score.ed, 2)
         << " | " << cell(score.gd, 3) << " | " << cell(score.relative_ed, 2) << " | " << cell(score.relative_gd, 3)
         << " |\n";
  }
  text << "\nMean (standard deviation over slices), median. ED: mean distance of the three anchor points; GD: angle of "
          "the remaining rotation; relative: after one rigid transform over all slices of the scan.\n";
  if (evaluation.missing > 0) text << evaluation.missing << " slices of the truth have no estimate.\n";
  return text.str();
}

std::string to_csv(const Evaluation& evaluation) {
  std::ostringstream csv;
  csv << "scan_id,stack,slices";
  for (const char* kind : {"ed_mm", "gd_rad", "relative_ed_mm", "relative_gd_rad"})
    for (const char* value : {"mean", "deviation", "median", "max"}) csv << ',' << kind << '_' << value;
  csv << '\n';
  for (const PoseScore& score : evaluation.scores) {
    std::string scan_id = score.scan_id;
    if (scan_id.find_first_of(",\"\r\n") != std::string::npos) {
      std::string quoted = "\"";
      for (const char c : scan_id) quoted += c == '"' ? std::string("\"\"") : std::string(1, c);
      scan_id = quoted + '"';
    }
    csv << scan_id << ',' << stack_name(score) << ',' << score.slices;
    for (const ErrorSummary& summary : {score.ed, score.gd, score.relative_ed, score.relative_gd})
      csv << ',' << exact(summary.mean) << ',' << exact(summary.deviation) << ',' << exact(summary.median) << ','
          << exact(summary.maximum);
    csv << '\n';
  }
  return csv.str();
}

int run_svort_evaluate(int argc, char** argv) {
  CLI::App app(
      "Scores poses against the truth: distance of the anchor points (ED) and angle (GD), absolute and relative. Or, "
      "with "
      "--table, measures a whole table of methods on simulated scans; stopped and started again, it goes on.",
      "svort_evaluate");
  std::string poses, truth, output;
  AnchorFrame frame;
  TableRun table;
  app.add_option("--poses", poses, "poses.csv of svort_replay or svort_node");
  app.add_option("--truth", truth, "truth.csv of svort_simulate");
  app.add_option("--output", output, "folder for the results; made if needed");
  app.add_option("--size-px", frame.width, "width and height of the plane that the anchor points span, pixels")
      ->capture_default_str()
      ->check(CLI::PositiveNumber);
  app.add_option("--pixel-mm", frame.resolution, "its pixel size, mm")
      ->capture_default_str()
      ->check(CLI::PositiveNumber);
  app.add_option("--table", table.plan, "description of a table of methods (YAML), e.g. config/evaluation/table1.yaml");
  app.add_option("--rows", table.rows, "only these rows of the table");
  app.add_flag("--available", table.available, "leave out rows whose weights are not there; the table says so");
  app.add_option("--threads", table.threads, "of the table; 0: all cores")->capture_default_str();
  bind_options(app, table.pipeline);
  try {
    app.parse(argc, argv);
    if (!table.plan.empty()) {
      if (!poses.empty() || !truth.empty()) throw std::runtime_error("--table excludes --poses and --truth");
      if (output.empty()) throw std::runtime_error("--table needs --output");
      table.output = output;
      measure_table(table);
      return 0;
    }
    if (poses.empty() || truth.empty()) throw std::runtime_error("give --poses and --truth, or --table and --output");
    frame.height = frame.width;
    const Evaluation evaluation = evaluate_poses(read_pose_table(poses), read_pose_table(truth), frame, poses, truth);
    const std::string markdown = to_markdown(evaluation);
    if (!output.empty()) {
      std::filesystem::create_directories(output);
      write_file(std::filesystem::path(output) / "evaluation.md", markdown);
      write_file(std::filesystem::path(output) / "evaluation.csv", to_csv(evaluation));
    }
    std::fputs(markdown.c_str(), stdout);
    return 0;
  } catch (const CLI::ParseError& error) {
    return app.exit(error) == 0 ? 0 : kBadInput;  // 0: help was asked for
  } catch (const std::exception& error) {
    std::fprintf(stderr, "%s: %s\n", app.get_name().c_str(), error.what());
    return kBadInput;
  }
}

}  // namespace svort
