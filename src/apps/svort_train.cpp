// Trains a pose network on simulated scans; docs/training.md says how.

#include <csignal>
#include <filesystem>
#include <iostream>
#include <map>
#include <memory>
#include <stdexcept>
#include <string>
#include <vector>

#include "svort_ros/io/options_file.h"
#include "svort_ros/network/checkpoint.h"
#include "svort_ros/network/network_registry.h"
#include "svort_ros/training/training_config.h"
#include "training_files.h"

namespace {

using namespace svort;

volatile std::sig_atomic_t stop_asked = 0;
void ask_to_stop(int /*signal*/) { stop_asked = 1; }

std::string names_of(const std::vector<BrainVolume>& volumes) {
  std::string names;
  for (const BrainVolume& volume : volumes) names += (names.empty() ? "" : ", ") + volume.name;
  return names;
}

constexpr const char* kStartedFrom = "started from";
constexpr const char* kStartedAnew = "started anew";  // parameters that those weights did not have

// The moving average of the weights, in the file that the node and the replay take.
void write_weights(const std::filesystem::path& folder, const NetworkInstance& network, const Trainer& trainer,
                   Provenance provenance) {
  NetworkInstance averaged = make_network(network.name, network.options);
  {
    const torch::NoGradGuard no_grad;
    auto parameters = averaged.module->named_parameters();
    for (const auto& [name, value] : trainer.averaged()) parameters[name].copy_(value);
  }
  const TrainingProgress& progress = trainer.progress();
  provenance["steps"] = std::to_string(progress.step);
  const std::int64_t before = scans_seen(provenance, folder / "weights.pt", kProvenanceScansBefore).value_or(0);
  provenance[kProvenanceScans] = std::to_string(before + progress.scans);
  provenance["steps skipped"] = std::to_string(progress.skipped);
  provenance["seconds"] = std::to_string(static_cast<std::int64_t>(progress.seconds));
  save_network(folder / "weights.pt", averaged, provenance, WeightPrecision::half);
}

OptionValues network_options(const TrainingConfig& config) {
  if (config.kind == "live") return option_values(config.network);
  if (config.kind == "v1") return option_values(config.svort);
  if (config.kind == "svrnet" || config.kind == "planeinvol") return option_values(config.baseline);
  throw std::invalid_argument("kind is '" + config.kind + "'; it must be live, v1, svrnet or planeinvol");
}

std::shared_ptr<TrainingRecipe> recipe_of(const TrainingConfig& config, const NetworkInstance& network,
                                          const NetworkGrid& grid, torch::ScalarType precision) {
  if (const auto live = std::dynamic_pointer_cast<LiveNetwork>(network.module)) {
    live->set_precision(precision);
    return std::make_shared<LiveRecipe>(live, config.recipe, static_cast<std::uint64_t>(config.trainer.seed));
  }
  if (const auto v1 = std::dynamic_pointer_cast<SvortV1>(network.module))
    return std::make_shared<PaperRecipe>(v1, config.paper, grid, precision);
  if (precision != torch::kFloat32) throw std::invalid_argument("trainer.precision must be float32 for " + config.kind);
  return std::make_shared<AnchorRecipe>(std::dynamic_pointer_cast<AnchorRegressor>(network.module));
}

// What the weights in the folder of a run that goes on were started from.
void take_over_start(const std::filesystem::path& weights, Provenance* provenance) {
  if (!std::filesystem::exists(weights)) return;
  const Provenance before = read_checkpoint(weights).provenance;
  for (const char* key : {kStartedFrom, kProvenanceScansBefore, kStartedAnew})
    if (const auto found = before.find(key); found != before.end()) (*provenance)[key] = found->second;
}

int run(int argc, char** argv) {
  CLI::App app("Trains a pose network on simulated scans of brain volumes.");
  std::string config_file, output, weights;
  double minutes = 0.;
  bool resume = false;
  TrainingConfig config;
  app.add_option("--config", config_file, "options (YAML)")->required();
  app.add_option("--output", output, "folder for the state, the weights and the logs")->required();
  app.add_option("--minutes", minutes, "stop after so many minutes; 0: no limit")->capture_default_str();
  app.add_flag("--resume", resume, "continue from the state in the output folder");
  app.add_option("--weights", weights, "start from these weights instead of random ones");
  // The file comes first: what the line says overrides it.
  for (int i = 1; i + 1 < argc; ++i) {
    if (std::string(argv[i]) == "--config") load_options(argv[i + 1], config);
  }
  bind_options(app, config);
  CLI11_PARSE(app, argc, argv);
  if (resume && !weights.empty()) throw std::invalid_argument("--resume and --weights exclude each other");
  if (!resume && std::filesystem::exists(std::filesystem::path(output) / "state.pt"))
    throw std::invalid_argument(output + " holds a state already: give --resume, or another folder");

  const torch::Device device = training_device(config.trainer);
  const torch::ScalarType precision = training_precision(config.trainer, device);
  if (config.volume_px < 8 || config.volume_px > 1024) throw std::invalid_argument("volume_px must be 8 to 1024");
  NetworkGrid grid;
  grid.volume_shape.fill(config.volume_px);
  grid.resolution_mm = config.volume_mm;
  const auto volumes = read_training_volumes(config.volumes);
  const auto held_out = read_training_volumes(config.held_out);
  const auto seed = static_cast<std::uint64_t>(config.trainer.seed);
  std::map<std::string, std::shared_ptr<ScanSimulator>> simulators;
  std::vector<std::shared_ptr<ScanSimulator>> training;
  for (const std::string& protocol : config.protocols) {
    auto& simulator = simulators[protocol];
    if (!simulator) {
      SimulatorOptions options = config.simulator;
      options.scanner.protocol = protocol;
      simulator = std::make_shared<ScanSimulator>(volumes, grid, options, seed, device);
    }
    training.push_back(simulator);
  }
  std::shared_ptr<ScanSimulator> validation;
  if (!held_out.empty()) {
    // Whole scans, one brain each, the same ones every time.
    SimulatorOptions options = config.simulator;
    options.scanner.protocol = config.protocols.front();
    options.scanner.prefix_share = 0.;
    options.scanner.stacks_min = options.scanner.stacks_max;
    options.anatomies = options.scans_per_anatomy = 1;
    constexpr std::uint64_t kValidationSeed = 1000003;  // far from those that people choose for training
    validation = std::make_shared<ScanSimulator>(held_out, grid, options, kValidationSeed, device);
  }

  torch::manual_seed(config.trainer.seed);
  const NetworkInstance network = make_network(config.kind, network_options(config));
  network.module->to(device);
  const auto recipe = recipe_of(config, network, grid, precision);
  Trainer trainer(recipe, training, validation, config.trainer, output);
  Provenance provenance = {{"trained on", names_of(volumes)},
                           {"held out", names_of(held_out)},
                           {"seed", std::to_string(config.trainer.seed)},
                           {"device", device.str() + ", " + std::to_string(config.trainer.threads) +
                                          " CPU thread(s), " + config.trainer.precision},
                           {"note", config.note}};
  const std::filesystem::path folder = output;
  if (resume) {
    trainer.resume();
    take_over_start(folder / "weights.pt", &provenance);
  }
  if (!weights.empty()) {
    const Checkpoint before = read_checkpoint(weights);
    if (before.network != config.kind)
      throw std::invalid_argument(weights + ": holds the network '" + before.network + "', not '" + config.kind + "'");
    const std::int64_t seen = scans_seen(before.provenance, weights).value_or(0);
    const std::vector<std::string> left = trainer.start_from(before.parameters, seen);
    provenance[kStartedFrom] = "weights " + before.sha256 + ", after " + std::to_string(seen) + " scans";
    provenance[kProvenanceScansBefore] = std::to_string(seen);
    if (!left.empty()) {
      std::string names;
      for (const std::string& name : left) names += (names.empty() ? "" : ", ") + name;
      std::cout << weights << " does not have these in the network's shape, they start anew: " << names << std::endl;
      provenance[kStartedAnew] = names;
    }
  }

  std::signal(SIGTERM, ask_to_stop);
  std::signal(SIGINT, ask_to_stop);
  Trainer::Hooks hooks;
  hooks.stop = [] { return stop_asked != 0; };
  hooks.tell = [](const std::string& line) { std::cout << line << std::endl; };
  hooks.checkpoint = [&](const TrainingProgress&) {
    write_weights(folder, network, trainer, provenance);
    plot_training(folder, recipe->parts());
  };
  hooks.validated = [&](const ValidationResult&) { plot_training(folder, recipe->parts()); };
  trainer.run(hooks, minutes);
  return 0;
}

}  // namespace

int main(int argc, char** argv) {
  try {
    return run(argc, argv);
  } catch (const std::exception& error) {
    std::cerr << "svort_train: " << error.what() << std::endl;
    return 2;
  }
}
