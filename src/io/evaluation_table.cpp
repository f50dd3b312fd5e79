#include "svort_ros/io/evaluation_table.h"

#include <torch/types.h>

#include <algorithm>
#include <cstdio>
#include <functional>
#include <optional>
#include <sstream>
#include <stdexcept>

#include "svort_ros/io/atomic_file.h"
#include "svort_ros/io/brain_templates.h"
#include "svort_ros/live/threads.h"
#include "svort_ros/metrics/pose_error.h"
#include "table_rows.h"

namespace svort {
namespace {

template <class Row>
std::vector<CsvColumn<Row>> key_columns() {
  std::vector<CsvColumn<Row>> list;
  const auto add = [&list](const char* name, auto access) { list.push_back(csv_column<Row>(name, access, true)); };
  add(
      "method", [](Row & r) -> auto& { return r.method; });
  add(
      "weights", [](Row & r) -> auto& { return r.weights; });
  add(
      "iterations", [](Row & r) -> auto& { return r.iterations; });
  add(
      "protocol", [](Row & r) -> auto& { return r.protocol; });
  add(
      "brain", [](Row & r) -> auto& { return r.brain; });
  add(
      "motion", [](Row & r) -> auto& { return r.motion; });
  add(
      "seed", [](Row & r) -> auto& { return r.seed; });
  add(
      "scan", [](Row & r) -> auto& { return r.number; });
  add(
      "stacks", [](Row & r) -> auto& { return r.stacks; });
  return list;
}

void add_poses(std::vector<CsvColumn<TableScore>>* list, const std::string& prefix, MethodScore TableScore::*poses) {
  const auto add = [&](const char* name, auto member) {
    list->push_back(csv_column<TableScore>(
        prefix + name, [ poses, member ](TableScore & r) -> auto& { return r.*poses.*member; }));
  };
  add("ed_mm", &MethodScore::ed_mm);
  add("gd_rad", &MethodScore::gd_rad);
  add("relative_ed_mm", &MethodScore::relative_ed_mm);
  add("relative_gd_rad", &MethodScore::relative_gd_rad);
  add("slice_psnr_db", &MethodScore::slice_psnr_db);
  add("slice_ssim", &MethodScore::slice_ssim);
  add("frame_sure", &MethodScore::sure);
}

void add_volume(std::vector<CsvColumn<TableScore>>* list, const std::string& prefix, VolumeScore TableScore::*volume) {
  list->push_back(csv_column<TableScore>(
      prefix + "psnr_db", [volume](TableScore & r) -> auto& { return (r.*volume).psnr_db; }));
  list->push_back(csv_column<TableScore>(
      prefix + "ssim", [volume](TableScore & r) -> auto& { return (r.*volume).ssim; }));
}

/// The value of one scan -> mean and deviation over scans.
template <class Value>
ErrorSummary over_scans(const std::vector<TableScore>& scores, const Value& value) {
  std::vector<double> values;
  for (const TableScore& score : scores) values.push_back(value(score));
  return summarise(torch::tensor(values, torch::kFloat64));
}

template <class Value>
std::string cell(const std::vector<TableScore>& scores, const Value& value, int decimals) {
  const ErrorSummary summary = over_scans(scores, value);
  if (summary.count == 0) return "-";
  return fixed(summary.mean, decimals) + (summary.count > 1 ? " (" + fixed(summary.deviation, decimals) + ")" : "");
}

/// One value of a score, and its decimals.
using Quantity = std::pair<int, std::function<double(const TableScore&)>>;

Quantity of_poses(MethodScore TableScore::*poses, double MethodScore::*member, int decimals) {
  return {decimals, [poses, member](const TableScore& score) { return score.*poses.*member; }};
}
Quantity of_volume(VolumeScore TableScore::*volume, double VolumeScore::*member, int decimals) {
  return {decimals, [volume, member](const TableScore& score) { return score.*volume.*member; }};
}

std::string line(const std::string& name, const std::vector<TableScore>& scores,
                 const std::vector<Quantity>& quantities) {
  std::string text = "| " + name + " | " + std::to_string(scores.size()) + " |";
  for (const auto& [decimals, value] : quantities) text += " " + cell(scores, value, decimals) + " |";
  return text + "\n";
}

std::string head(const std::vector<const char*>& names) {
  std::string text = "|", rule = "|";
  for (const char* name : names) {
    text += std::string(" ") + name + " |";
    rule += "---|";
  }
  return text + "\n" + rule + "\n";
}

/// What the rows' networks have seen in training, and who has seen less than another.
std::string training_notes(const TableRows& rows) {
  const TableRow* most = nullptr;
  for (const TableRow& row : rows.rows)
    if (row.scans_seen && (most == nullptr || *row.scans_seen > *most->scans_seen)) most = &row;
  std::string text;
  for (const TableRow& row : rows.rows) {
    if (row.method.weights_sha256.empty()) continue;
    if (!row.scans_seen) {
      text += "* " + row.method.name + ": its weights do not say how many scans they were trained on.\n";
    } else if (*row.scans_seen < *most->scans_seen) {
      const double share = static_cast<double>(*row.scans_seen) / static_cast<double>(*most->scans_seen);
      text += "* " + row.method.name + " was **trained less**: " + std::to_string(*row.scans_seen) + " scans, " +
              fixed(100. * share, share < 0.1 ? 1 : 0) + " % of the " + std::to_string(*most->scans_seen) + " of " +
              most->method.name + ".\n";
    } else {
      text += "* " + row.method.name + " was trained on " + std::to_string(*row.scans_seen) + " scans.\n";
    }
  }
  return text.empty() ? text : "\n" + text;
}

AccuracySetup setup_of(const TableRun& run, const TablePlan& plan) {
  AccuracySetup setup;
  setup.pipeline = run.pipeline;
  for (BrainTemplate& brain : load_templates(plan.templates)) {
    const std::string name = volume_name(brain.name);
    if (std::find(plan.volumes.begin(), plan.volumes.end(), name) == plan.volumes.end())
      setup.atlas.push_back(std::move(brain));
  }
  return setup;
}

/// Keeps the rows that the run asks for. @throws std::runtime_error naming a row that is not in the plan
void choose_rows(const TableRun& run, TablePlan* plan) {
  for (const std::string& wanted : run.rows)
    if (std::none_of(plan->rows.begin(), plan->rows.end(), [&](const auto& row) { return row.name == wanted; }))
      throw std::runtime_error(run.plan.string() + ": has no row '" + wanted + "'");
  if (run.rows.empty()) return;
  const auto unwanted = [&](const TableRowPlan& row) {
    return std::find(run.rows.begin(), run.rows.end(), row.name) == run.rows.end();
  };
  plan->rows.erase(std::remove_if(plan->rows.begin(), plan->rows.end(), unwanted), plan->rows.end());
}

void say(const TableScore& score, const std::string& progress) {
  std::fprintf(
      stderr, "%s %s seed %s, %d stacks, %s: ED %s GD %s relative %s, after SVR %s %s %s, volume %s -> %s dB (%s)\n",
      score.brain.c_str(), score.motion.c_str(), std::to_string(score.seed).c_str(), score.stacks, score.method.c_str(),
      fixed(score.own.ed_mm, 2).c_str(), fixed(score.own.gd_rad, 3).c_str(), fixed(score.own.relative_ed_mm, 2).c_str(),
      fixed(score.refined.ed_mm, 2).c_str(), fixed(score.refined.gd_rad, 3).c_str(),
      fixed(score.refined.relative_ed_mm, 2).c_str(), fixed(score.weighted.psnr_db, 2).c_str(),
      fixed(score.refined_volume.psnr_db, 2).c_str(), progress.c_str());
}

}  // namespace

const std::vector<CsvColumn<TableScore>>& score_columns() {
  static const std::vector<CsvColumn<TableScore>> all = [] {
    auto list = key_columns<TableScore>();
    list.push_back(csv_column<TableScore>(
        "slices", [](TableScore & r) -> auto& { return r.slices; }));
    add_poses(&list, "", &TableScore::own);
    add_poses(&list, "svr_", &TableScore::refined);
    add_volume(&list, "psf_", &TableScore::psf);
    add_volume(&list, "unweighted_", &TableScore::unweighted);
    add_volume(&list, "weighted_", &TableScore::weighted);
    add_volume(&list, "svr_", &TableScore::refined_volume);
    list.push_back(csv_column<TableScore>(
        "seconds", [](TableScore & r) -> auto& { return r.seconds; }));
    list.push_back(csv_column<TableScore>(
        "svr_seconds", [](TableScore & r) -> auto& { return r.refined_seconds; }));
    list.push_back(csv_column<TableScore>(
        "svr_converged", [](TableScore & r) -> auto& { return r.converged; }));
    return list;
  }();
  return all;
}

const std::vector<CsvColumn<TableSlice>>& slice_columns() {
  static const std::vector<CsvColumn<TableSlice>> all = [] {
    auto list = key_columns<TableSlice>();
    const auto add = [&list](const char* name, auto access, bool key = false) {
      list.push_back(csv_column<TableSlice>(name, access, key));
    };
    add(
        "stack", [](TableSlice & r) -> auto& { return r.stack; }, true);
    add(
        "slice", [](TableSlice & r) -> auto& { return r.slice; }, true);
    add(
        "distance_mm", [](TableSlice & r) -> auto& { return r.distance_mm; });
    add(
        "ed_mm", [](TableSlice & r) -> auto& { return r.ed_mm; });
    add(
        "relative_ed_mm", [](TableSlice & r) -> auto& { return r.relative_ed_mm; });
    add(
        "svr_relative_ed_mm", [](TableSlice & r) -> auto& { return r.refined_relative_ed_mm; });
    return list;
  }();
  return all;
}

const std::vector<CsvColumn<TablePrefix>>& prefix_columns() {
  static const std::vector<CsvColumn<TablePrefix>> all = [] {
    auto list = key_columns<TablePrefix>();
    const auto add = [&list](const char* name, auto access, bool key = false) {
      list.push_back(csv_column<TablePrefix>(name, access, key));
    };
    add(
        "seen", [](TablePrefix & r) -> auto& { return r.seen; }, true);
    add(
        "ed_mm", [](TablePrefix & r) -> auto& { return r.ed_mm; });
    add(
        "relative_ed_mm", [](TablePrefix & r) -> auto& { return r.relative_ed_mm; });
    return list;
  }();
  return all;
}

std::string table_markdown(const TablePlan& plan, const TableRows& rows, const std::vector<TableScore>& scores) {
  std::vector<std::pair<const TableRow*, std::vector<TableScore>>> groups;
  for (const TableRow& row : rows.rows) {
    groups.emplace_back(&row, std::vector<TableScore>());
    for (const TableScore& score : scores)
      if (belongs(score, plan, row, plan.stacks)) groups.back().second.push_back(score);
  }
  const auto table = [&](const std::vector<const char*>& names, const std::vector<Quantity>& quantities) {
    std::string text = head(names);
    for (const auto& [row, own] : groups) text += line(row->method.name, own, quantities);
    return text;
  };
  constexpr auto own = &TableScore::own, svr = &TableScore::refined;
  std::ostringstream text;
  text << "Poses and volumes of each method:\n\n"
       << table({"method", "scans", "ED, mm", "GD, rad", "slice PSNR, dB", "slice SSIM", "volume PSNR, dB",
                 "volume SSIM", "relative ED, mm", "relative GD, rad"},
                {of_poses(own, &MethodScore::ed_mm, 2), of_poses(own, &MethodScore::gd_rad, 3),
                 of_poses(own, &MethodScore::slice_psnr_db, 2), of_poses(own, &MethodScore::slice_ssim, 3),
                 of_volume(&TableScore::weighted, &VolumeScore::psnr_db, 2),
                 of_volume(&TableScore::weighted, &VolumeScore::ssim, 3),
                 of_poses(own, &MethodScore::relative_ed_mm, 2), of_poses(own, &MethodScore::relative_gd_rad, 3)});
  text << "\nAfter registration of slices to volume (SVR), which starts from each method's poses:\n\n"
       << table({"method", "scans", "ED, mm", "change of ED, mm", "GD, rad", "change of GD, rad", "slice PSNR, dB",
                 "slice SSIM", "volume PSNR, dB", "volume SSIM", "relative ED, mm", "relative GD, rad"},
                {of_poses(svr, &MethodScore::ed_mm, 2),
                 {2, [](const TableScore& s) { return s.refined.ed_mm - s.own.ed_mm; }},
                 of_poses(svr, &MethodScore::gd_rad, 3),
                 {3, [](const TableScore& s) { return s.refined.gd_rad - s.own.gd_rad; }},
                 of_poses(svr, &MethodScore::slice_psnr_db, 2),
                 of_poses(svr, &MethodScore::slice_ssim, 3),
                 of_volume(&TableScore::refined_volume, &VolumeScore::psnr_db, 2),
                 of_volume(&TableScore::refined_volume, &VolumeScore::ssim, 3),
                 of_poses(svr, &MethodScore::relative_ed_mm, 2),
                 of_poses(svr, &MethodScore::relative_gd_rad, 3)});
  text << "\nThree volume estimates from each method's own poses:\n\n"
       << table({"method", "scans", "PSNR, PSF, dB", "w = 1, dB", "weighted, dB", "SSIM, PSF", "w = 1", "weighted"},
                {of_volume(&TableScore::psf, &VolumeScore::psnr_db, 2),
                 of_volume(&TableScore::unweighted, &VolumeScore::psnr_db, 2),
                 of_volume(&TableScore::weighted, &VolumeScore::psnr_db, 2),
                 of_volume(&TableScore::psf, &VolumeScore::ssim, 3),
                 of_volume(&TableScore::unweighted, &VolumeScore::ssim, 3),
                 of_volume(&TableScore::weighted, &VolumeScore::ssim, 3)});
  if (plan.motions.size() > 1) {
    text << "\nBy motion class:\n\n"
         << head({"motion, method", "scans", "ED, mm", "relative ED, mm", "ED after SVR, mm",
                  "relative ED after SVR, mm"});
    for (const std::string& motion : plan.motions)
      for (const auto& [row, of_row] : groups) {
        std::vector<TableScore> part;
        for (const TableScore& score : of_row)
          if (score.motion == motion) part.push_back(score);
        text << line(motion + ", " + row->method.name, part,
                     {of_poses(own, &MethodScore::ed_mm, 2), of_poses(own, &MethodScore::relative_ed_mm, 2),
                      of_poses(svr, &MethodScore::ed_mm, 2), of_poses(svr, &MethodScore::relative_ed_mm, 2)});
      }
  }
  text << "\nMean (standard deviation) over scans of each scan's mean over slices. Stacks: " << plan.stacks
       << "; protocol: " << plan.protocol << ". docs/evaluation.md says what is measured.\n";
  text << training_notes(rows);
  if (!rows.refused.empty()) text << "\nNot measured:\n\n";
  for (const auto& [name, reason] : rows.refused) text << "* " << name << ": " << reason << "\n";
  return text.str();
}

void measure_table(const TableRun& run) {
  TablePlan plan = read_table_plan(run.plan);
  choose_rows(run, &plan);
  std::vector<BrainVolume> brains = read_brain_volumes(plan.volumes);
  // From here on volumes are known by their names: a file may hold several.
  plan.volumes.clear();
  for (BrainVolume& brain : brains) plan.volumes.push_back(brain.name = volume_name(brain.name));
  const NetworkEstimatorOptions& network = run.pipeline.estimator.network;
  const TableRows rows = load_table_rows(plan, {network.device, network.precision});
  if (!rows.refused.empty() && !run.available) {
    std::string text = run.plan.string() + ": these rows cannot be measured (--available leaves them out):";
    for (const auto& [name, reason] : rows.refused) text += "\n  " + name + ": " + reason;
    throw std::runtime_error(text);
  }
  for (const auto& [name, reason] : rows.refused)
    std::fprintf(stderr, "row '%s' is left out: %s\n", name.c_str(), reason.c_str());
  if (rows.rows.empty()) throw std::runtime_error(run.plan.string() + ": there is no row to measure");

  set_thread_count(run.threads);
  const AccuracySetup setup = setup_of(run, plan);
  std::filesystem::create_directories(run.output);
  RowStore<TableScore> scores(run.output / "table.csv", score_columns());
  RowStore<TableSlice> slices(run.output / "slices.csv", slice_columns());
  RowStore<TablePrefix> prefixes(run.output / "prefixes.csv", prefix_columns());
  const auto write = [&] {
    write_file(run.output / "table.md", table_markdown(plan, rows, scores.rows()));
    plot_table(run.output, plan, rows, scores.rows(), slices.rows(), prefixes.rows());
  };

  TaskClock clock(plan.seeds.size() * static_cast<std::size_t>(plan.scans) * plan.motions.size() * brains.size() *
                  static_cast<std::size_t>(plan.stacks) * rows.rows.size());
  bool first = true;
  // What the table itself needs comes first, then, for a figure, the same scans with fewer stacks.
  for (int stacks = plan.stacks; stacks >= 1; --stacks)
    for (const std::uint64_t seed : plan.seeds)
      for (int scan = 0; scan < plan.scans; ++scan)
        for (const std::string& motion : plan.motions)
          for (std::size_t b = 0; b < brains.size(); ++b) {
            EvaluationScanOptions options;
            options.motion = motion;
            options.protocol = plan.protocol;
            options.stacks = stacks;
            options.seed = seed;
            options.number = static_cast<std::uint64_t>(scan) * brains.size() + b;
            const bool whole = stacks == plan.stacks;
            std::optional<EvaluationScan> simulated;
            for (const TableRow& row : rows.rows) {
              TableScore score;
              static_cast<TableKey&>(score) = table_key(row.method, brains[b].name, options);
              if (scores.has(score)) {
                clock.skip();
                continue;
              }
              if (!simulated) simulated = simulate_evaluation_scan(brains[b], options);
              const TableResult result = measure_method(*simulated, row.method, setup, {whole, whole, whole});
              // The score last: it says that the rest is there.
              if (whole) slices.add(result.slices);
              if (whole) prefixes.add(result.prefixes);
              if (first && whole) plot_table_pictures(run.output, result.score, result.pictures);
              scores.add({result.score});
              say(result.score, clock.next());
            }
            first = false;
            write();
          }
  write();
}

}  // namespace svort
