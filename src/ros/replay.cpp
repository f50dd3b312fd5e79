#include "svort_ros/ros/replay.h"

#include <unistd.h>

#include <algorithm>
#include <cmath>
#include <cstdio>
#include <exception>
#include <map>
#include <memory>
#include <set>
#include <stdexcept>
#include <thread>

#include "svort_ros/decision/decision_engine.h"
#include "svort_ros/io/brain_templates.h"
#include "svort_ros/io/decision_files.h"
#include "svort_ros/io/options_file.h"
#include "svort_ros/io/results.h"
#include "svort_ros/live/live_pipeline.h"
#include "svort_ros/live/threads.h"
#include "svort_ros/ros/arrivals.h"
#include "svort_ros/ros/bag.h"
#include "svort_ros/ros/conversions.h"
#include "svort_ros/ros/names.h"
#include "svort_ros/ros/scan_archive.h"

namespace svort_ros {
namespace {

/// A bar on a terminal; one line per slice where the output is kept.
class Display {
 public:
  explicit Display(std::size_t total) : total_(total), terminal_(isatty(STDERR_FILENO) != 0) {}
  ~Display() {
    if (terminal_) std::fputc('\n', stderr);
  }

  void show(std::size_t done, const std::string& line) const {
    if (!terminal_) {
      std::fprintf(stderr, "%s\n", line.c_str());
      return;
    }
    constexpr std::size_t kWidth = 24;
    const std::size_t filled = kWidth * done / std::max<std::size_t>(1, total_);
    const std::string bar = std::string(filled, '#') + std::string(kWidth - filled, '.');
    std::fprintf(stderr, "\r\033[K[%s] %s", bar.c_str(), line.c_str());
    std::fflush(stderr);
  }

 private:
  std::size_t total_;
  bool terminal_;
};

/// One folder per scan, if there are several.
class OutputFolders {
 public:
  OutputFolders(std::filesystem::path root, const std::vector<Slice>& messages) : root_(std::move(root)) {
    std::set<std::string> scans;
    for (const Slice& message : messages) scans.insert(message.scan_id);
    several_ = scans.size() > 1;
  }

  std::filesystem::path next(const std::string& scan_id) {
    if (!several_) return root_;
    const std::string name = folder_name(scan_id);
    const int count = ++used_[name];  // two scan ids may become the same name
    return root_ / (count == 1 ? name : name + "_" + std::to_string(count));
  }

 private:
  std::filesystem::path root_;
  bool several_ = false;
  std::map<std::string, int> used_;
};

/// Improves poses (budget "time") and sleeps until the slice is due, and says when that was: waiting behind others
/// counts as latency.
Clock::time_point wait_for(const Slice& message, const Slice& first, Clock::time_point start, double realtime,
                           svort::LivePipeline* pipeline) {
  if (realtime <= 0.) return Clock::now();
  const double offset_s = std::max(0., (message.header.stamp - first.header.stamp).toSec() / realtime);
  const auto due = start + std::chrono::duration_cast<Clock::duration>(std::chrono::duration<double>(offset_s));
  while (Clock::now() < due && pipeline->improve()) {
  }
  std::this_thread::sleep_until(due);
  return due;
}

/// What a file for --what-if may hold.
struct WhatIfOptions {
  svort::DecisionOptions decision;

  template <class Visitor>
  void visit(Visitor&& v) {
    v.section("decision", decision);
  }
};

}  // namespace

ReplaySummary replay(const ReplayOptions& options) {
  if (!(options.realtime >= 0.) || !std::isfinite(options.realtime))
    throw std::invalid_argument("realtime is " + std::to_string(options.realtime) + "; it must be zero or positive");
  validate(options.server.node);
  svort::set_thread_count(options.server.node.threads);
  svort::LivePipeline pipeline(options.server.pipeline,
                               svort::load_templates(options.server.pipeline.estimator.templates));
  svort::DecisionEngine decisions(options.server.decision);
  std::unique_ptr<svort::DecisionEngine> what_if;  // the same scan under other thresholds
  if (!options.what_if.empty()) {
    WhatIfOptions other{options.server.decision};  // what the file does not name is as it is
    svort::load_options(options.what_if, other);
    what_if = std::make_unique<svort::DecisionEngine>(other.decision);
  }
  const auto decide = [&](const svort::LivePipeline& scan) {
    decisions.update(scan);
    if (what_if) what_if->update(scan);
  };
  const std::vector<Slice> messages =
      options.bag.empty() ? read_messages(options.input) : read_slices(options.bag, options.topic);

  ReplaySummary summary;
  OutputFolders folders(options.output, messages);
  Clock::time_point scan_started = Clock::now();
  AwaitingVolume awaiting_volume;
  ScanProgress progress;
  const auto write = [&](const svort::LivePipeline& scan) {
    svort::RunInfo run;
    run.program = "svort_replay";
    run.inputs = options.bag.empty() ? options.input.stacks : std::vector<std::string>{options.bag};
    if (options.bag.empty())
      run.inputs.insert(run.inputs.end(), options.input.masks.begin(), options.input.masks.end());
    run.seed = options.seed;
    run.threads = svort::thread_count();
    run.wall_s = milliseconds_since(scan_started) / 1000.;
    summary.folders.push_back(folders.next(scan.sequence().scan_id()));
    decide(scan);
    svort::write_results(summary.folders.back(), scan, run, &decisions);
    if (what_if) svort::write_what_if(summary.folders.back(), scan.sequence().scan_id(), decisions, *what_if);
    decisions.clear();
    if (what_if) what_if->clear();
  };
  pipeline.set_scan_end_callback([&](const svort::LivePipeline& scan) {
    write(scan);
    progress.clear();
    scan_started = Clock::now();
  });

  const Clock::time_point start = Clock::now();
  {
    const Display display(messages.size());
    for (const Slice& message : messages) {
      const Clock::time_point arrived = wait_for(message, messages.front(), start, options.realtime, &pipeline);
      const SliceFromMessage decoded = from_msg(message);
      const svort::Arrival arrival = decoded.ok ? pipeline.add(decoded.slice) : rejection(decoded);
      svort::JournalEntry entry = make_journal_entry(pipeline, decoded.slice.info, arrival);
      entry.latency_ms = milliseconds_since(arrived);
      const std::size_t number = pipeline.journal().add(entry);
      progress.add(entry.info, arrival.status);
      const std::string head = progress_head(progress, entry.info, arrival.status);
      ++summary.arrivals;
      if (!svort::is_kept(arrival.status)) {
        display.show(summary.arrivals, rejection_line(head, entry));
        continue;
      }
      ++summary.kept;
      awaiting_volume.add({number, arrived, head});
      pipeline.update_volume();
      const auto volume_published = awaiting_volume.volume_published(pipeline);
      decide(pipeline);
      for (const auto& published : volume_published) {
        pipeline.journal().set_decision_latency(published.slice.entry, milliseconds_since(published.slice.arrived));
        display.show(summary.arrivals, published.line);
      }
    }
  }
  pipeline.finalise();
  write(pipeline);
  summary.warnings = pipeline.notes().warnings;
  summary.wall_s = milliseconds_since(start) / 1000.;
  const auto [first, last] = std::minmax_element(
      messages.begin(), messages.end(), [](const Slice& a, const Slice& b) { return a.header.stamp < b.header.stamp; });
  if (!messages.empty()) summary.scan_s = (last->header.stamp - first->header.stamp).toSec();
  return summary;
}

namespace {

constexpr int kBadInput = 2;

/// Parses and runs; whatever is wrong becomes a message and the exit code.
template <class Action>
int run_program(CLI::App& app, int argc, char** argv, const Action& action) {
  try {
    app.parse(argc, argv);
    return action();
  } catch (const CLI::ParseError& error) {
    return app.exit(error) == 0 ? 0 : kBadInput;  // 0: help was asked for
  } catch (const std::exception& error) {
    std::fprintf(stderr, "%s: %s\n", app.get_name().c_str(), error.what());
    return kBadInput;
  }
}

/// The file must be read before the command line, which overrides it.
void load_config_named_on(int argc, char** argv, ServerOptions& options) {
  CLI::App first_pass;
  first_pass.allow_extras();
  first_pass.set_help_flag();
  std::string config;
  first_pass.add_option("--config", config);
  first_pass.parse(argc, argv);
  if (!config.empty()) svort::load_options(config, options);
}

}  // namespace

int run_svort_replay(int argc, char** argv) {
  CLI::App app("Feeds recorded slices to the live estimator one by one, and writes poses, volume and timings.",
               "svort_replay");
  ReplayOptions options;
  options.topic = kSliceTopic;
  try {
    load_config_named_on(argc, argv, options.server);
  } catch (const std::exception& error) {
    std::fprintf(stderr, "%s: %s\n", app.get_name().c_str(), error.what());
    return kBadInput;
  }
  std::string config;
  app.add_option("--bag", options.bag, "bag with slices; or use --stacks");
  app.add_option("--topic", options.topic, "topic of the slices in the bag")->capture_default_str();
  add_stack_options(app, options.input);
  app.add_option("--output", options.output, "folder for the results; made if needed")->required();
  app.add_option("--config", config, "YAML file with options, like config/node/default.yaml");
  app.add_option("--threads", options.server.node.threads, "threads of the estimator; 0 takes all cores")
      ->capture_default_str();
  svort::NetworkEstimatorOptions& network = options.server.pipeline.estimator.network;
  CLI::Option* weights = app.add_option(
      "--weights", network.weights,
      "run the network of this file (method network; with --estimator.network.candidate true: registration)");
  std::string guide_weights;
  CLI::Option* guide = app.add_option("--guide", guide_weights,
                                      "weights of the live network that guides registration, e.g. models/live.pt");
  guide->excludes(weights);
  CLI::Option* name =
      app.add_option("--network", network.name, "run this network (method network): v1, v2, ..; the file must hold it");
  app.add_option("--device", network.device, "where the network runs: auto, cpu or cuda; all else is on the CPU")
      ->check(CLI::IsMember({"auto", "cpu", "cuda"}))
      ->capture_default_str();
  app.add_option("--realtime", options.realtime, "1: the scanner's pace, 2: twice as fast, 0: as fast as possible")
      ->capture_default_str();
  app.add_option("--budget", options.server.pipeline.estimator.budget,
                 "iterations: the same poses in every run; time: with --realtime, improve poses while none arrives")
      ->check(CLI::IsMember({"iterations", "time"}))
      ->capture_default_str();
  app.add_option("--seed", options.seed, "seed of random numbers; kept in run.json")->capture_default_str();
  app.add_option("--what-if", options.what_if,
                 "YAML file with other thresholds (section decision); what they would decide goes to OUTPUT/what_if");
  svort::bind_options(app, options.server.pipeline);
  options.server.decision.visit(svort::options_detail::CommandLineBinder(app, "Options: decision", "decision."));
  return run_program(app, argc, argv, [&] {
    if (options.bag.empty() == options.input.stacks.empty())
      throw std::invalid_argument("give either --bag or --stacks");
    if (!options.bag.empty() && !options.input.masks.empty())
      throw std::invalid_argument("--masks goes with --stacks; a bag holds its masks itself");
    if (guide->count() > 0) {
      network.guide = true;
      network.weights = guide_weights;
    }
    if (weights->count() + name->count() > 0 && !network.candidate && !network.guide)
      options.server.pipeline.estimator.method = "network";
    const svort::EstimatorOptions& estimator = options.server.pipeline.estimator;
    if (estimator.method != "network" && estimator.network.device == "cuda")
      throw std::invalid_argument("--device cuda: estimator '" + estimator.method + "' runs on the CPU only");
    const ReplaySummary summary = replay(options);
    std::printf("%zu slices: %zu kept, %zu rejected; %.1f s", summary.arrivals, summary.kept,
                summary.arrivals - summary.kept, summary.wall_s);
    if (summary.scan_s > 0.) std::printf(" (%.1f times the scanner's pace)", summary.scan_s / summary.wall_s);
    std::printf("; poses are %s\n", options.server.pipeline.estimator.method.c_str());
    for (const std::string& warning : summary.warnings) std::fprintf(stderr, "WARNING: %s\n", warning.c_str());
    for (const auto& folder : summary.folders) std::printf("results: %s\n", folder.c_str());
    if (summary.kept > 0) return 0;
    std::fprintf(stderr, "%s: no slice was kept; updates.csv has the reasons\n", app.get_name().c_str());
    return kBadInput;
  });
}

int run_nifti_to_bag(int argc, char** argv) {
  CLI::App app("Writes NIfTI stacks as a bag of slice messages, in the order of acquisition.", "nifti_to_bag");
  StackInput input;
  std::string output;
  std::string topic = kSliceTopic;
  add_stack_options(app, input);
  app.get_option("--stacks")->required();
  app.add_option("--output", output, "the bag")->required();
  app.add_option("--topic", topic, "topic of the slices in the bag")->capture_default_str();
  app.add_option("--scanner-frame", input.scanner_frame, "header.frame_id of the slices")->capture_default_str();
  return run_program(app, argc, argv, [&] {
    const std::vector<Slice> messages = read_messages(input);
    write_slices(output, messages, topic);
    std::printf("%s: %zu slices on topic %s\n", output.c_str(), messages.size(), topic.c_str());
    return 0;
  });
}

}  // namespace svort_ros
