#pragma once

#include <torch/types.h>

#include <cstdint>
#include <map>
#include <memory>
#include <string>
#include <vector>

#include "svort_ros/network/baselines.h"
#include "svort_ros/network/live_network.h"
#include "svort_ros/network/pose_network.h"
#include "svort_ros/network/svort.h"
#include "svort_ros/simulation/scan_simulator.h"

namespace svort {

/// Loss of one step: what is minimised, and its parts for the log.
struct StepLoss {
  torch::Tensor total;                  ///< scalar with a graph
  std::map<std::string, double> parts;  ///< by name; a part that did not occur in this step is not there
};

/// How a network is trained: from scans to a loss. One per kind of network.
class TrainingRecipe {
 public:
  virtual ~TrainingRecipe() = default;
  virtual PoseNetwork& network() = 0;
  /// Names of all parts that loss() may report, in the order of the log's columns.
  virtual std::vector<std::string> parts() const = 0;
  /// @param scans at least one, none without slices
  /// @param step  number of the step: what is random in the recipe depends on it and the seed alone; the loss also on
  ///              the network and on memory()
  virtual StepLoss loss(const std::vector<SimulatedScan>& scans, std::uint64_t step) = 0;
  /// How many scans of a step loss() takes at once: gradients of the others are added up. 0: all.
  virtual std::size_t scans_at_once() const { return 0; }
  /// What the recipe carries from step to step beside the network, by name: part of the trainer's state.
  virtual std::map<std::string, torch::Tensor> memory() const { return {}; }
  /// Takes back what memory() gave. @throws std::runtime_error naming what does not fit
  virtual void remember(const std::map<std::string, torch::Tensor>& memory);
};

/// How the live network is trained.
struct LiveRecipeOptions {
  double frame_share = 0.;           ///< share of steps that train the frame network
  double first_share = 0.8;          ///< share of the other steps that train the first network; the rest the shared one
  double beta = 0.5;                 ///< where smooth L1 of the first network becomes linear, in its unit (50 mm)
  double shared_beta = 0.1;          ///< the same of the shared network, in its unit (10 mm)
  double mirror_weight = 1.;         ///< of the mirror head's loss
  double scale_weight = 0.05;        ///< of the loss of the expected error
  double quality_weight = 0.05;      ///< of the loss of the slice's weight
  double placed_share = 0.5;         ///< share of scans that start where the first network, as it is now, places them
  double perturb_deg = 8.;           ///< rotation of perturbed slices, per axis, at most, degrees
  double perturb_mm = 6.;            ///< displacement of perturbed slices, per axis, at most, mm
  double global_deg = 6.;            ///< rotation of the whole start, per axis, degrees
  double global_mm = 3.;             ///< displacement of the whole start, per axis, mm
  double frame_deg = 15.;            ///< rotation of brains whose frame is to be corrected, per axis, at most, degrees
  double frame_mm = 10.;             ///< their displacement, per axis, at most, mm
  int frame_bank = 2048;             ///< volumes that the frame network's training draws from; 0.13 MB each
  int frame_batch = 32;              ///< volumes of a step of the frame network
  double second_update_share = 0.4;  ///< share of steps that make one update without gradient before the one with
  double pulls_unknown_share = 0.1;  ///< share of steps in which the shared network is not told of pulls

  template <class Visitor>
  void visit(Visitor&& v) {
    v("frame_share", frame_share, "share of steps that train the frame network");
    v("first_share", first_share, "share of the other steps that train the first network; the rest the shared one");
    v("beta", beta, "where smooth L1 of the first network becomes linear, in its unit (50 mm)");
    v("shared_beta", shared_beta, "the same of the shared network, in its unit (10 mm)");
    v("mirror_weight", mirror_weight, "weight of the mirror head's loss");
    v("scale_weight", scale_weight, "weight of the loss of the expected error");
    v("quality_weight", quality_weight, "weight of the loss of the slices' quality");
    v("placed_share", placed_share,
      "share of warm starts that the first network has placed, as it is now; others are perturbed truth");
    v("perturb_deg", perturb_deg, "largest rotation of perturbed slices, per axis, degrees");
    v("perturb_mm", perturb_mm, "largest displacement of perturbed slices, per axis, mm");
    v("global_deg", global_deg, "rotation of the whole start, standard deviation per axis, degrees");
    v("global_mm", global_mm, "displacement of the whole start, standard deviation per axis, mm");
    v("frame_deg", frame_deg, "largest standard deviation of the rotation of brains for the frame network, degrees");
    v("frame_mm", frame_mm, "largest standard deviation of their displacement, per axis, mm");
    v("frame_bank", frame_bank, "volumes that the frame network's training draws from: those of the latest scans");
    v("frame_batch", frame_batch, "volumes of a step of the frame network");
    v("second_update_share", second_update_share, "share of steps with one update before the one that has a gradient");
    v("pulls_unknown_share", pulls_unknown_share, "share of steps in which the shared network is not told of pulls");
  }
};

/// What is in volumes, each moved as one body, as far as it stays within the volume's field.
/// @param volumes    b x c x d x d x d
/// @param motions    b x 3 x 4, trans_first, mm, about the middle of the volume
/// @param half_width of a volume, mm
/// @return b x c x d x d x d, interpolated linearly
torch::Tensor moved_as_one(const torch::Tensor& volumes, const torch::Tensor& motions, double half_width);

/// Live recipe: smooth L1 on anchor points, a mirror head that may be wrong by a reflection, and warm starts.
///
/// A step trains either the first network, or one random iteration of the shared network: from where the first network
/// places the slices, as it is now, or from the truth, perturbed, after no or one update without gradient. The volume
/// is the PSF reconstruction at those places, without gradient. The update is to put slices where they belong among the
/// others: its target is the truth, moved as one body to where most slices lie, because LiveNetwork::find_frame() says
/// afterwards where the whole lies. Or it trains the frame network, on volumes of slices near their true places, moved
/// as one body: a bank of volumes of the latest scans is kept, and every step draws from it, because volumes of one or
/// two brains are no batch to learn turns from, and a brain costs far more to simulate than to move.
class LiveRecipe : public TrainingRecipe {
 public:
  /// @throws std::invalid_argument naming the option that is out of range
  LiveRecipe(std::shared_ptr<LiveNetwork> network, const LiveRecipeOptions& options, std::uint64_t seed);

  PoseNetwork& network() override { return *network_; }
  std::vector<std::string> parts() const override;
  StepLoss loss(const std::vector<SimulatedScan>& scans, std::uint64_t step) override;
  std::map<std::string, torch::Tensor> memory() const override;
  void remember(const std::map<std::string, torch::Tensor>& memory) override;

 private:
  std::int64_t bank_rows() const;
  void make_bank(const torch::Device& device);
  /// @param first number of the first of the scan's volumes: what is random in them depends on it and the seed
  void put_into_bank(const SimulatedScan& scan, std::uint64_t first);
  StepLoss frame_loss(const std::vector<SimulatedScan>& scans, std::uint64_t step);
  torch::Tensor warm_start(const SimulatedScan& scan, std::uint64_t step, std::uint64_t index);
  StepLoss first_loss(const NetworkInput& input, const torch::Tensor& truth, const torch::Tensor& good,
                      const std::vector<std::int64_t>& lengths);
  StepLoss shared_loss(const std::vector<SimulatedScan>& scans, NetworkInput input, const torch::Tensor& truth,
                       const torch::Tensor& good, const std::vector<std::int64_t>& lengths, std::uint64_t step);

  std::shared_ptr<LiveNetwork> network_;
  LiveRecipeOptions options_;
  std::uint64_t seed_;
  torch::Tensor bank_views_;   // up to frame_bank x kLiveFrameChannels x d x d x d, half, see live_frame_view()
  torch::Tensor bank_frames_;  // as many x 3 x 4, CPU: the motion that brings that volume's brain to where it belongs
  std::int64_t banked_ = 0;    // volumes so far; the next one's row is that modulo frame_bank
};

/// The paper's recipe for its baselines: squared distance of the anchor points.
class AnchorRecipe : public TrainingRecipe {
 public:
  explicit AnchorRecipe(std::shared_ptr<AnchorRegressor> network) : network_(std::move(network)) {}

  PoseNetwork& network() override { return *network_; }
  std::vector<std::string> parts() const override { return {"points"}; }
  StepLoss loss(const std::vector<SimulatedScan>& scans, std::uint64_t step) override;

 private:
  std::shared_ptr<AnchorRegressor> network_;
};

/// How SVoRT version 1 is trained.
struct PaperRecipeOptions {
  double point_weight = 0.1;    ///< of the mean squared distance of the anchor points' coordinates, mm^2
  double volume_weight = 100.;  ///< lambda of the paper: of the mean absolute difference of the volumes
  double volume_beta = 0.01;    ///< the difference is squared where it is smaller, as in the public implementation

  template <class Visitor>
  void visit(Visitor&& v) {
    v("point_weight", point_weight, "of the mean squared distance of the anchor points, mm^2");
    v("volume_weight", volume_weight, "of the mean absolute difference of the volumes (lambda of the paper)");
    v("volume_beta", volume_beta, "differences of the volumes below this count squared");
  }
};

/// The paper's recipe for version 1 (sec. 2.4): squared distance of the anchor points and absolute difference of the
/// volumes, summed over the iterations. The pose networks learn from the points, the quality network from the volume,
/// whose weighted inverse problem is differentiable in the slices' weights. Scan by scan: the batch that is normalised
/// over is the scan.
class PaperRecipe : public TrainingRecipe {
 public:
  /// @param grid      of SimulatedScan::volume, with which the network's volumes are compared
  /// @param precision of the networks' layers
  /// @throws std::invalid_argument naming the option that is out of range
  PaperRecipe(std::shared_ptr<SvortV1> network, const PaperRecipeOptions& options, const NetworkGrid& grid,
              torch::ScalarType precision = torch::kFloat32);

  PoseNetwork& network() override { return *network_; }
  std::vector<std::string> parts() const override { return {"points", "volume", "last_points", "start_points"}; }
  StepLoss loss(const std::vector<SimulatedScan>& scans, std::uint64_t step) override;
  std::size_t scans_at_once() const override { return 1; }

 private:
  std::shared_ptr<SvortV1> network_;
  PaperRecipeOptions options_;
  NetworkGrid grid_;
  torch::ScalarType precision_;
};

/// Several scans as one input, one after another. `slice_resolution_mm` must agree; `thickness_mm` and `common_frame`
/// are those of the first.
NetworkInput concatenate(const std::vector<const NetworkInput*>& inputs);

}  // namespace svort
