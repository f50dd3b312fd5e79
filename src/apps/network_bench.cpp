#include "network_bench.h"

#include <ATen/Parallel.h>
#include <torch/cuda.h>
#include <torch/types.h>

#include <algorithm>
#include <chrono>
#include <cmath>
#include <cstdint>
#include <fstream>
#include <iostream>
#include <limits>
#include <map>
#include <sstream>
#include <stdexcept>

#include "bench_support.h"
#include "svort_ros/geometry/rigid_transform.h"
#include "svort_ros/network/checkpoint.h"
#include "svort_ros/network/deterministic_weights.h"
#include "svort_ros/network/network_runner.h"
#include "svort_ros/network/stage_clock.h"

namespace svort {

const char* const kNetworkBenchUsage =
    "       svort_bench network [--networks NAME,..] [--weights FILE] [--slices N,..] [--threads N,..]\n"
    "                           [--repetitions N] [--device auto|cpu|cuda] [--precision float32|tf32|bfloat16]\n"
    "                           [--formulation exact|fast]\n"
    "Times a whole run of pose networks and its stages: encoder, transformer, forward model (A), adjoint, conjugate\n"
    "gradients; ms, summed over the iterations. A coarser precision is compared with float32: mean error of the "
    "anchor\n"
    "points, mm.\n"
    "  --networks     default: all\n"
    "  --weights      a checkpoint instead of random weights; its network is the only one\n"
    "  --slices       default 15,60,120,450\n"
    "  --threads      default: all cores\n"
    "  --repetitions  the best of so many runs counts, after one that does not; default 3\n";

namespace {

constexpr std::int64_t kSize = 128;

struct Options {
  std::vector<std::string> networks = network_names();
  std::string weights;
  std::vector<std::int64_t> slices = {15, 60, 120, 450};
  std::vector<std::int64_t> threads = {at::get_num_threads()};
  std::int64_t repetitions = 3;
  std::string formulation = "exact";
  RunnerOptions runner;
};

Options parse(const std::vector<std::string>& arguments) {
  Options options;
  for (std::size_t i = 0; i < arguments.size(); i += 2) {
    const std::string& name = arguments[i];
    if (i + 1 == arguments.size()) throw std::invalid_argument(name + " is unknown or needs a value");
    const std::string& value = arguments[i + 1];
    if (name == "--networks")
      options.networks = list_items(value);
    else if (name == "--weights")
      options.weights = value;
    else if (name == "--slices")
      options.slices = positive_integers(name, value, 5000);
    else if (name == "--threads")
      options.threads = positive_integers(name, value, 5000);
    else if (name == "--repetitions")
      options.repetitions = positive_integers(name, value, 5000).front();
    else if (name == "--device")
      options.runner.device = value;
    else if (name == "--precision")
      options.runner.precision = value;
    else if (name == "--formulation")
      options.formulation = value;
    else
      throw std::invalid_argument(name + " is unknown");
  }
  acquisition_formulation(options.formulation);
  for (const std::string& network : options.networks) describe_network(network);
  return options;
}

/// Three orthogonal stacks of textured discs, as large as a brain's slices. The time does not depend on the content.
NetworkInput scan_of(std::int64_t n) {
  torch::manual_seed(1);
  const std::int64_t per_stack = (n + 2) / 3;
  const torch::Tensor axis = torch::arange(kSize, torch::kFloat32) - static_cast<double>(kSize - 1) / 2.;
  torch::Tensor axisangle = torch::zeros({n, 6}), positions = torch::zeros({n, 2});
  NetworkInput input;
  input.slices = torch::rand({n, 1, kSize, kSize});
  for (std::int64_t i = 0; i < n; ++i) {
    const std::int64_t stack = i / per_stack, index = i % per_stack;
    const double spacing = 90. / static_cast<double>(per_stack);  // mm: the stack covers the brain
    const double z = (static_cast<double>(index) - static_cast<double>(per_stack - 1) / 2.) * spacing;
    if (stack > 0) axisangle[i][stack - 1] = M_PI / 2.;
    axisangle[i][5] = z;
    positions[i][0] = static_cast<double>(index - per_stack / 2);
    positions[i][1] = static_cast<double>(stack);
    input.slices[i][0].mul_(axis.view({-1, 1}).square() + axis.view({1, -1}).square() < 50. * 50. - z * z);
  }
  input.transforms = axisangle_to_matrix(axisangle);
  input.positions = positions;
  input.slice_counts = torch::full({n}, per_stack, torch::kInt64);
  input.times = torch::arange(n, torch::kFloat32);
  return input;
}

void bench(const NetworkInstance& network, const Options& options) {
  NetworkRunner runner(network, options.runner);
  // The volume of the golden numbers: 0.8 mm voxels, about 80 x 90 x 77 mm.
  const NetworkGrid grid{{96, 112, 100}, 0.8};
  for (const std::int64_t n : options.slices) {
    const NetworkInput input = scan_of(n);
    for (const std::int64_t threads : options.threads) {
      at::set_num_threads(static_cast<int>(threads));
      const bool gpu = runner.device() != "cpu";
      StageClock clock([gpu] {
        if (gpu) torch::cuda::synchronize();
      });
      NetworkRun run;
      run.formulation = acquisition_formulation(options.formulation);
      run.clock = &clock;
      double best = std::numeric_limits<double>::infinity();
      std::map<std::string, double> stages;
      std::size_t iterations = 0;
      for (std::int64_t repetition = 0; repetition <= options.repetitions; ++repetition) {
        clock.clear();
        const auto start = std::chrono::steady_clock::now();
        iterations = runner.run(input, grid, run).size();
        const std::chrono::duration<double, std::milli> time = std::chrono::steady_clock::now() - start;
        // The first run allocates, and chooses kernels.
        if (repetition == 0 || time.count() >= best) continue;
        best = time.count();
        stages = clock.milliseconds();
      }
      std::cout << R"({"benchmark": "network", "network": ")" << network.name << R"(", "slices": )" << n
                << R"(, "pixels": [128, 128], "volume": [96, 112, 100], "iterations": )" << iterations
                << R"(, "formulation": ")" << options.formulation << R"(", "device": ")" << runner.device()
                << R"(", "precision": ")" << options.runner.precision << R"(", "threads": )" << threads
                << R"(, "total_ms": )" << best;
      for (const auto& [stage, ms] : stages) std::cout << ", \"" << stage << "_ms\": " << ms;
      if (options.runner.precision != "float32") {
        RunnerOptions exact = options.runner;
        exact.precision = "float32";
        const torch::Tensor reference = NetworkRunner(network, exact).run(input, grid, run).back().points;
        const torch::Tensor points = runner.run(input, grid, run).back().points;
        // Three anchor points of three coordinates for each slice.
        std::cout << R"(, "mean_point_error_mm": )"
                  << (points - reference).view({-1, 3}).norm(2, 1).mean().item<double>();
      }
      std::cout << R"(, "peak_memory_mb": )" << peak_memory_mb();
      if (!runner.diagnostic().empty()) std::cout << R"(, "fell_back_to_cpu": true)";
      std::cout << "}" << std::endl;
    }
  }
}

}  // namespace

void run_network_bench(const std::vector<std::string>& arguments) {
  const Options options = parse(arguments);
  if (!options.weights.empty()) {
    bench(load_network(options.weights), options);
    return;
  }
  for (const std::string& name : options.networks) {
    const NetworkInstance network = make_network(name);
    // With LibTorch's own random weights a network hardly moves the slices, and coarser precision would look harmless.
    if (name == "v1" || name == "v2") fill_deterministically(*network.module);
    bench(network, options);
  }
}

}  // namespace svort
