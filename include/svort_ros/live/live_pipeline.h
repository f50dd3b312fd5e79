#pragma once

#include <atomic>
#include <functional>
#include <memory>
#include <string>
#include <vector>

#include "svort_ros/live/incremental_estimator.h"
#include "svort_ros/live/journal.h"
#include "svort_ros/sequence/slice_sequence.h"

namespace svort {

/// Everything that shapes the result; one section each in the configuration files.
struct PipelineOptions {
  SliceSequenceOptions sequence;
  EstimatorOptions estimator;

  template <class Visitor>
  void visit(Visitor&& v) {
    v.section("sequence", sequence);
    v.section("estimator", estimator);
  }
};

/// Slices in, estimates out: the part that the live node and the offline replay share. Not thread-safe: one owner.
///
/// With the budget "iterations", for the same slices in the same order, poses and the final volume are the same bytes
/// however the calls of update_volume() fall between them (with the same number of threads).
class LivePipeline {
 public:
  /// @throws std::invalid_argument naming the option that is out of range
  /// @param templates see make_estimator()
  explicit LivePipeline(const PipelineOptions& options, std::vector<BrainTemplate> templates = {});

  /// Called by add() when a slice with a new scan id ends the current scan, after finalise() and before the scan is
  /// forgotten: the last chance to save it.
  void set_scan_end_callback(std::function<void(const LivePipeline&)> callback);

  /// Validates and takes in one slice. The estimate() afterwards holds its pose, if it was kept.
  Arrival add(const Slice& slice);

  /// Volume from the current poses. Does nothing (and returns false) if nothing was kept since the last one.
  bool update_volume();

  /// Improves older poses by one step, if EstimatorOptions::budget is "time". @return false if there is nothing to gain
  bool improve();

  /// Final poses and volume. Does nothing (and returns false) without slices, or if they are final already.
  /// @param stop if not null and set meanwhile: gives up soon, nothing has changed then (and returns false)
  bool finalise(const std::atomic<bool>* stop = nullptr);

  /// Forgets scan and journal.
  void reset();

  const SliceSequence& sequence() const { return sequence_; }
  const Estimate& estimate() const { return estimator_->estimate(); }
  const Volume& volume() const { return estimator_->volume(); }
  /// Estimate of the slice kept by the last add() that kept one; null before.
  const SliceEstimate* newest() const;
  std::string device() const { return estimator_->device(); }
  EstimatorNotes notes() const { return estimator_->notes(); }
  const PipelineOptions& options() const { return options_; }
  Journal& journal() { return journal_; }
  const Journal& journal() const { return journal_; }

 private:
  PipelineOptions options_;
  SliceSequence sequence_;
  std::unique_ptr<IncrementalEstimator> estimator_;
  Journal journal_;
  std::function<void(const LivePipeline&)> on_scan_end_;
  bool volume_is_stale_ = false;
};

}  // namespace svort
