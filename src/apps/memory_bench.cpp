#include "memory_bench.h"

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <iostream>
#include <stdexcept>

#include "bench_support.h"
#include "svort_ros/decision/decision_engine.h"
#include "svort_ros/live/live_pipeline.h"
#include "svort_ros/live/threads.h"
#include "svort_ros/simulation/brain_volume.h"
#include "svort_ros/simulation/scan_simulator.h"
#include "svort_ros/simulation/scan_slices.h"

namespace svort {

const char* const kMemoryBenchUsage =
    "       svort_bench memory [--slices N] [--scan N] [--threads N] [--limit-mb N] [--seed N]\n"
    "Feeds small slices of a simulated scan (registration, volumes, decisions) to the live pipeline again and again, "
    "as\n"
    "scans that end by another scan id or, every third, by a reset, and prints the memory of the process. Fails if it\n"
    "grows by more than the limit after the first fifth of the slices.\n"
    "  --slices    in all, default 5000\n"
    "  --scan      slices per scan, default 90; the last line says what a slice of a scan takes\n"
    "  --threads   default 1\n"
    "  --limit-mb  default 16\n"
    "  --seed      of the simulated scan, default 1\n";

namespace {

constexpr int kVolumeEvery = 8;  // slices; the node's default
constexpr int kLines = 20;

struct Options {
  std::int64_t slices = 5000;
  std::int64_t scan = 90;
  std::int64_t threads = 1;
  std::int64_t limit_mb = 16;
  std::uint64_t seed = 1;
};

Options parse(const std::vector<std::string>& arguments) {
  Options options;
  for (std::size_t i = 0; i < arguments.size(); i += 2) {
    const std::string& name = arguments[i];
    if (i + 1 == arguments.size()) throw std::invalid_argument(name + " is unknown or needs a value");
    const auto value = [&](std::int64_t largest) { return positive_integers(name, arguments[i + 1], largest).front(); };
    if (name == "--slices")
      options.slices = value(1000000);
    else if (name == "--scan")
      options.scan = value(1000000);
    else if (name == "--threads")
      options.threads = value(1024);
    else if (name == "--limit-mb")
      options.limit_mb = value(1000000);
    else if (name == "--seed")
      options.seed = static_cast<std::uint64_t>(value(1000000));
    else
      throw std::invalid_argument(name + " is unknown");
  }
  return options;
}

/// Slices of 40 x 40 pixels of 3 mm: what stays behind of a slice does not depend on its size alone.
constexpr int kSizePx = 40;
constexpr double kPixelMm = 3.;

std::vector<Slice> simulated_slices(std::uint64_t seed) {
  SimulatorOptions how;
  how.motion = "mild";
  how.size_px = kSizePx;
  how.resolution_mm = kPixelMm;
  how.prepared = false;
  how.anatomies = how.scans_per_anatomy = 1;
  how.scanner.stacks_min = how.scanner.stacks_max = 3;
  how.artifacts.drop_share = how.artifacts.mask_lost_share = 0.;
  NetworkGrid grid;
  grid.resolution_mm = kPixelMm;
  grid.volume_shape.fill(kSizePx);
  return scan_slices(ScanSimulator({make_phantom({})}, grid, how, seed).simulate(0, 1).front());
}

PipelineOptions pipeline_options() {
  PipelineOptions options;
  options.sequence.size_px = kSizePx;
  options.sequence.resolution_mm = kPixelMm;
  options.estimator.volume_resolution_mm = options.estimator.registration.finest_mm =
      options.estimator.final_volume.resolution_mm = kPixelMm;
  return options;
}

/// The same slices over and over, as further stacks, until the scan has so many.
class EndlessScan {
 public:
  explicit EndlessScan(std::vector<Slice> slices) : slices_(std::move(slices)) {}

  Slice slice(std::int64_t number, const std::string& scan_id) const {
    const auto count = static_cast<std::int64_t>(slices_.size());
    const std::int64_t round = number / count;
    Slice slice = slices_[static_cast<std::size_t>(number % count)];
    slice.info.scan_id = scan_id;
    slice.info.stack += static_cast<int>(round) * (slices_.back().info.stack + 1);
    slice.info.stamp_ns += round * (slices_.back().info.stamp_ns - slices_.front().info.stamp_ns + 10000000000);
    return slice;
  }

 private:
  std::vector<Slice> slices_;
};

}  // namespace

void run_memory_bench(const std::vector<std::string>& arguments) {
  const Options options = parse(arguments);
  set_thread_count(static_cast<int>(options.threads));
  const EndlessScan scan(simulated_slices(options.seed));
  LivePipeline pipeline(pipeline_options());
  DecisionEngine decisions{DecisionOptions()};
  const auto end_scan = [&] {
    pipeline.finalise();
    decisions.update(pipeline);
    decisions.clear();
  };

  std::int64_t kept = 0, in_scan = 0, scans = 1;
  double settled_mb = 0., first_of_scan_mb = resident_memory_mb();
  for (std::int64_t i = 1; i <= options.slices; ++i) {
    if (in_scan == options.scan) {
      end_scan();
      if (scans % 3 == 0) pipeline.reset();  // else the next scan id ends it
      ++scans;
      in_scan = 0;
      first_of_scan_mb = resident_memory_mb();
    }
    const Slice slice = scan.slice(in_scan++, "scan_" + std::to_string(scans));
    const Arrival arrival = pipeline.add(slice);
    if (is_kept(arrival.status)) ++kept;
    JournalEntry entry;
    entry.info = slice.info;
    entry.status = arrival.status;
    entry.reason = arrival.reason;
    pipeline.journal().add(entry);
    if (i % kVolumeEvery == 0) {
      pipeline.update_volume();
      decisions.update(pipeline);
    }
    const double now_mb = resident_memory_mb();
    if (settled_mb == 0. && 5 * i >= options.slices) settled_mb = now_mb;
    if (i % std::max<std::int64_t>(1, options.slices / kLines) == 0)
      std::cout << R"({"benchmark": "memory", "slices": )" << i << R"(, "kept": )" << kept << R"(, "scan": )" << scans
                << R"(, "slices_in_scan": )" << in_scan << R"(, "resident_mb": )" << now_mb << "}" << std::endl;
  }
  const double last_mb = resident_memory_mb();
  end_scan();
  const double growth_mb = resident_memory_mb() - settled_mb;
  std::cout << R"({"benchmark": "memory", "slices": )" << options.slices << R"(, "scans": )" << scans
            << R"(, "growth_mb": )" << growth_mb << R"(, "limit_mb": )" << options.limit_mb
            << R"(, "kb_per_slice_of_last_scan": )"
            << 1024. * (last_mb - first_of_scan_mb) / static_cast<double>(in_scan) << R"(, "peak_memory_mb": )"
            << peak_memory_mb() << "}" << std::endl;
  if (growth_mb > static_cast<double>(options.limit_mb))
    throw std::runtime_error("memory has grown by " + std::to_string(growth_mb) + " MB after the first fifth of the " +
                             std::to_string(options.slices) + " slices; the limit is " +
                             std::to_string(options.limit_mb) + " MB");
}

}  // namespace svort
