#pragma once

#include <torch/optim/adamw.h>

#include <cstdint>
#include <filesystem>
#include <functional>
#include <future>
#include <map>
#include <memory>
#include <string>
#include <vector>

#include "svort_ros/simulation/scan_simulator.h"
#include "svort_ros/training/recipe.h"

namespace svort {

struct TrainerOptions {
  std::int64_t seed = 1;              ///< of the training scans and of every random choice of the recipe
  int scans_per_step = 4;             ///< scans in a step; more are steadier, fewer cost less
  double learning_rate = 5e-4;        ///< of AdamW, after the warm-up
  double weight_decay = 0.01;         ///< of AdamW
  int warmup_steps = 100;             ///< steps over which the learning rate rises from 0
  std::string schedule = "constant";  ///< after the warm-up: constant, linear or cosine (down to 0 at total_steps)
  std::int64_t decay_from_step = 0;   ///< linear and cosine: constant until this step
  std::int64_t total_steps = 0;       ///< stop after so many steps; 0: no limit (constant only)
  double clip = 2.;                   ///< largest norm of the gradient; longer ones are shortened
  double ema_decay = 0.999;           ///< of the moving average of the weights, which is what is validated and used
  double checkpoint_minutes = 5.;     ///< time between checkpoints
  double validation_minutes = 30.;    ///< time between validations
  int validation_scans = 12;          ///< scans of the held-out volumes per validation
  std::int64_t log_steps = 20;        ///< steps per row of the log
  bool prefetch = false;        ///< make the next step's scans on another thread meanwhile; the result is the same
  int threads = 1;              ///< CPU threads
  std::string device = "auto";  ///< where scans are made and the network is trained: auto, cpu or cuda
  std::string precision = "float32";  ///< of the layers: float32, or bfloat16 (mixed precision; on a GPU alone)

  template <class Visitor>
  void visit(Visitor&& v) {
    v("seed", seed, "of the training scans and of every random choice");
    v("scans_per_step", scans_per_step, "scans per step");
    v("learning_rate", learning_rate, "of AdamW, after the warm-up");
    v("weight_decay", weight_decay, "of AdamW");
    v("warmup_steps", warmup_steps, "steps over which the learning rate rises");
    v("schedule", schedule, "learning rate after the warm-up: constant, linear or cosine (to 0 at total_steps)");
    v("decay_from_step", decay_from_step, "linear and cosine: constant until this step");
    v("total_steps", total_steps, "stop after so many steps; 0: no limit");
    v("clip", clip, "largest norm of the gradient");
    v("ema_decay", ema_decay, "of the moving average of the weights");
    v("checkpoint_minutes", checkpoint_minutes, "time between checkpoints, minutes");
    v("validation_minutes", validation_minutes, "time between validations, minutes");
    v("validation_scans", validation_scans, "scans of the held-out volumes per validation");
    v("log_steps", log_steps, "steps per row of the log");
    v("prefetch", prefetch, "make the next step's scans on another thread meanwhile");
    v("threads", threads, "CPU threads");
    v("device", device, "auto (a GPU if there is one), cpu or cuda");
    v("precision", precision, "float32, or bfloat16: mixed precision, on a GPU alone");
  }
};

/// The device that the options ask for.
/// @throws std::invalid_argument naming the option: an unknown device, or a GPU where LibTorch sees none
torch::Device training_device(const TrainerOptions& options);

/// The precision of the layers on that device; geometry, losses and weights are float32 in any case.
/// @throws std::invalid_argument naming the option: an unknown precision, or mixed precision on the CPU, where it is
///         slower than float32
torch::ScalarType training_precision(const TrainerOptions& options, const torch::Device& device);

/// Where training stands.
struct TrainingProgress {
  std::int64_t step = 0;     ///< steps made, skipped ones included
  std::int64_t scans = 0;    ///< scans seen
  std::int64_t skipped = 0;  ///< steps whose loss or gradient was not finite: they changed nothing
  double seconds = 0.;       ///< spent so far, over all runs
};

/// Errors of the network on held-out scans, one entry per iteration; means over scans.
struct ValidationResult {
  TrainingProgress at;
  std::vector<double> ed_mm, gd_rad;                    ///< absolute
  std::vector<double> relative_ed_mm, relative_gd_rad;  ///< after removing one rigid motion per scan
  double nominal_relative_ed_mm = 0.;                   ///< of the nominal poses
};

/// Trains one network on simulated scans, and can be stopped and resumed at any step.
///
/// In `folder` it keeps state.pt (weights, optimiser, average, counters, the recipe's memory), training.csv (losses)
/// and validation.csv. Scan numbers and random choices follow from the step number, so a resumed run continues as if it
/// had not stopped.
class Trainer {
 public:
  /// @param recipe     its network is on the device that it is to be trained on
  /// @param training   one or more simulators; the steps take turns. One that is listed twice has twice the share
  /// @param validation may be null: then nothing is validated
  /// @throws std::invalid_argument naming the option that is out of range
  Trainer(std::shared_ptr<TrainingRecipe> recipe, std::vector<std::shared_ptr<ScanSimulator>> training,
          std::shared_ptr<ScanSimulator> validation, const TrainerOptions& options, std::filesystem::path folder);

  /// Continues from state.pt in the folder. Rows of the logs beyond it are removed.
  /// @throws std::runtime_error naming the file and what is wrong with it
  void resume();
  /// Starts from these weights instead of random ones; the average too. Parameters that the weights do not have in the
  /// network's shape, because the network has changed since, stay random.
  /// @param first_scan number of the first scan: those that the weights have seen need not come again
  /// @return names of the parameters that stay random
  /// @throws std::runtime_error if none fits, or naming one that is not finite
  std::vector<std::string> start_from(const std::map<std::string, torch::Tensor>& parameters,
                                      std::int64_t first_scan = 0);

  struct Hooks {
    std::function<bool()> stop;                               ///< asked before every step
    std::function<void(const std::string&)> tell;             ///< one line of progress
    std::function<void(const TrainingProgress&)> checkpoint;  ///< after state.pt was written
    std::function<void(const ValidationResult&)> validated;
  };
  /// Steps until total_steps, the time limit, or stop() says so; ends with a checkpoint.
  /// @param minutes limit for this run; 0: none
  void run(const Hooks& hooks, double minutes);

  /// One step. @return the loss's parts; empty if the step was skipped
  std::map<std::string, double> step();
  ValidationResult validate();
  /// Writes state.pt, whole or not at all.
  void save() const;

  const TrainingProgress& progress() const { return progress_; }
  double learning_rate(std::int64_t step) const;
  /// The moving average, by parameter name: what to use the network with.
  std::vector<std::pair<std::string, torch::Tensor>> averaged() const;

 private:
  std::vector<SimulatedScan> simulate(std::int64_t step) const;
  std::vector<SimulatedScan> scans_of(std::int64_t step);
  void update_average();
  void exchange_average();  // weights <-> average

  std::shared_ptr<TrainingRecipe> recipe_;
  std::vector<std::shared_ptr<ScanSimulator>> training_;
  std::shared_ptr<ScanSimulator> validation_;
  TrainerOptions options_;
  std::filesystem::path folder_;
  torch::optim::AdamW optimizer_;
  std::vector<torch::Tensor> average_;
  TrainingProgress progress_;
  std::int64_t first_scan_ = 0;  ///< number of step 0's first scan
  std::future<std::vector<SimulatedScan>> next_;
  std::int64_t next_step_ = -1;  ///< that next_ is for
};

}  // namespace svort
