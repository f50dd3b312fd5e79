#include "live_bench.h"

#include <ATen/Parallel.h>
#include <torch/types.h>

#include <algorithm>
#include <chrono>
#include <cmath>
#include <cstdint>
#include <iostream>
#include <iterator>
#include <stdexcept>
#include <thread>

#include "bench_support.h"
#include "svort_ros/decision/decision_engine.h"
#include "svort_ros/live/live_pipeline.h"
#include "svort_ros/live/sequence_tensors.h"
#include "svort_ros/live/threads.h"
#include "svort_ros/metrics/pose_error.h"
#include "svort_ros/registration/pose_refinement.h"
#include "svort_ros/simulation/brain_volume.h"
#include "svort_ros/simulation/scan_simulator.h"
#include "svort_ros/simulation/scan_slices.h"

namespace svort {

const char* const kLiveBenchUsage =
    "       svort_bench live [--slices N,..] [--stacks N] [--threads N] [--full N] [--volumes yes|no] [--seed N]\n"
    "                        [--weights FILE]\n"
    "Feeds a simulated scan to the live pipeline (registration) and times each slice: arrival to pose (ms; median, 95 "
    "%\n"
    "quantile and largest since the first slice), the mean of the last 15, arrival to volume and to the decisions "
    "(head\n"
    "motion, slice quality, coverage, reacquisition) that follow it. Ratios compare with registering all slices again\n"
    "per arrival from the last poses (full_over_this) and from the scanner's poses, as at the end of a scan\n"
    "(rerun_over_this). Last line: how far the poses of both updates are from each other, and from the truth, once "
    "the\n"
    "scan has ended.\n"
    "  --slices   kept slices at which a line is printed, default 15,45,90,450\n"
    "  --stacks   stacks per scan, 1 to 6, default 3; scans follow one another as stacks of one scan\n"
    "  --threads  default: all cores\n"
    "  --full     run the same with all slices registered again per arrival, up to so many slices; default 90\n"
    "  --volumes  also estimate the volume and decide after each slice, default yes\n"
    "  --search   also search the scan in the background for a head that has jumped, default yes\n"
    "  --interval ms from one slice to the next, default 0: as fast as they are answered; the answer of a search that\n"
    "             is not ready after so many slices is waited for, so that with 0 arrivals take longer than they do "
    "live\n"
    "  --seed     of the simulated scan, default 1\n"
    "  --weights  of the live network: lines of registration that it guides, too, and the slices that it encodes per "
    "arrival\n";

namespace {

using Clock = std::chrono::steady_clock;

struct Options {
  std::vector<std::int64_t> slices = {15, 45, 90, 450};
  std::int64_t stacks = 3;
  std::int64_t threads = at::get_num_threads();
  std::int64_t full = 90;
  bool volumes = true, search = true;
  std::int64_t interval_ms = 0;
  std::uint64_t seed = 1;
  std::string weights;
};

Options parse(const std::vector<std::string>& arguments) {
  Options options;
  for (std::size_t i = 0; i < arguments.size(); i += 2) {
    const std::string& name = arguments[i];
    if (i + 1 == arguments.size()) throw std::invalid_argument(name + " is unknown or needs a value");
    const std::string& value = arguments[i + 1];
    if (name == "--slices")
      options.slices = positive_integers(name, value, 5000);
    else if (name == "--stacks")
      options.stacks = positive_integers(name, value, 6).front();
    else if (name == "--threads")
      options.threads = positive_integers(name, value, 1024).front();
    else if (name == "--full")
      options.full = positive_integers(name, value, 5000).front();
    else if (name == "--search" && (value == "yes" || value == "no"))
      options.search = value == "yes";
    else if (name == "--interval")
      options.interval_ms = positive_integers(name, value, 60000).front();
    else if (name == "--seed")
      options.seed = static_cast<std::uint64_t>(positive_integers(name, value, 1000000).front());
    else if (name == "--weights")
      options.weights = value;
    else if (name == "--volumes" && (value == "yes" || value == "no"))
      options.volumes = value == "yes";
    else
      throw std::invalid_argument(name + " " + value + " is unknown");
  }
  std::sort(options.slices.begin(), options.slices.end());
  return options;
}

/// A slice, and where it lies.
struct KnownSlice {
  Slice slice;
  Pose T_brain_slice = Pose::Identity();
};

/// Scans of one head (the built-in phantom), one after another, as stacks of one scan.
class Slices {
 public:
  explicit Slices(const Options& options) : simulator_(simulator(options)) {}

  KnownSlice next() {
    if (at_ == scan_.size()) {
      const std::int64_t start_ns = scan_.empty() ? 1000000000 : scan_.back().slice.info.stamp_ns + 10000000000;
      const int first_stack = scan_.empty() ? 0 : scan_.back().slice.info.stack + 1;
      const SimulatedScan scan = simulator_.simulate(number_++, 1).front();
      ScanSlicesOptions how;
      how.scan_id = "benchmark";
      how.start_ns = start_ns;
      scan_.clear();
      std::size_t i = 0;
      for (Slice& slice : scan_slices(scan, how)) {
        slice.info.stack += first_stack;
        if (!scan.dropped[i]) scan_.push_back({std::move(slice), scan.plan.acquired[i].T_brain_slice()});
        ++i;
      }
      at_ = 0;
    }
    return scan_[at_++];
  }

 private:
  static ScanSimulator simulator(const Options& options) {
    SimulatorOptions how;
    how.motion = "moderate";
    how.size_px = 128;
    how.resolution_mm = 1.;
    how.prepared = false;
    how.anatomies = how.scans_per_anatomy = 1;
    how.scanner.stacks_min = how.scanner.stacks_max = static_cast<int>(options.stacks);
    NetworkGrid grid;
    grid.resolution_mm = 1.;
    grid.volume_shape.fill(128);
    return ScanSimulator({make_phantom({})}, grid, how, options.seed);
  }

  ScanSimulator simulator_;
  std::uint64_t number_ = 0;
  std::vector<KnownSlice> scan_;
  std::size_t at_ = 0;
};

double quantile(std::vector<double> values, double share) {
  const auto rank = static_cast<std::ptrdiff_t>(std::ceil(share * static_cast<double>(values.size()))) - 1;
  const auto nth = values.begin() + std::max<std::ptrdiff_t>(0, rank);
  std::nth_element(values.begin(), nth, values.end());
  return *nth;
}

double milliseconds_since(Clock::time_point start) {
  return std::chrono::duration<double, std::milli>(Clock::now() - start).count();
}

/// What the other update needed at each entry of options.slices that it reached.
struct Baseline {
  std::vector<double> last_15_ms;  ///< mean of the last 15 arrivals
  std::vector<double> rerun_ms;    ///< registering all slices from the scanner's poses
};

std::size_t searched_for(const LivePipeline& pipeline) {
  const auto& slices = pipeline.estimate().slices;
  return static_cast<std::size_t>(
      std::count_if(slices.begin(), slices.end(), [](const SliceEstimate& slice) { return slice.start == "search"; }));
}

double rerun_ms(const LivePipeline& pipeline) {
  const RegistrationInput input = registration_input(pipeline.sequence());
  const Clock::time_point start = Clock::now();
  refine_poses(input, input.T_world_slice, PipelineOptions().estimator.registration);
  return milliseconds_since(start);
}

/// @param weights of the live network that guides registration; empty: none
/// @param baseline of the other update; empty: none
Baseline run(const Options& options, const std::string& update, const std::string& weights, const Baseline& baseline) {
  PipelineOptions pipeline_options;
  pipeline_options.estimator.update = update;
  pipeline_options.estimator.network.guide = !weights.empty();
  pipeline_options.estimator.network.weights = weights;
  if (!options.search) pipeline_options.estimator.search_every = 0;
  LivePipeline pipeline(pipeline_options);
  DecisionEngine decisions{DecisionOptions()};
  Slices slices(options);
  std::vector<double> pose_ms, volume_ms, decision_ms, encoded;
  std::size_t network_starts = 0;
  Baseline measured;
  const bool full = update == "full";
  Clock::time_point next_arrival = Clock::now();
  const std::int64_t last = full ? std::min(options.full, options.slices.back()) : options.slices.back();
  for (const std::int64_t count : options.slices) {
    if (count > last) break;
    while (static_cast<std::int64_t>(pose_ms.size()) < count) {
      const Slice slice = slices.next().slice;
      if (!full) std::this_thread::sleep_until(next_arrival);
      next_arrival = Clock::now() + std::chrono::milliseconds(options.interval_ms);
      const Clock::time_point arrived = Clock::now();
      if (!is_kept(pipeline.add(slice).status)) continue;
      pose_ms.push_back(milliseconds_since(arrived));
      encoded.push_back(static_cast<double>(pipeline.estimate().encoded));
      if (pipeline.newest()->start.rfind("network", 0) == 0) ++network_starts;
      if (!options.volumes) continue;
      pipeline.update_volume();
      volume_ms.push_back(milliseconds_since(arrived));
      decisions.update(pipeline);
      decision_ms.push_back(milliseconds_since(arrived));
    }
    const auto recent = pose_ms.end() - std::min<std::ptrdiff_t>(15, static_cast<std::ptrdiff_t>(pose_ms.size()));
    double mean = 0.;
    for (auto ms = recent; ms != pose_ms.end(); ++ms) mean += *ms / static_cast<double>(pose_ms.end() - recent);
    measured.last_15_ms.push_back(mean);
    const std::size_t at = measured.last_15_ms.size() - 1;
    std::cout << R"({"benchmark": "live", "update": ")" << update << R"(", "network": )"
              << (weights.empty() ? "false" : "true") << R"(, "slices": )" << count << R"(, "stacks_per_scan": )"
              << options.stacks << R"(, "threads": )" << options.threads << R"(, "interval_ms": )"
              << (full ? 0 : options.interval_ms) << R"(, "search": )" << (options.search && !full ? "true" : "false")
              << R"(, "searched_for": )" << searched_for(pipeline) << R"(, "pose_ms_median": )"
              << quantile(pose_ms, 0.5) << R"(, "pose_ms_p95": )" << quantile(pose_ms, 0.95) << R"(, "pose_ms_max": )"
              << quantile(pose_ms, 1.) << R"(, "pose_ms_last_15": )" << mean;
    if (options.volumes)
      std::cout << R"(, "volume_ms_median": )" << quantile(volume_ms, 0.5) << R"(, "volume_ms_p95": )"
                << quantile(volume_ms, 0.95) << R"(, "decision_ms_median": )" << quantile(decision_ms, 0.5)
                << R"(, "decision_ms_p95": )" << quantile(decision_ms, 0.95);
    if (!weights.empty())
      std::cout << R"(, "encoded_median": )" << quantile(encoded, 0.5) << R"(, "encoded_max": )"
                << quantile(encoded, 1.) << R"(, "network_starts": )" << network_starts;
    if (full) measured.rerun_ms.push_back(rerun_ms(pipeline));
    if (full) std::cout << R"(, "rerun_ms": )" << measured.rerun_ms.back();
    if (at < baseline.last_15_ms.size())
      std::cout << R"(, "full_over_this": )" << baseline.last_15_ms[at] / mean << R"(, "rerun_over_this": )"
                << baseline.rerun_ms[at] / mean;
    std::cout << R"(, "peak_memory_mb": )" << peak_memory_mb() << R"(, "cpu": ")" << processor() << R"("})"
              << std::endl;
  }
  return measured;
}

/// Poses once the scan has ended, in acquisition order, and the truth.
struct End {
  torch::Tensor poses, truth;
};

End end_of_scan(const Options& options, const std::string& update, std::int64_t count) {
  PipelineOptions pipeline_options;
  pipeline_options.estimator.update = update;
  pipeline_options.estimator.final_volume.passes = 0;  // poses are what is compared
  LivePipeline pipeline(pipeline_options);
  Slices slices(options);
  std::vector<Pose> poses, truth;
  while (static_cast<std::int64_t>(truth.size()) < count) {
    const KnownSlice next = slices.next();
    if (is_kept(pipeline.add(next.slice).status)) truth.push_back(next.T_brain_slice);
  }
  pipeline.finalise();
  for (const SliceEstimate& slice : pipeline.estimate().slices) poses.push_back(slice.T_brain_slice);
  return {poses_tensor(poses), poses_tensor(truth)};
}

/// Whether what was gained while the scan ran costs anything at its end.
void compare_ends(const Options& options) {
  const std::int64_t count = std::min(options.full, options.slices.back());
  const End incremental = end_of_scan(options, "incremental", count), full = end_of_scan(options, "full", count);
  const PoseErrors difference = relative_pose_errors(incremental.poses, full.poses, AnchorFrame());
  const auto error_mm = [](const End& end) {
    return summarise(relative_pose_errors(end.poses, end.truth, AnchorFrame()).ed).mean;
  };
  const ErrorSummary mm = summarise(difference.ed);
  std::cout << R"({"benchmark": "live", "slices": )" << count << R"(, "final_difference_mm": )" << mm.mean
            << R"(, "final_difference_mm_median": )" << mm.median << R"(, "final_difference_mm_max": )" << mm.maximum
            << R"(, "final_difference_deg": )" << summarise(difference.gd).mean * 180. / M_PI
            << R"(, "final_error_mm_incremental": )" << error_mm(incremental) << R"(, "final_error_mm_full": )"
            << error_mm(full) << "}" << std::endl;
}

}  // namespace

void run_live_bench(const std::vector<std::string>& arguments) {
  const Options options = parse(arguments);
  set_thread_count(static_cast<int>(options.threads));
  const Baseline full = run(options, "full", "", {});
  run(options, "incremental", "", full);
  if (!options.weights.empty()) run(options, "incremental", options.weights, full);
  compare_ends(options);
}

}  // namespace svort
