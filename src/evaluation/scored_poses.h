#pragma once

#include <torch/types.h>

#include <chrono>
#include <vector>

#include "svort_ros/evaluation/accuracy.h"
#include "svort_ros/metrics/pose_error.h"
#include "svort_ros/registration/registration_input.h"

namespace svort {

// What all measurements of accuracy do alike.

constexpr AnchorFrame kEvaluationFrame{};  // 128 x 128 pixels of 1 mm, as the paper's planes

/// Seconds since it was made.
class Stopwatch {
 public:
  double seconds() const { return std::chrono::duration<double>(std::chrono::steady_clock::now() - start_).count(); }

 private:
  std::chrono::steady_clock::time_point start_ = std::chrono::steady_clock::now();
};

/// left * each pose.
std::vector<Pose> moved(const Pose& left, const std::vector<Pose>& poses);
/// Each pose * the right one of its index.
std::vector<Pose> composed(const std::vector<Pose>& poses, const std::vector<Pose>& right);

/// Registration sees relative motion only: the whole may drift meanwhile. This takes the drift out again, so that where
/// the start poses were together is where the refined ones are, in the least-squares sense.
std::vector<Pose> without_drift(const std::vector<Pose>& refined, const std::vector<Pose>& start);

/// @param T_canonical_brain from the method's brain frame into the canonical one
FrameScore score_frame(const std::vector<Pose>& T_brain_slice, const std::vector<Pose>& truth,
                       const Pose& T_canonical_brain, bool sure);

/// Over the brain, after the gain that fits best.
VolumeScore score_volume(const torch::Tensor& volume, const torch::Tensor& truth);

/// The forward model between the crops and the grid of EvaluationScan::volume.
SliceAcquisition acquisition_on_truth(const EvaluationScan& scan, const RegistrationInput& input,
                                      const std::vector<Pose>& T_truth_crop, const EstimatorOptions& options);

}  // namespace svort
