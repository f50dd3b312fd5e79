#include <CLI/CLI.hpp>
#include <algorithm>
#include <cmath>
#include <cstdio>
#include <exception>
#include <map>
#include <sstream>
#include <stdexcept>

#include "accuracy_columns.h"
#include "svort_ros/evaluation/left_out.h"
#include "svort_ros/io/accuracy_table.h"
#include "svort_ros/io/atomic_file.h"
#include "svort_ros/io/brain_templates.h"
#include "svort_ros/io/brain_volume_file.h"
#include "svort_ros/io/nifti_stack.h"
#include "svort_ros/io/options_file.h"
#include "svort_ros/io/plots.h"
#include "svort_ros/live/threads.h"
#include "svort_ros/network/checkpoint.h"

namespace svort {
namespace {

namespace fs = std::filesystem;

constexpr int kBadInput = 2;

struct Plan {
  std::string brains, output, shipped;
  std::vector<std::string> test{"STA23", "STA27", "STA32", "STA36"};
  std::vector<std::string> motions{"mild", "moderate", "severe"};
  std::vector<std::string> methods;
  std::vector<std::string> real, real_masks;  ///< stacks of a real scan
  StackTimingOptions timing;                  ///< of the real scan
  std::vector<std::string> networks;          ///< NAME=FILE
  int scans = 2;
  std::uint64_t seed = 1;
  int threads = 0;
  PipelineOptions pipeline;
};

/// What is measured of each scan: the masks, the number of stacks, a method.
struct Task {
  bool damaged_masks;
  int stacks;
  PoseMethod method;
};

std::vector<Task> all_tasks(const Plan& plan) {
  const auto registration = [](const std::string& name) {
    return PoseMethod{name, PoseSource::registration, "", false, true};
  };
  std::vector<Task> tasks{{false, 3, {kNominalMethod, PoseSource::nominal, "", false, true}},
                          {false, 3, {"stack stage only", PoseSource::stacks, "", false, false}},
                          {false, 3, registration("registration")},
                          {true, 3, registration("registration with damaged masks")},
                          {false, 2, registration("registration of two stacks")},
                          {false, 1, registration("registration of one stack")},
                          {false, 3, {"live at arrival", PoseSource::live, "", false, false}}};
  for (const std::string& network : plan.networks) {
    const auto split = network.find('=');
    if (split == std::string::npos || split == 0 || split + 1 == network.size() || network.find(',') < split)
      throw std::invalid_argument("--network " + network + ": must be NAME=FILE, without a comma in the name");
    const std::string name = network.substr(0, split), file = network.substr(split + 1);
    tasks.push_back({false, 3, {name, PoseSource::network, file, false, true}});
    tasks.push_back({false, 3, {name + " then registration", PoseSource::network, file, true, true}});
    if (read_checkpoint(file).network != "live") continue;
    tasks.push_back({false, 3, {"registration guided by " + name, PoseSource::registration, file, false, true}});
    tasks.push_back({true, 3, {"the same with damaged masks", PoseSource::registration, file, false, true}});
    tasks.push_back({false, 1, {"the same of one stack", PoseSource::registration, file, false, true}});
    tasks.push_back({false, 3, {"live at arrival guided by " + name, PoseSource::live, file, false, false}});
  }
  return tasks;
}

std::string three_digits(double value) {
  char text[32];
  std::snprintf(text, sizeof text, "%.3f", value);
  return std::isfinite(value) ? text : "-";
}

fs::path volume_file(const fs::path& folder, const std::string& name) {
  for (const char* ending : {".nii.gz", ".nii"})
    if (fs::exists(folder / (name + ending))) return folder / (name + ending);
  throw std::runtime_error((folder / name).string() + ": no .nii.gz or .nii of this name");
}

void measure(const Plan& plan) {
  set_thread_count(plan.threads);
  fs::create_directories(plan.output);
  const fs::path csv = fs::path(plan.output) / "accuracy.csv";
  RowStore<AccuracyRow> store(csv, accuracy_columns());
  std::vector<Task> tasks = all_tasks(plan);
  const auto unwanted = [&](const Task& task) {
    return !plan.methods.empty() &&
           std::find(plan.methods.begin(), plan.methods.end(), task.method.name) == plan.methods.end();
  };
  tasks.erase(std::remove_if(tasks.begin(), tasks.end(), unwanted), tasks.end());

  AccuracySetup setup;
  setup.pipeline = plan.pipeline;
  setup.shipped = load_templates(plan.shipped);
  for (BrainTemplate& brain : load_templates(plan.brains))
    if (std::none_of(plan.test.begin(), plan.test.end(),
                     [&](const std::string& name) { return brain.name == name || brain.name == name + ".nii.gz"; }))
      setup.atlas.push_back(std::move(brain));

  std::vector<BrainVolume> brains;
  for (const std::string& name : plan.test) {
    const fs::path mask = fs::path(plan.brains) / (name + "_mask.nii.gz");
    brains.push_back(read_brain_volume(volume_file(plan.brains, name), fs::exists(mask) ? mask : fs::path()));
    brains.back().name = name;
  }
  TaskClock clock(static_cast<std::size_t>(plan.scans) * plan.motions.size() * brains.size() * tasks.size());
  // Scan by scan over all classes and brains, so that a table of few scans is already a fair one.
  for (int scan = 0; scan < plan.scans; ++scan)
    for (const std::string& motion : plan.motions)
      for (std::size_t b = 0; b < brains.size(); ++b) {
        std::map<std::pair<bool, int>, EvaluationScan> simulated;
        for (const Task& task : tasks) {
          EvaluationScanOptions options;
          options.motion = motion;
          options.stacks = task.stacks;
          options.damaged_masks = task.damaged_masks;
          options.seed = plan.seed;
          options.number = static_cast<std::uint64_t>(scan) * brains.size() + b;
          AccuracyRow row;
          row.brain = brains[b].name;
          row.motion = motion;
          row.number = options.number;
          row.masks = task.damaged_masks ? "damaged" : "usual";
          row.stacks = task.stacks;
          row.method = task.method.name;
          if (store.has(row)) {
            clock.skip();
            continue;
          }
          auto found = simulated.find({task.damaged_masks, task.stacks});
          if (found == simulated.end())
            found =
                simulated
                    .emplace(std::pair{task.damaged_masks, task.stacks}, simulate_evaluation_scan(brains[b], options))
                    .first;
          row = measure_accuracy(found->second, task.method, setup);
          store.add({row});
          write_file(fs::path(plan.output) / "accuracy.md", accuracy_markdown(store.rows()));
          plot_accuracy(fs::path(plan.output) / "accuracy.png", store.rows());
          std::fprintf(stderr,
                       "%s %-8s %2d %-7s %d %-28s rel ED %6.2f (%5.2f) GD %5.3f  ED %6.2f %6.2f frame %4.2f %4.2f  "
                       "psnr %5.2f %5.2f ssim %5.3f %5.3f  %5.1f s %4.0f ms%s (%s)\n",
                       row.brain.c_str(), row.motion.c_str(), static_cast<int>(row.number), row.masks.c_str(),
                       row.stacks, row.method.c_str(), row.relative_ed_mm, row.relative_median_ed_mm,
                       row.relative_gd_rad, row.atlas.ed_mm, row.shipped.ed_mm, row.atlas.frame_rad,
                       row.shipped.frame_rad, row.psf.psnr_db, row.final.psnr_db, row.psf.ssim, row.final.ssim,
                       row.seconds, row.p95_ms, row.converged ? "" : " not converged", clock.next().c_str());
        }
      }
}

/// A scan without known truth: how well its slices fit the volume, with the scanner's poses and with registration.
void measure_real(const Plan& plan) {
  set_thread_count(plan.threads);
  const fs::path folder = plan.output;
  fs::create_directories(folder);
  const std::vector<fs::path> stacks(plan.real.begin(), plan.real.end()),
      masks(plan.real_masks.begin(), plan.real_masks.end());
  const std::vector<Slice> slices = read_stacks(stacks, masks, "real", plan.timing);
  struct Run {
    const char *name, *method;
    int passes;
  };
  std::ostringstream table;
  table << "| poses | stack | slices | NCC with the volume of all stacks | NCC with that of the other stacks |\n"
           "|---|---|---|---|---|\n";
  for (const Run& run : {Run{"nominal", "nominal", plan.pipeline.estimator.final_volume.passes},
                         Run{"registration", "registration", plan.pipeline.estimator.final_volume.passes},
                         Run{"registration, PSF reconstruction", "registration", 0}}) {
    PipelineOptions options = plan.pipeline;
    options.estimator.method = run.method;
    options.estimator.final_volume.passes = run.passes;
    LivePipeline pipeline(options, load_templates(plan.shipped));
    for (const Slice& slice : slices) pipeline.add(slice);
    pipeline.finalise();
    for (const auto& [stack, correlation] : stack_correlations(pipeline))
      table << "| " << run.name << " | " << stack << " | " << correlation.slices << " | "
            << three_digits(correlation.with_all) << " | " << three_digits(correlation.with_others) << " |\n";
    std::string file = run.name;
    std::replace_if(
        file.begin(), file.end(), [](char c) { return c == ' ' || c == ','; }, '_');
    plot_volume_views(folder / ("real_" + file + ".png"), pipeline.volume(), std::string("Bundled scan: ") + run.name);
  }
  write_file(folder / "real.md", table.str());
  std::fputs(table.str().c_str(), stdout);
}

}  // namespace

int run_svort_accuracy(int argc, char** argv) {
  CLI::App app(
      "Simulates scans of the given brains, estimates their poses in several ways, and writes tables of the errors. "
      "Rows that are in OUTPUT already are kept: the program may be stopped and started again.",
      "svort_accuracy");
  Plan plan;
  app.add_option("--brains", plan.brains, "folder of aligned brains: NAME.nii.gz with NAME_mask.nii.gz");
  app.add_option("--test", plan.test, "names of the brains that scans are simulated of; the others are templates")
      ->capture_default_str();
  app.add_option("--shipped", plan.shipped, "another folder of templates, scored beside them");
  app.add_option("--motion", plan.motions, "motion classes")->capture_default_str();
  app.add_option("--scans", plan.scans, "scans of each brain in each class")
      ->check(CLI::PositiveNumber)
      ->capture_default_str();
  app.add_option("--methods", plan.methods, "only these rows of the table");
  app.add_option("--real", plan.real, "instead of simulating: stacks of a real scan, NIfTI, in acquisition order");
  app.add_option("--real-masks", plan.real_masks, "their brain masks");
  app.add_option(
      "--network", plan.networks,
      "NAME=FILE of weights: a row of that network, one with registration afterwards, and, for the live network, rows "
      "of registration and of live poses that it guides");
  app.add_option("--output", plan.output, "folder for the results; made if needed")->required();
  app.add_option("--seed", plan.seed, "of all random numbers")->capture_default_str();
  app.add_option("--threads", plan.threads, "0: all cores")->capture_default_str();
  bind_options(app, plan.pipeline);
  try {
    app.parse(argc, argv);
    if (plan.brains.empty() == plan.real.empty()) throw std::invalid_argument("give either --brains or --real");
    if (plan.real.empty())
      measure(plan);
    else
      measure_real(plan);
    return 0;
  } catch (const CLI::ParseError& error) {
    return app.exit(error) == 0 ? 0 : kBadInput;  // 0: help was asked for
  } catch (const std::exception& error) {
    std::fprintf(stderr, "%s: %s\n", app.get_name().c_str(), error.what());
    return kBadInput;
  }
}

}  // namespace svort
