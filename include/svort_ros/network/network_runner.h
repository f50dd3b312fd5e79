#pragma once

#include <torch/types.h>

#include <string>
#include <vector>

#include "svort_ros/network/network_registry.h"

namespace svort {

/// Where and how finely a network computes.
struct RunnerOptions {
  std::string device = "auto";        ///< auto, cpu or cuda; auto takes a GPU if LibTorch sees one
  std::string precision = "float32";  ///< float32, tf32 (of GPUs alone; the CPU then computes in float32) or bfloat16

  template <class Visitor>
  void visit(Visitor&& v) {
    v("device", device, "where a network runs: auto (a GPU if there is one), cpu or cuda");
    v("precision", precision, "float32, tf32 (GPU only) or bfloat16, faster and coarser in this order");
  }
};

/// Runs a network for inference, on a GPU or the CPU, and goes on without the GPU if that fails. One thread uses it.
///
/// Geometry (transforms, points) stays in float32 whatever the precision of the layers.
class NetworkRunner {
 public:
  /// @throws std::invalid_argument naming the option that is unknown, or a device that is not there
  NetworkRunner(NetworkInstance network, const RunnerOptions& options);
  /// On a given accelerator, whatever `options.device` says.
  NetworkRunner(NetworkInstance network, const RunnerOptions& options, const torch::Device& accelerator);

  /// One run without gradients. If it fails on the accelerator (out of memory, device lost), the network moves to the
  /// CPU for good, diagnostic() says why, and the run is done again there.
  /// @param input on any device
  /// @return one entry per iteration, on the CPU
  /// @throws std::invalid_argument naming what does not fit
  std::vector<NetworkStep> run(const NetworkInput& input, const NetworkGrid& grid, const NetworkRun& run);

  /// "cpu" or "cuda:0": where the next run will be.
  std::string device() const;
  /// What went wrong with the accelerator; empty if nothing did.
  const std::string& diagnostic() const { return diagnostic_; }
  const NetworkInstance& network() const { return network_; }

 private:
  NetworkRunner(NetworkInstance network, const RunnerOptions& options, const torch::Device& device, bool accelerated);
  std::vector<NetworkStep> run_on(const torch::Device& device, NetworkInput input, const NetworkGrid& grid,
                                  const NetworkRun& run);
  void leave_accelerator(const std::string& reason);

  NetworkInstance network_;
  RunnerOptions options_;
  torch::Device device_ = torch::kCPU;
  bool on_accelerator_ = false;
  std::vector<torch::Tensor> host_copy_;  ///< of parameters and buffers: a lost device does not give them back
  std::string diagnostic_;
};

}  // namespace svort
