#include "svort_ros/live/nominal_estimator.h"

#include <algorithm>
#include <limits>
#include <stdexcept>

#include "svort_ros/live/volume_update.h"

namespace svort {
NominalEstimator::NominalEstimator(const EstimatorOptions& options) : options_(options) {
  validate(options);
  formulation_ = acquisition_formulation(options.formulation);
  grid_ = volume_grid(options);
}

void NominalEstimator::add(const SliceSequence& sequence) {
  const auto newest = sequence.newest_arrival();
  if (!newest) throw std::logic_error("NominalEstimator::add: the sequence holds no slice");

  SliceEstimate slice;
  slice.info = newest->info;
  slice.ncc = std::numeric_limits<double>::quiet_NaN();
  const auto& ordered = sequence.slices();
  const auto position = std::find(ordered.begin(), ordered.end(), newest) - ordered.begin();
  estimate_.slices.insert(estimate_.slices.begin() + position, slice);

  const Eigen::Vector3d centre =
      sequence.brain_roi().empty() ? newest->info.T_scanner_slice.translation() : sequence.brain_roi().centre();
  const bool first = estimate_.slices.size() == 1;
  if (first || (centre - T_scanner_brain_.translation()).norm() > options_.recentre_mm) {
    T_scanner_brain_.setIdentity();
    T_scanner_brain_.translation() = centre;
    if (!first) ++estimate_.frame_revision;
    make_nominal();
  } else {
    SliceEstimate& added = estimate_.slices[static_cast<std::size_t>(position)];
    added.T_scanner_brain = T_scanner_brain_;
    added.T_brain_slice = T_scanner_brain_.inverse() * added.info.T_scanner_slice;
  }
  estimate_.scan_id = sequence.scan_id();
  estimate_.final = false;
  ++estimate_.revision;
}

void NominalEstimator::make_nominal() {
  for (SliceEstimate& each : estimate_.slices) {
    each.T_scanner_brain = T_scanner_brain_;
    each.T_brain_slice = T_scanner_brain_.inverse() * each.info.T_scanner_slice;
    each.weight = 1.;
    each.status = PoseStatus::nominal;
  }
  estimate_.encoded = 0;
}

void NominalEstimator::update_volume(const SliceSequence& sequence) {
  volume_ = estimate_volume(sequence, grid_, formulation_, options_.cg_iterations, &estimate_.slices);
  estimate_.agreement = agreement_of(sequence, estimate_.slices);
  ++estimate_.revision;
}

void NominalEstimator::finalise(const SliceSequence& sequence, const std::atomic<bool>* /*stop*/) {
  volume_ = estimate_final_volume(sequence, options_, &estimate_.slices);
  estimate_.agreement = agreement_of(sequence, estimate_.slices);
  estimate_.final = true;
  ++estimate_.revision;
}

void NominalEstimator::reset() {
  const std::uint64_t revision = estimate_.revision;
  estimate_ = Estimate();
  estimate_.revision = revision;
  volume_ = Volume();
}

}  // namespace svort
