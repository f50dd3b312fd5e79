#pragma once

#include <string>

#include "svort_ros/acquisition/slice_acquisition.h"
#include "svort_ros/live/incremental_estimator.h"

namespace svort {

/// Takes the scanner's prescription for the truth: the head does not move, only the volume is estimated.
///
/// The brain frame has the scanner's axes and its origin at the brain's centre as the masks show it. While the first
/// stack grows that centre is found step by step; such a step is a frame revision, not motion.
class NominalEstimator : public IncrementalEstimator {
 public:
  /// @throws std::invalid_argument naming the option that is out of range
  explicit NominalEstimator(const EstimatorOptions& options);

  void add(const SliceSequence& sequence) override;
  void update_volume(const SliceSequence& sequence) override;
  void finalise(const SliceSequence& sequence, const std::atomic<bool>* stop) override;
  void reset() override;
  const Estimate& estimate() const override { return estimate_; }
  const Volume& volume() const override { return volume_; }
  std::string device() const override { return "cpu"; }

 protected:
  /// Puts every slice where the scanner said it was, in this estimator's brain frame.
  void make_nominal();

  Estimate estimate_;

 private:
  EstimatorOptions options_;
  AcquisitionFormulation formulation_;
  ImageGrid grid_;
  Pose T_scanner_brain_ = Pose::Identity();
  Volume volume_;
};

}  // namespace svort
