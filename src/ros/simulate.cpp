#include "svort_ros/ros/simulate.h"

#include <torch/types.h>

#include <CLI/CLI.hpp>
#include <algorithm>
#include <cmath>
#include <cstdio>
#include <exception>
#include <nlohmann/json.hpp>
#include <sstream>
#include <stdexcept>

#include "svort_ros/io/atomic_file.h"
#include "svort_ros/io/brain_volume_file.h"
#include "svort_ros/io/closed_loop.h"
#include "svort_ros/io/nifti.h"
#include "svort_ros/io/options_file.h"
#include "svort_ros/io/simulation_plot.h"
#include "svort_ros/io/tables.h"
#include "svort_ros/live/threads.h"
#include "svort_ros/ros/bag.h"
#include "svort_ros/ros/conversions.h"
#include "svort_ros/ros/names.h"
#include "svort_ros/simulation/scan_slices.h"

namespace svort_ros {
namespace {

namespace fs = std::filesystem;

constexpr int kBadInput = 2;

/// A stack as a NIfTI volume; slices are counted along their normal.
svort::Volume stack_volume(const std::vector<svort::Slice>& slices, int stack, double spacing_mm, bool mask) {
  svort::Volume volume;
  svort::Pose first = svort::Pose::Identity(), last = first;
  for (const svort::Slice& slice : slices) {
    const svort::SliceInfo& info = slice.info;
    if (info.stack != stack) continue;
    if (info.index == 0) first = info.T_scanner_slice;
    if (info.index == info.slices_in_stack - 1) last = info.T_scanner_slice;
    volume.grid.size = {info.columns, info.rows, info.slices_in_stack};
    volume.grid.spacing = {info.pixel_spacing.x(), info.pixel_spacing.y(), spacing_mm};
    volume.values.resize(volume.grid.voxel_count());
    float* out = volume.values.data() + volume.grid.offset(0, 0, info.index);
    if (mask)
      std::copy(slice.mask.begin(), slice.mask.end(), out);
    else
      std::copy(slice.pixels.begin(), slice.pixels.end(), out);
  }
  volume.grid.T_frame_grid = first;
  volume.grid.T_frame_grid.translation() = 0.5 * (first.translation() + last.translation());
  return volume;
}

/// Shortest text that reads back as the same number.
std::string number(double value) {
  std::ostringstream text;
  text.precision(17);
  text << value;
  return text.str();
}

void remove_file(const fs::path& path) {
  std::error_code ignored;
  fs::remove(path, ignored);
}

}  // namespace

SimulateOptions::SimulateOptions() {
  simulator.motion = "moderate";
  simulator.size_px = 128;
  simulator.resolution_mm = 1.;
  simulator.prepared = false;
  simulator.anatomies = simulator.scans_per_anatomy = 1;
  simulator.anatomy = svort::no_anatomy_variation();
  simulator.scanner.stacks_min = simulator.scanner.stacks_max = 3;
  // NIfTI files hold neither pauses nor, without losing the order of acquisition, slices counted backwards.
  simulator.scanner.pause_max_s = 0.;
  simulator.scanner.reversed_share = 0.;
}

std::vector<svort::BrainVolume> brain_volumes(const SimulateOptions& options) {
  if (options.volumes.empty()) {
    if (!options.masks.empty() || !options.parcellations.empty())
      throw std::invalid_argument("--mask and --parcellation need a --volume");
    return {svort::make_phantom(options.phantom)};
  }
  const auto check_count = [&](const std::vector<std::string>& files, const char* name) {
    if (!files.empty() && files.size() != options.volumes.size())
      throw std::invalid_argument(std::string(name) + ": " + std::to_string(files.size()) + " files for " +
                                  std::to_string(options.volumes.size()) + " volumes; give one each, or none");
  };
  check_count(options.masks, "--mask");
  check_count(options.parcellations, "--parcellation");
  std::vector<svort::BrainVolume> volumes;
  for (std::size_t i = 0; i < options.volumes.size(); ++i)
    volumes.push_back(svort::read_brain_volume(options.volumes[i], options.masks.empty() ? "" : options.masks[i],
                                               options.parcellations.empty() ? "" : options.parcellations[i]));
  return volumes;
}

std::vector<std::string> simulate(const SimulateOptions& options) {
  const svort::SimulatorOptions& simulator_options = options.simulator;
  if (simulator_options.prepared) throw std::invalid_argument("prepared: files hold whole slices; it must be false");
  if (simulator_options.scanner.pause_max_s > 0. || simulator_options.scanner.reversed_share > 0.)
    throw std::invalid_argument(
        "scanner.pause_max_s and scanner.reversed_share must be 0: NIfTI files cannot say them");
  if (simulator_options.scanner.prefix_share > 0.)
    throw std::invalid_argument("scanner.prefix_share must be 0: a NIfTI file holds a whole stack");
  svort::NetworkGrid grid;
  grid.resolution_mm = simulator_options.resolution_mm;
  // A cube that holds the slices.
  grid.volume_shape.fill(simulator_options.size_px);
  svort::ScanSimulator simulator(brain_volumes(options), grid, simulator_options, options.seed);
  const svort::SimulatedScan scan = simulator.simulate(options.scan, 1)[0];
  svort::ScanSlicesOptions as_scanned;
  as_scanned.scan_id = options.scan_id;
  const std::vector<svort::Slice> slices = svort::scan_slices(scan, as_scanned);

  const fs::path folder = options.output;
  fs::create_directories(folder);
  remove_file(folder / "scan.json");  // it comes last, and stands for a complete set
  std::vector<std::string> replay{"svort_replay", "--stacks"};
  std::vector<std::string> masks;
  for (int stack = 0; stack < scan.plan.stacks; ++stack) {
    const fs::path image = folder / ("stack_" + std::to_string(stack) + ".nii.gz"),
                   mask = folder / ("mask_" + std::to_string(stack) + ".nii.gz");
    svort::write_nifti(image, stack_volume(slices, stack, scan.plan.spacing_mm, false));
    svort::write_nifti(mask, stack_volume(slices, stack, scan.plan.spacing_mm, true));
    replay.push_back(image.string());
    masks.push_back(mask.string());
  }
  for (int stack = scan.plan.stacks; fs::exists(folder / ("stack_" + std::to_string(stack) + ".nii.gz")); ++stack)
    for (const char* kind : {"stack_", "mask_"}) remove_file(folder / (kind + std::to_string(stack) + ".nii.gz"));
  replay.emplace_back("--masks");
  replay.insert(replay.end(), masks.begin(), masks.end());
  for (const std::string& word :
       {std::string("--scan-id"), options.scan_id, std::string("--interleave"), std::to_string(scan.plan.interleave),
        std::string("--tr"), number(scan.plan.tr_s), std::string("--thickness"), number(scan.plan.thickness_mm)})
    replay.push_back(word);

  std::vector<Slice> messages;
  std::vector<svort::PoseRow> truth;
  const auto flag = [](const torch::Tensor& flags, std::size_t i) {
    return flags[static_cast<std::int64_t>(i)].item<bool>();
  };
  for (std::size_t i = 0; i < slices.size(); ++i) {
    if (scan.dropped[i]) continue;
    messages.push_back(to_msg(slices[i], "scanner"));
    svort::PoseRow row;
    row.scan_id = options.scan_id;
    row.stack = slices[i].info.stack;
    row.slice = slices[i].info.index;
    row.stamp_ns = slices[i].info.stamp_ns;
    row.T_brain_slice = scan.plan.acquired[i].T_brain_slice();
    row.displaced = flag(scan.displaced, i);
    row.voided = flag(scan.voided, i);
    row.noisy = flag(scan.noisy, i);
    truth.push_back(row);
  }
  write_slices(folder / "scan.bag", messages, kSliceTopic);
  svort::write_truth_table(folder / "truth.csv", truth);
  svort::write_nifti(folder / "volume.nii.gz", svort::to_volume(scan.volume, grid.resolution_mm));
  svort::plot_simulated_scan(folder / "scan.png", scan,
                             "Simulated scan, " + scan.motion + " motion, seed " + std::to_string(options.seed) +
                                 ", scan " + std::to_string(options.scan));

  nlohmann::ordered_json json;
  json["program"] = "svort_simulate";
  json["volumes"] = options.volumes;
  json["masks"] = options.masks;
  json["parcellations"] = options.parcellations;
  json["volume_index"] = scan.volume_index;
  if (options.volumes.empty()) json["phantom"] = svort::options_to_json(options.phantom);
  json["seed"] = options.seed;
  json["scan"] = options.scan;
  json["motion"] = scan.motion;
  json["stacks"] = scan.plan.stacks;
  json["slices"] = scan.plan.slices;
  json["dropped"] = slices.size() - truth.size();
  json["thickness_mm"] = scan.plan.thickness_mm;
  json["spacing_mm"] = scan.plan.spacing_mm;
  json["tr_s"] = scan.plan.tr_s;
  json["interleave"] = scan.plan.interleave;
  json["options"] = svort::options_to_json(simulator_options);
  svort::write_file(folder / "scan.json", json.dump(2) + "\n");
  return replay;
}

namespace {

struct ClosedLoopCommand {
  std::vector<std::string> motions = {"mild", "moderate", "severe"};
  std::vector<std::string> strategies = {"none", "whole_stacks", "end_of_stack", "requests"};
  int seeds = 10;
  int threads = 1;
  svort::ClosedLoopOptions options;
};

/// Every motion class, seed and strategy; the table so far is on the disk after each scan.
void run_closed_loops(const SimulateOptions& simulation, const ClosedLoopCommand& command) {
  using svort::RepeatStrategy;
  std::vector<RepeatStrategy> strategies;
  for (const std::string& name : command.strategies) {
    const auto known = {RepeatStrategy::none, RepeatStrategy::whole_stacks, RepeatStrategy::end_of_stack,
                        RepeatStrategy::requests};
    const auto* found =
        std::find_if(known.begin(), known.end(), [&](RepeatStrategy each) { return name == svort::to_string(each); });
    if (found == known.end())
      throw std::invalid_argument("--strategies: '" + name +
                                  "' is unknown; there are none, whole_stacks, end_of_stack and requests");
    strategies.push_back(*found);
  }
  if (command.seeds < 1) throw std::invalid_argument("--seeds must be at least 1");
  for (const std::string& motion : command.motions) svort::motion_class(motion);  // throws if unknown
  svort::set_thread_count(command.threads);
  const std::vector<svort::BrainVolume> brains = brain_volumes(simulation);
  fs::create_directories(simulation.output);
  std::vector<svort::ClosedLoopResult> results;
  for (int i = 0; i < command.seeds; ++i)
    for (const std::string& motion : command.motions)
      for (const RepeatStrategy strategy : strategies) {
        const std::uint64_t seed = simulation.seed + static_cast<std::uint64_t>(i);
        results.push_back(svort::run_closed_loop(brains[static_cast<std::size_t>(i) % brains.size()], motion, seed,
                                                 strategy, command.options));
        const svort::ClosedLoopResult& r = results.back();
        std::fprintf(stderr, "%-8s seed %2llu %-12s scan %4.0f s, %3d repeats, volume error %.3f, poses %.2f mm\n",
                     motion.c_str(), static_cast<unsigned long long>(seed), svort::to_string(strategy), r.scan_s,
                     r.repeats, r.volume_error, r.pose_error_mm);
        svort::write_file(fs::path(simulation.output) / "closed_loop.csv", svort::to_csv(results));
      }
  const std::string table = svort::to_markdown(results);
  svort::write_file(fs::path(simulation.output) / "closed_loop.md", table);
  std::fputs(table.c_str(), stdout);
}

}  // namespace

int run_svort_simulate(int argc, char** argv) {
  CLI::App app(
      "Simulates a scan of a moving fetal brain, with its truth: stacks and masks (NIfTI), a bag, truth.csv, a "
      "picture.",
      "svort_simulate");
  SimulateOptions options;
  std::string bank;
  bool phantom = false;
  auto* volume = app.add_option("--volume", options.volumes, "NIfTI file of a brain; several: scans take turns");
  app.add_option("--mask", options.masks, "its brain mask; without, voxels above 0 are brain");
  app.add_option("--parcellation", options.parcellations, "its tissue labels, for --anatomy.contrast");
  app.add_flag("--phantom", phantom, "the built-in phantom instead of a file")->excludes(volume);
  app.add_option("--seed", options.seed, "of all random numbers")->capture_default_str();
  app.add_option("--scan", options.scan, "number of the scan: same seed, another scan")->capture_default_str();
  app.add_option("--scan-id", options.scan_id, "identifies the examination")->capture_default_str();
  auto* output = app.add_option("--output", options.output, "folder for the scan; made if needed");
  auto* save = app.add_option("--save-volumes", bank,
                              "only write the volumes into this one file, for machines without a NIfTI library");
  output->excludes(save);
  ClosedLoopCommand loops;
  bool closed_loop = false;
  const char* const kLoop = "Closed loop";
  auto* loop_flag = app.add_flag("--closed-loop", closed_loop,
                                 "scans in which the scanner obeys the requests, against other ways to repeat slices")
                        ->group(kLoop)
                        ->excludes(save);
  app.add_option("--seeds", loops.seeds, "scans per motion class and strategy, from --seed on")
      ->group(kLoop)
      ->needs(loop_flag)
      ->capture_default_str();
  app.add_option("--motions", loops.motions, "motion classes")->group(kLoop)->needs(loop_flag)->capture_default_str();
  app.add_option("--strategies", loops.strategies, "none, whole_stacks, end_of_stack, requests")
      ->group(kLoop)
      ->needs(loop_flag)
      ->capture_default_str();
  app.add_option("--threads", loops.threads, "threads of the estimator; 0 takes all cores")
      ->group(kLoop)
      ->needs(loop_flag)
      ->capture_default_str();
  loops.options.decision.visit(svort::options_detail::CommandLineBinder(app, "Closed loop: decision", "decision."));
  svort::bind_options(app, options.simulator);
  options.phantom.visit(svort::options_detail::CommandLineBinder(app, "Options: phantom", "phantom."));
  try {
    app.parse(argc, argv);
    if (!phantom && options.volumes.empty()) throw std::invalid_argument("give a --volume, or --phantom");
    if (bank.empty() == options.output.empty()) throw std::invalid_argument("give --output, or --save-volumes");
    if (!bank.empty()) {
      const auto volumes = brain_volumes(options);
      svort::save_brain_volumes(bank, volumes);
      std::printf("%zu volumes in %s\n", volumes.size(), bank.c_str());
      return 0;
    }
    if (closed_loop) {
      run_closed_loops(options, loops);
      return 0;
    }
    const std::vector<std::string> replay = simulate(options);
    std::printf("Replay it with\n ");
    for (const std::string& word : replay) std::printf(" %s", word.c_str());
    std::printf(
        " --output RESULTS\nor\n  svort_replay --bag %s --output RESULTS\nand score the poses with\n"
        "  svort_evaluate --poses RESULTS/poses.csv --truth %s\n",
        (fs::path(options.output) / "scan.bag").c_str(), (fs::path(options.output) / "truth.csv").c_str());
    return 0;
  } catch (const CLI::ParseError& error) {
    return app.exit(error) == 0 ? 0 : kBadInput;  // 0: help was asked for
  } catch (const std::exception& error) {
    std::fprintf(stderr, "%s: %s\n", app.get_name().c_str(), error.what());
    return kBadInput;
  }
}

}  // namespace svort_ros
