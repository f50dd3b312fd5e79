#include "svort_ros/training/trainer.h"

#include <ATen/Parallel.h>
#include <torch/cuda.h>
#include <torch/nn/utils/clip_grad.h>
#include <torch/serialize.h>

#include <algorithm>
#include <chrono>
#include <cmath>
#include <fstream>
#include <iomanip>
#include <sstream>
#include <stdexcept>

#include "svort_ros/geometry/anchor_points.h"
#include "svort_ros/metrics/pose_error.h"

namespace svort {
namespace {

using Clock = std::chrono::steady_clock;

double seconds_since(Clock::time_point start) { return std::chrono::duration<double>(Clock::now() - start).count(); }

void require(bool condition, const std::string& message) {
  if (!condition) throw std::invalid_argument("trainer." + message);
}

std::filesystem::path state_file(const std::filesystem::path& folder) { return folder / "state.pt"; }

// Appends rows to a CSV file whose first column is the step.
class Log {
 public:
  Log(const std::filesystem::path& path, const std::string& header, std::int64_t last_step) : path_(path) {
    std::vector<std::string> rows;
    std::ifstream old(path);
    std::string line;
    if (std::getline(old, line) && line != header)
      throw std::runtime_error(path.string() + ": is the log of another recipe; choose another folder");
    // After a crash there may be rows beyond the state that training continues from.
    while (std::getline(old, line)) {
      if (std::strtoll(line.c_str(), nullptr, 10) <= last_step && line.find(',') != std::string::npos)
        rows.push_back(line);
    }
    old.close();
    std::ofstream file(path, std::ios::trunc);
    file << header << '\n';
    for (const std::string& row : rows) file << row << '\n';
    if (!file.flush()) throw std::runtime_error(path.string() + ": cannot be written");
  }
  void add(const std::string& row) const {
    std::ofstream file(path_, std::ios::app);
    file << row << '\n';
    if (!file.flush()) throw std::runtime_error(path_.string() + ": cannot be written");
  }

 private:
  std::filesystem::path path_;
};

std::string duration(double seconds) {
  std::ostringstream text;
  const auto minutes = static_cast<std::int64_t>(seconds / 60.);
  text << minutes / 60 << " h " << std::setw(2) << std::setfill('0') << minutes % 60 << " min";
  return text.str();
}

}  // namespace

torch::Device training_device(const TrainerOptions& options) {
  const bool gpu = torch::cuda::is_available();
  require(options.device == "auto" || options.device == "cpu" || options.device == "cuda",
          "device is '" + options.device + "'; it must be auto, cpu or cuda");
  require(options.device != "cuda" || gpu, "device is 'cuda', but LibTorch sees no GPU here");
  return options.device == "cpu" || !gpu ? torch::Device(torch::kCPU) : torch::Device(torch::kCUDA, 0);
}

torch::ScalarType training_precision(const TrainerOptions& options, const torch::Device& device) {
  if (options.precision == "float32") return torch::kFloat32;
  require(options.precision == "bfloat16",
          "precision is '" + options.precision + "'; it must be float32 or bfloat16 (mixed precision)");
  require(device.is_cuda(),
          "precision is 'bfloat16': mixed precision is for GPUs; on the CPU it is slower than float32");
  return torch::kBFloat16;
}

Trainer::Trainer(std::shared_ptr<TrainingRecipe> recipe, std::vector<std::shared_ptr<ScanSimulator>> training,
                 std::shared_ptr<ScanSimulator> validation, const TrainerOptions& options, std::filesystem::path folder)
    : recipe_(std::move(recipe)),
      training_(std::move(training)),
      validation_(std::move(validation)),
      options_(options),
      folder_(std::move(folder)),
      optimizer_(recipe_->network().parameters(),
                 torch::optim::AdamWOptions(options.learning_rate).weight_decay(options.weight_decay)) {
  require(!training_.empty(), "seed cannot be used: there is no simulator to train from");
  require(options.seed >= 0, "seed must be zero or positive");
  require(options.scans_per_step >= 1 && options.scans_per_step <= 1024, "scans_per_step must be 1 to 1024");
  require(options.learning_rate > 0. && std::isfinite(options.learning_rate), "learning_rate must be positive");
  require(options.weight_decay >= 0. && std::isfinite(options.weight_decay), "weight_decay must be zero or positive");
  require(options.warmup_steps >= 0, "warmup_steps must be zero or positive");
  const bool decays = options.schedule == "linear" || options.schedule == "cosine";
  require(decays || options.schedule == "constant",
          "schedule is '" + options.schedule + "'; it must be constant, linear or cosine");
  require(options.total_steps >= 0, "total_steps must be zero or positive");
  require(!decays || (options.decay_from_step >= 0 && options.decay_from_step < options.total_steps),
          "total_steps must be above decay_from_step for a schedule that decays");
  require(options.clip > 0., "clip must be positive");
  require(options.ema_decay >= 0. && options.ema_decay < 1., "ema_decay must be at least 0 and below 1");
  require(options.checkpoint_minutes > 0., "checkpoint_minutes must be positive");
  require(options.validation_minutes > 0., "validation_minutes must be positive");
  require(options.validation_scans >= 1, "validation_scans must be positive");
  require(options.log_steps >= 1, "log_steps must be positive");
  require(options.threads >= 1, "threads must be positive");
  std::filesystem::create_directories(folder_);
  for (const torch::Tensor& parameter : recipe_->network().parameters()) average_.push_back(parameter.detach().clone());
}

double Trainer::learning_rate(std::int64_t step) const {
  const auto at = static_cast<double>(step);
  if (step < options_.warmup_steps) return options_.learning_rate * (at + 1.) / options_.warmup_steps;
  if (options_.schedule == "constant" || step < options_.decay_from_step) return options_.learning_rate;
  const double begin = static_cast<double>(options_.decay_from_step);
  const double share = std::min(1., (at - begin) / (static_cast<double>(options_.total_steps) - begin));
  return options_.learning_rate * (options_.schedule == "linear" ? 1. - share : 0.5 * (1. + std::cos(M_PI * share)));
}

std::vector<SimulatedScan> Trainer::simulate(std::int64_t step) const {
  at::set_num_threads(options_.threads);  // of this thread: it may be the one that works ahead
  const auto turn = static_cast<std::size_t>(step) % training_.size();
  const auto first = static_cast<std::uint64_t>(first_scan_ + step * options_.scans_per_step);
  std::vector<SimulatedScan> scans = training_[turn]->simulate(first, options_.scans_per_step);
  scans.erase(std::remove_if(scans.begin(), scans.end(), [](const auto& scan) { return scan.truth.size(0) == 0; }),
              scans.end());
  return scans;
}

std::vector<SimulatedScan> Trainer::scans_of(std::int64_t step) {
  if (!options_.prefetch) return simulate(step);
  // A simulator has one owner at a time: the next batch is only begun when this one is there.
  std::vector<SimulatedScan> ahead;
  if (next_.valid()) ahead = next_.get();
  std::vector<SimulatedScan> scans = next_step_ == step ? std::move(ahead) : simulate(step);
  next_step_ = step + 1;
  next_ = std::async(std::launch::async, [this, step] { return simulate(step + 1); });
  return scans;
}

std::map<std::string, double> Trainer::step() {
  const std::vector<SimulatedScan> scans = scans_of(progress_.step);
  const std::int64_t number = progress_.step++;
  if (scans.empty()) return {};
  progress_.scans += static_cast<std::int64_t>(scans.size());
  for (auto& group : optimizer_.param_groups())
    static_cast<torch::optim::AdamWOptions&>(group.options()).lr(learning_rate(number));
  recipe_->network().train();
  // Parameters that a step does not use get no gradient, and AdamW leaves them alone.
  for (torch::Tensor& parameter : optimizer_.param_groups().front().params()) parameter.mutable_grad().reset();
  const std::size_t at_once = recipe_->scans_at_once() > 0 ? recipe_->scans_at_once() : scans.size();
  std::map<std::string, double> parts;
  bool usable = true;
  for (std::size_t begin = 0; usable && begin < scans.size(); begin += at_once) {
    const std::size_t count = std::min(at_once, scans.size() - begin);
    const auto first = scans.begin() + static_cast<std::ptrdiff_t>(begin);
    const double share = static_cast<double>(count) / static_cast<double>(scans.size());
    const StepLoss loss = recipe_->loss({first, first + static_cast<std::ptrdiff_t>(count)},
                                        static_cast<std::uint64_t>(first_scan_ + number));
    usable = std::isfinite(loss.total.item<double>());
    if (usable) (loss.total * share).backward();
    for (const auto& [name, value] : loss.parts) parts[name] += share * value;
  }
  if (usable) {
    const double norm = torch::nn::utils::clip_grad_norm_(recipe_->network().parameters(), options_.clip);
    usable = std::isfinite(norm);
    parts["gradient"] = norm;
  }
  if (!usable) {
    ++progress_.skipped;
    return {};
  }
  optimizer_.step();
  update_average();
  return parts;
}

void Trainer::update_average() {
  const torch::NoGradGuard no_grad;
  // Early on, the average follows closely: random weights must not linger in it.
  const double made = static_cast<double>(progress_.step - progress_.skipped);
  const double decay = std::min(options_.ema_decay, (1. + made) / (10. + made));
  const auto parameters = recipe_->network().parameters();
  for (std::size_t i = 0; i < parameters.size(); ++i) average_[i].lerp_(parameters[i], 1. - decay);
}

void Trainer::exchange_average() {
  const torch::NoGradGuard no_grad;
  auto parameters = recipe_->network().parameters();
  for (std::size_t i = 0; i < parameters.size(); ++i) {
    const torch::Tensor kept = parameters[i].clone();
    parameters[i].copy_(average_[i]);
    average_[i].copy_(kept);
  }
}

std::vector<std::pair<std::string, torch::Tensor>> Trainer::averaged() const {
  std::vector<std::pair<std::string, torch::Tensor>> result;
  std::size_t i = 0;
  for (const auto& parameter : recipe_->network().named_parameters())
    result.emplace_back(parameter.key(), average_[i++].clone());
  return result;
}

std::vector<std::string> Trainer::start_from(const std::map<std::string, torch::Tensor>& parameters,
                                             std::int64_t first_scan) {
  const torch::NoGradGuard no_grad;
  require(first_scan >= 0, "start_from: the first scan's number must be zero or positive");
  std::vector<std::string> left;
  std::size_t taken = 0;
  for (auto& own : recipe_->network().named_parameters()) {
    const auto given = parameters.find(own.key());
    if (given == parameters.end() || given->second.sizes() != own.value().sizes()) {
      left.push_back(own.key());
      continue;
    }
    if (!torch::isfinite(given->second).all().item<bool>())
      throw std::runtime_error("start_from: NaN or infinity in " + own.key());
    own.value().copy_(given->second);
    ++taken;
  }
  if (taken == 0) throw std::runtime_error("start_from: the weights have no parameter of this network");
  average_.clear();
  for (const torch::Tensor& parameter : recipe_->network().parameters()) average_.push_back(parameter.detach().clone());
  first_scan_ = first_scan;
  return left;
}

void Trainer::save() const {
  const std::filesystem::path path = state_file(folder_);
  std::filesystem::path temporary = path;
  temporary += ".part";
  torch::serialize::OutputArchive archive, network, optimizer;
  recipe_->network().save(network);
  optimizer_.save(optimizer);
  archive.write("network", network);
  archive.write("optimizer", optimizer);
  for (std::size_t i = 0; i < average_.size(); ++i) archive.write("average_" + std::to_string(i), average_[i]);
  archive.write(
      "counters",
      torch::tensor({progress_.step, progress_.scans, progress_.skipped, options_.seed, first_scan_}, torch::kInt64));
  archive.write("seconds", torch::tensor({progress_.seconds}, torch::kFloat64));
  torch::serialize::OutputArchive memory;
  for (const auto& [name, value] : recipe_->memory()) memory.write(name, value);
  archive.write("memory", memory);
  archive.save_to(temporary.string());
  std::filesystem::rename(temporary, path);
}

void Trainer::resume() {
  const std::filesystem::path path = state_file(folder_);
  if (!std::filesystem::exists(path)) throw std::runtime_error(path.string() + ": there is nothing to resume");
  try {
    torch::serialize::InputArchive archive, network, optimizer;
    archive.load_from(path.string(), recipe_->network().parameters().front().device());
    archive.read("network", network);
    archive.read("optimizer", optimizer);
    recipe_->network().load(network);
    optimizer_.load(optimizer);
    for (std::size_t i = 0; i < average_.size(); ++i) archive.read("average_" + std::to_string(i), average_[i]);
    torch::Tensor counters, seconds;
    archive.read("counters", counters);
    archive.read("seconds", seconds);
    if (counters[3].item<std::int64_t>() != options_.seed) {
      throw std::runtime_error("was made with trainer.seed " + std::to_string(counters[3].item<std::int64_t>()) +
                               ", not " + std::to_string(options_.seed));
    }
    progress_.step = counters[0].item<std::int64_t>();
    progress_.scans = counters[1].item<std::int64_t>();
    progress_.skipped = counters[2].item<std::int64_t>();
    first_scan_ = counters[4].item<std::int64_t>();
    progress_.seconds = seconds[0].item<double>();
    torch::serialize::InputArchive memory;
    std::map<std::string, torch::Tensor> remembered;
    if (archive.try_read("memory", memory)) {
      for (const std::string& name : memory.keys()) memory.read(name, remembered[name]);
    }
    recipe_->remember(remembered);
  } catch (const c10::Error& error) {
    throw std::runtime_error(path.string() + ": is not the state of this network: " + error.what_without_backtrace());
  } catch (const std::runtime_error& error) {
    throw std::runtime_error(path.string() + ": " + error.what());
  }
}

ValidationResult Trainer::validate() {
  if (!validation_) throw std::logic_error("Trainer::validate: there are no held-out scans");
  const torch::NoGradGuard no_grad;
  ValidationResult result;
  result.at = progress_;
  exchange_average();
  recipe_->network().eval();
  double scans = 0.;
  const auto add = [](std::vector<double>& sums, std::size_t k, double value) {
    sums.resize(std::max(sums.size(), k + 1), 0.);
    sums[k] += value;
  };
  for (int number = 0; number < options_.validation_scans; ++number) {
    const SimulatedScan scan = validation_->simulate(static_cast<std::uint64_t>(number), 1).front();
    if (scan.truth.size(0) == 0) continue;
    scans += 1.;
    const AnchorFrame frame = {static_cast<int>(scan.input.slices.size(3)), static_cast<int>(scan.input.slices.size(2)),
                               scan.input.slice_resolution_mm};
    const auto mean = [](const torch::Tensor& values) { return values.mean().item<double>(); };
    result.nominal_relative_ed_mm += mean(relative_pose_errors(scan.input.transforms, scan.truth, frame).ed);
    const auto steps = recipe_->network().run(scan.input, validation_->grid(), {});
    for (std::size_t k = 0; k < steps.size(); ++k) {
      const PoseErrors absolute = pose_errors(steps[k].transforms, scan.truth, frame);
      const PoseErrors relative = relative_pose_errors(steps[k].transforms, scan.truth, frame);
      add(result.ed_mm, k, mean(absolute.ed));
      add(result.gd_rad, k, mean(absolute.gd));
      add(result.relative_ed_mm, k, mean(relative.ed));
      add(result.relative_gd_rad, k, mean(relative.gd));
    }
  }
  exchange_average();
  if (scans == 0.) throw std::runtime_error("Trainer::validate: none of the held-out scans has a slice");
  for (auto* sums : {&result.ed_mm, &result.gd_rad, &result.relative_ed_mm, &result.relative_gd_rad}) {
    for (double& sum : *sums) sum /= scans;
  }
  result.nominal_relative_ed_mm /= scans;
  return result;
}

void Trainer::run(const Hooks& hooks, double minutes) {
  at::set_num_threads(options_.threads);
  std::string header = "step,scans,skipped,seconds,learning_rate,gradient";
  const std::vector<std::string> parts = recipe_->parts();
  for (const std::string& part : parts) header += "," + part;
  const Log training_log(folder_ / "training.csv", header, progress_.step);
  const Log validation_log(
      folder_ / "validation.csv",
      "step,scans,seconds,iteration,ed_mm,gd_rad,relative_ed_mm,relative_gd_rad,nominal_relative_ed_mm",
      progress_.step);
  const auto tell = [&hooks](const std::string& line) {
    if (hooks.tell) hooks.tell(line);
  };
  const double before = progress_.seconds;
  const auto start = Clock::now();
  auto last_checkpoint = start, last_validation = start;
  std::map<std::string, std::pair<double, double>> sums;  // sum and count of each part since the last row
  std::int64_t first_step = progress_.step;

  const auto checkpoint = [&] {
    save();
    last_checkpoint = Clock::now();
    if (hooks.checkpoint) hooks.checkpoint(progress_);
  };
  const auto validate_now = [&] {
    if (!validation_) return;
    const ValidationResult result = validate();
    last_validation = Clock::now();
    for (std::size_t k = 0; k < result.ed_mm.size(); ++k) {
      std::ostringstream row;
      row << result.at.step << ',' << result.at.scans << ',' << result.at.seconds << ',' << k + 1 << ','
          << result.ed_mm[k] << ',' << result.gd_rad[k] << ',' << result.relative_ed_mm[k] << ','
          << result.relative_gd_rad[k] << ',' << result.nominal_relative_ed_mm;
      validation_log.add(row.str());
    }
    std::ostringstream line;
    line << std::setprecision(3) << "validation: ED " << result.ed_mm.front() << " -> " << result.ed_mm.back()
         << " mm, GD " << result.gd_rad.front() << " -> " << result.gd_rad.back() << " rad, relative ED "
         << result.relative_ed_mm.front() << " -> " << result.relative_ed_mm.back() << " mm (nominal "
         << result.nominal_relative_ed_mm << ")";
    tell(line.str());
    if (hooks.validated) hooks.validated(result);
  };

  bool stopped = false;
  while (!(stopped = hooks.stop && hooks.stop()) &&
         (options_.total_steps == 0 || progress_.step < options_.total_steps) &&
         (minutes <= 0. || seconds_since(start) < 60. * minutes)) {
    const auto said = step();
    progress_.seconds = before + seconds_since(start);
    for (const auto& [name, value] : said) {
      sums[name].first += value;
      sums[name].second += 1.;
    }
    if (progress_.step % options_.log_steps == 0) {
      const auto mean = [&sums](const std::string& name) {
        const auto found = sums.find(name);
        return found == sums.end() ? std::string() : std::to_string(found->second.first / found->second.second);
      };
      std::ostringstream row;
      row << progress_.step << ',' << progress_.scans << ',' << progress_.skipped << ',' << progress_.seconds << ','
          << learning_rate(progress_.step - 1) << ',' << mean("gradient");
      for (const std::string& part : parts) row << ',' << mean(part);
      training_log.add(row.str());
      const double pace = static_cast<double>(progress_.step - first_step) / seconds_since(start);
      std::ostringstream line;
      line << "step " << progress_.step << ", " << progress_.scans << " scans";
      if (progress_.skipped > 0) line << " (" << progress_.skipped << " steps skipped)";
      line << std::setprecision(3) << ", " << pace * options_.scans_per_step << " scans/s";
      for (const std::string& part : parts) {
        if (sums.count(part)) line << ", " << part << ' ' << mean(part).substr(0, 6);
      }
      double left = options_.total_steps > 0 ? static_cast<double>(options_.total_steps - progress_.step) / pace : 0.;
      if (minutes > 0.) {
        const double until_limit = std::max(0., 60. * minutes - seconds_since(start));
        left = options_.total_steps > 0 ? std::min(left, until_limit) : until_limit;
      }
      if (left > 0.) line << ", " << duration(left) << " left";
      tell(line.str());
      sums.clear();
    }
    if (seconds_since(last_validation) > 60. * options_.validation_minutes) validate_now();
    if (seconds_since(last_checkpoint) > 60. * options_.checkpoint_minutes) checkpoint();
  }
  checkpoint();
  if (!stopped) validate_now();
}

}  // namespace svort
