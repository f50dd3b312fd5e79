#pragma once

#include <torch/nn/module.h>

#include <array>
#include <cstdint>
#include <vector>

#include "svort_ros/acquisition/slice_acquisition.h"

namespace svort {

class StageClock;

/// What a pose network sees: n slices of one scan, or of a prefix of it, in acquisition order. All tensors are on one
/// device and float32 unless said otherwise.
struct NetworkInput {
  torch::Tensor slices;  ///< n x 1 x h x w, intensity 0 to about 1, 0 off the brain
  torch::Tensor
      transforms;           ///< n x 3 x 4, trans_first, mm: where each slice is thought to be before the network speaks
  torch::Tensor positions;  ///< n x 2: slice index counted from the middle of its stack (index - count / 2), and stack
  torch::Tensor slice_counts;       ///< n, int64: slices prescribed for the slice's stack; versions 1 and 2 ignore it
  torch::Tensor times;              ///< n: acquisition time since the first slice, s; versions 1 and 2 ignore it
  bool common_frame = true;         ///< `transforms` of all stacks are in one frame; false: each stack has its own
  double slice_resolution_mm = 1.;  ///< pixel size
  double thickness_mm = 3.;         ///< slice thickness (FWHM)
};

/// The volume that a network estimates on the way.
struct NetworkGrid {
  std::array<std::int64_t, 3> volume_shape = {128, 128, 128};  ///< D, H, W
  double resolution_mm = 1.;
};

/// How a network is run.
struct NetworkRun {
  int iterations = 0;  ///< K; 0: as many as the network was made for
  AcquisitionFormulation formulation = AcquisitionFormulation::exact;
  /// bfloat16: coarser and, on hardware that has it, faster layers, for networks that offer it; geometry stays float32.
  torch::ScalarType precision = torch::kFloat32;
  StageClock* clock = nullptr;  ///< takes the time of each stage, if not null
};

/// State after one iteration: transformation update, then volume estimation.
struct NetworkStep {
  torch::Tensor points;      ///< n x 9, anchor points, mm
  torch::Tensor transforms;  ///< n x 3 x 4, trans_first, mm
  torch::Tensor weights;     ///< n, quality of each slice; undefined if the network has none
  torch::Tensor volume;      ///< D x H x W; undefined if the network estimates none
  torch::Tensor attention;   ///< heads x n x n, weights of the last layer; undefined if the network has none
};

/// A network that turns slices into poses: SVoRT in its versions, the live network, the baselines of the paper.
class PoseNetwork : public torch::nn::Module {
 public:
  using torch::nn::Module::Module;

  /// @return one entry per iteration, the last one is the result
  /// @throws std::invalid_argument naming the tensor or option that does not fit
  virtual std::vector<NetworkStep> run(const NetworkInput& input, const NetworkGrid& grid, const NetworkRun& run) = 0;
};

}  // namespace svort
