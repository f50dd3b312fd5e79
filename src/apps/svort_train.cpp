// Trains a pose network on simulated scans; docs/training.md says how.

#include <algorithm>
#include <csignal>
#include <filesystem>
#include <fstream>
#include <iostream>
#include <map>
#include <memory>
#include <sstream>
#include <stdexcept>
#include <string>
#include <vector>

#include "svort_ros/io/brain_volume_file.h"
#include "svort_ros/io/options_file.h"
#include "svort_ros/io/plots.h"
#include "svort_ros/network/checkpoint.h"
#include "svort_ros/network/network_registry.h"
#include "svort_ros/training/training_config.h"

namespace {

using namespace svort;

volatile std::sig_atomic_t stop_asked = 0;
void ask_to_stop(int /*signal*/) { stop_asked = 1; }

// NAME.nii.gz with NAME_mask.nii.gz and NAME_parc.nii.gz or NAME_WMZparc.nii.gz beside it, as far as they are there.
BrainVolume read_with_neighbours(const std::string& file) {
  const std::string ending = file.size() > 3 && file.compare(file.size() - 3, 3, ".gz") == 0 ? ".nii.gz" : ".nii";
  const std::string stem = file.substr(0, file.size() - std::min(file.size(), ending.size()));
  const auto beside = [&](const std::vector<const char*>& names) {
    for (const char* name : names) {
      if (const std::string path = stem + name + ending; std::filesystem::exists(path)) return path;
    }
    return std::string();
  };
  return read_brain_volume(file, beside({"_mask"}), beside({"_parc", "_WMZparc"}));
}

std::vector<BrainVolume> load_volumes(const std::vector<std::string>& files) {
  std::vector<BrainVolume> volumes;
  for (const std::string& file : files) {
    if (std::filesystem::path(file).extension() != ".pt") {
      volumes.push_back(read_with_neighbours(file));
      continue;
    }
    for (BrainVolume& volume : load_brain_volumes(file)) volumes.push_back(std::move(volume));
  }
  return volumes;
}

std::string names_of(const std::vector<BrainVolume>& volumes) {
  std::string names;
  for (const BrainVolume& volume : volumes) names += (names.empty() ? "" : ", ") + volume.name;
  return names;
}

// The log's rows of one kind: numbers by column; an empty field is NaN.
std::map<std::string, std::vector<double>> read_log(const std::filesystem::path& path) {
  std::ifstream file(path);
  std::string line, field;
  std::vector<std::string> header;
  std::map<std::string, std::vector<double>> columns;
  std::getline(file, line);
  for (std::istringstream fields(line); std::getline(fields, field, ',');) header.push_back(field);
  while (std::getline(file, line)) {
    std::istringstream fields(line);
    for (const std::string& name : header) {
      field.clear();
      std::getline(fields, field, ',');
      columns[name].push_back(field.empty() ? std::nan("") : std::stod(field));
    }
  }
  return columns;
}

void plot_logs(const std::filesystem::path& folder, const std::vector<std::string>& parts) {
  auto training = read_log(folder / "training.csv");
  std::vector<Curve> losses;
  for (const std::string& part : parts) {
    Curve curve{part, {}};
    const std::vector<double>& values = training[part];
    for (std::size_t i = 0; i < values.size(); ++i) curve.points.emplace_back(training["scans"][i], values[i]);
    losses.push_back(std::move(curve));
  }
  plot_curves(folder / "training.png", "Training losses", "scans", "loss", losses);

  auto validation = read_log(folder / "validation.csv");
  if (validation.empty()) return;
  std::map<double, std::pair<Curve, Curve>> by_iteration;
  for (std::size_t i = 0; i < validation["scans"].size(); ++i) {
    const double iteration = validation["iteration"][i];
    auto& [absolute, relative] = by_iteration[iteration];
    const std::string name = "iteration " + std::to_string(static_cast<int>(iteration));
    absolute.name = name;
    relative.name = name + ", relative";
    absolute.points.emplace_back(validation["scans"][i], validation["ed_mm"][i]);
    relative.points.emplace_back(validation["scans"][i], validation["relative_ed_mm"][i]);
  }
  std::vector<Curve> errors;
  for (const auto& [iteration, curves] : by_iteration) {
    errors.push_back(curves.first);
    errors.push_back(curves.second);
  }
  plot_curves(folder / "validation.png", "Held-out scans: distance of the anchor points", "scans seen", "ED / mm",
              errors);
}

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
  provenance["scans"] = std::to_string(progress.scans);
  provenance["steps skipped"] = std::to_string(progress.skipped);
  provenance["seconds"] = std::to_string(static_cast<std::int64_t>(progress.seconds));
  save_network(folder / "weights.pt", averaged, provenance, WeightPrecision::half);
}

OptionValues network_options(const TrainingConfig& config) {
  if (config.kind == "live") return option_values(config.network);
  if (config.kind == "svrnet" || config.kind == "planeinvol") return option_values(config.baseline);
  throw std::invalid_argument("kind is '" + config.kind + "'; it must be live, svrnet or planeinvol");
}

std::shared_ptr<TrainingRecipe> recipe_of(const TrainingConfig& config, const NetworkInstance& network) {
  if (const auto live = std::dynamic_pointer_cast<LiveNetwork>(network.module)) {
    if (config.trainer.precision != "float32" && config.trainer.precision != "bfloat16")
      throw std::invalid_argument("trainer.precision is '" + config.trainer.precision +
                                  "'; it must be float32 or bfloat16");
    live->set_precision(config.trainer.precision == "bfloat16" ? torch::kBFloat16 : torch::kFloat32);
    return std::make_shared<LiveRecipe>(live, config.recipe, static_cast<std::uint64_t>(config.trainer.seed));
  }
  if (config.trainer.precision != "float32")
    throw std::invalid_argument("trainer.precision must be float32 for " + config.kind);
  return std::make_shared<AnchorRecipe>(std::dynamic_pointer_cast<AnchorRegressor>(network.module));
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

  const NetworkGrid grid = {{64, 64, 64}, 2.};
  const auto volumes = load_volumes(config.volumes);
  const auto held_out = load_volumes(config.held_out);
  const auto seed = static_cast<std::uint64_t>(config.trainer.seed);
  std::map<std::string, std::shared_ptr<ScanSimulator>> simulators;
  std::vector<std::shared_ptr<ScanSimulator>> training;
  for (const std::string& protocol : config.protocols) {
    auto& simulator = simulators[protocol];
    if (!simulator) {
      SimulatorOptions options = config.simulator;
      options.scanner.protocol = protocol;
      simulator = std::make_shared<ScanSimulator>(volumes, grid, options, seed);
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
    validation = std::make_shared<ScanSimulator>(held_out, grid, options, kValidationSeed);
  }

  torch::manual_seed(config.trainer.seed);
  const NetworkInstance network = make_network(config.kind, network_options(config));
  const auto recipe = recipe_of(config, network);
  Trainer trainer(recipe, training, validation, config.trainer, output);
  Provenance provenance = {{"trained on", names_of(volumes)},
                           {"held out", names_of(held_out)},
                           {"seed", std::to_string(config.trainer.seed)},
                           {"device", "cpu, " + std::to_string(config.trainer.threads) + " thread(s)"},
                           {"note", config.note}};
  if (resume) trainer.resume();
  if (!weights.empty()) {
    Checkpoint before;
    const NetworkInstance start = load_network(weights, &before);
    std::vector<std::pair<std::string, torch::Tensor>> parameters;
    for (const auto& parameter : start.module->named_parameters())
      parameters.emplace_back(parameter.key(), parameter.value());
    trainer.start_from(parameters);
    provenance["started from"] = "weights " + before.sha256 + ", after " + before.provenance["scans"] + " scans";
  }

  std::signal(SIGTERM, ask_to_stop);
  std::signal(SIGINT, ask_to_stop);
  Trainer::Hooks hooks;
  hooks.stop = [] { return stop_asked != 0; };
  hooks.tell = [](const std::string& line) { std::cout << line << std::endl; };
  hooks.checkpoint = [&](const TrainingProgress&) {
    write_weights(output, network, trainer, provenance);
    plot_logs(output, recipe->parts());
  };
  hooks.validated = [&](const ValidationResult&) { plot_logs(output, recipe->parts()); };
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
