#include "svort_ros/network/network_runner.h"

#include <torch/cuda.h>

#include <stdexcept>
#include <utility>

namespace svort {
namespace {

/// Sets LibTorch's global switches for TF32 for one run.
class Tf32Guard {
 public:
  explicit Tf32Guard(bool allowed)
      : cublas_(at::globalContext().allowTF32CuBLAS()), cudnn_(at::globalContext().allowTF32CuDNN()) {
    set(allowed, allowed);
  }
  ~Tf32Guard() { set(cublas_, cudnn_); }
  Tf32Guard(const Tf32Guard&) = delete;
  Tf32Guard& operator=(const Tf32Guard&) = delete;

 private:
  static void set(bool cublas, bool cudnn) {
    at::globalContext().setAllowTF32CuBLAS(cublas);
    at::globalContext().setAllowTF32CuDNN(cudnn);
  }
  bool cublas_, cudnn_;
};

torch::Device choose_device(const std::string& device) {
  const bool gpu = torch::cuda::is_available();
  if (device == "cpu" || (device == "auto" && !gpu)) return torch::kCPU;
  if (device != "auto" && device != "cuda")
    throw std::invalid_argument("device is '" + device + "'; known: auto, cpu, cuda");
  if (!gpu) throw std::invalid_argument("device is 'cuda', but LibTorch sees no GPU here; auto or cpu will run");
  return {torch::kCUDA, 0};
}

void move(torch::Tensor* tensor, const torch::Device& device) {
  if (tensor->defined()) *tensor = tensor->to(device);
}

}  // namespace

NetworkRunner::NetworkRunner(NetworkInstance network, const RunnerOptions& options)
    : NetworkRunner(std::move(network), options, choose_device(options.device),
                    choose_device(options.device) != torch::kCPU) {}

NetworkRunner::NetworkRunner(NetworkInstance network, const RunnerOptions& options, const torch::Device& accelerator)
    : NetworkRunner(std::move(network), options, accelerator, true) {}

NetworkRunner::NetworkRunner(NetworkInstance network, const RunnerOptions& options, const torch::Device& device,
                             bool accelerated)
    : network_(std::move(network)), options_(options), device_(device), on_accelerator_(accelerated) {
  if (options.precision != "float32" && options.precision != "tf32" && options.precision != "bfloat16")
    throw std::invalid_argument("precision is '" + options.precision + "'; known: float32, tf32, bfloat16");
  network_.module->eval();
  if (!on_accelerator_) return;
  for (const torch::Tensor& tensor : network_.module->parameters())
    host_copy_.push_back(tensor.detach().to(torch::kCPU));
  for (const torch::Tensor& tensor : network_.module->buffers()) host_copy_.push_back(tensor.detach().to(torch::kCPU));
  try {
    network_.module->to(device_);
  } catch (const std::exception& error) {
    leave_accelerator(error.what());
  }
}

std::vector<NetworkStep> NetworkRunner::run(const NetworkInput& input, const NetworkGrid& grid, const NetworkRun& run) {
  if (!on_accelerator_) return run_on(device_, input, grid, run);
  try {
    return run_on(device_, input, grid, run);
  } catch (const std::invalid_argument&) {
    throw;  // the caller's fault, on any device
  } catch (const std::exception& error) {
    leave_accelerator(error.what());
  }
  return run_on(device_, input, grid, run);
}

std::string NetworkRunner::device() const { return device_.str(); }

std::vector<NetworkStep> NetworkRunner::run_on(const torch::Device& device, NetworkInput input, const NetworkGrid& grid,
                                               const NetworkRun& run) {
  const torch::NoGradGuard no_grad;
  for (torch::Tensor* tensor : {&input.slices, &input.transforms, &input.positions, &input.slice_counts, &input.times})
    move(tensor, device);
  std::vector<NetworkStep> steps;
  {
    const Tf32Guard guard(options_.precision == "tf32");
    NetworkRun chosen = run;
    if (options_.precision == "bfloat16") chosen.precision = torch::kBFloat16;
    steps = network_.module->run(input, grid, chosen);
  }
  // Copying waits for the device: what fails there fails here.
  for (NetworkStep& step : steps) {
    for (torch::Tensor* tensor : {&step.points, &step.transforms, &step.weights, &step.volume, &step.attention})
      move(tensor, torch::kCPU);
  }
  return steps;
}

void NetworkRunner::leave_accelerator(const std::string& reason) {
  // The first line says what happened; LibTorch appends its stack.
  diagnostic_ = device_.str() + " failed, the network goes on on the CPU: " + reason.substr(0, reason.find('\n'));
  device_ = torch::kCPU;
  on_accelerator_ = false;
  std::size_t next = 0;
  // set_data: copying from a lost device would fail again.
  for (torch::Tensor& tensor : network_.module->parameters()) tensor.set_data(host_copy_[next++]);
  for (torch::Tensor& tensor : network_.module->buffers()) tensor.set_data(host_copy_[next++]);
  host_copy_.clear();
}

}  // namespace svort
