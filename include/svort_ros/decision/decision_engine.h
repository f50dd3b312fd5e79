#pragma once

#include <cstdint>
#include <string>
#include <vector>

#include "svort_ros/decision/coverage.h"
#include "svort_ros/decision/motion_monitor.h"
#include "svort_ros/decision/reacquisition_planner.h"
#include "svort_ros/decision/slice_quality.h"
#include "svort_ros/live/live_pipeline.h"

namespace svort {

/// The thresholds of everything that is decided; all may change while a scan runs.
struct DecisionOptions {
  MotionMonitorOptions motion;
  SliceQualityOptions quality;
  CoverageOptions coverage;
  ReacquisitionOptions reacquisition;

  template <class Visitor>
  void visit(Visitor&& v) {
    v.section("motion", motion);
    v.section("quality", quality);
    v.section("coverage", coverage);
    v.section("reacquisition", reacquisition);
  }
};

/// @throws std::invalid_argument naming the option that is out of range
void validate(const DecisionOptions& options);

/// One update, with the inputs that its decisions were made from: a line of decisions.jsonl.
struct DecisionRecord {
  std::int64_t stamp_ns = 0;
  std::uint64_t revision = 0;
  std::uint64_t frame_revision = 0;
  std::size_t slices = 0;
  SliceQuality newest;   ///< of the slice that came last
  bool accepted = true;  ///< whether it is good enough
  MotionClass motion = MotionClass::none;
  HeadMotion head;  ///< at the newest good slice
  double window_displacement_mm = 0.;
  double coverage = 0.;  ///< mean score
  double seen_well = 0.;
  double complete = 0.;
  Completion completion;
  double budget_left_s = 0.;
  std::vector<ReacquisitionRequest> waiting;
  std::size_t options_version = 0;  ///< counts changes of the thresholds
};

/// Motion, quality, coverage and requests of one scan: what the live node and the offline replay share.
///
/// Deterministic: the same slices, revisions, vetoes and thresholds give the same decisions. Not thread-safe: one
/// owner.
class DecisionEngine {
 public:
  /// @throws std::invalid_argument naming the option that is out of range
  explicit DecisionEngine(const DecisionOptions& options);

  /// Call after each volume. Does nothing (and returns false) without slices, or if the estimate is the last one's.
  bool update(const LivePipeline& pipeline);

  /// See ReacquisitionPlanner::veto().
  int veto(int id, const std::string& reason) { return planner_.veto(id, reason); }

  /// Other thresholds from now on; noted in the audit log. Takes effect with the next update().
  /// @throws std::invalid_argument naming the option that is out of range; the old ones stay then
  void set_options(const DecisionOptions& options);
  /// Forgets the scan, not the thresholds.
  void clear();

  const DecisionOptions& options() const { return options_; }
  const MotionReport& motion() const { return motion_; }
  const std::vector<SliceQuality>& quality() const { return quality_.slices(); }
  const QualityMonitor& quality_monitor() const { return quality_; }
  const CoverageMap& coverage() const { return coverage_; }
  const ReacquisitionPlanner& planner() const { return planner_; }
  const std::vector<DecisionRecord>& records() const { return records_; }

 private:
  DecisionOptions options_;
  std::size_t options_version_ = 0;
  MotionReport motion_;
  QualityMonitor quality_;
  CoverageMap coverage_;
  ReacquisitionPlanner planner_;
  std::vector<DecisionRecord> records_;
  std::uint64_t revision_ = 0;
};

}  // namespace svort
