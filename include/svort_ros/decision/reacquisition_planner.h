#pragma once

#include <cstdint>
#include <map>
#include <set>
#include <string>
#include <utility>
#include <vector>

#include "svort_ros/decision/coverage.h"
#include "svort_ros/decision/motion_monitor.h"
#include "svort_ros/decision/slice_quality.h"

namespace svort {

struct ReacquisitionOptions {
  bool dry_run = true;            ///< only propose; off: the requests are meant to be obeyed
  double budget_s = 60.;          ///< scan time that requests may take in all
  double delay_s = 30.;           ///< a slice is not asked for again within this time
  double overhead_s = 0.5;        ///< cost of a request beside the slice's own repetition time
  int confirm_updates = 3;        ///< a request is made once it was wanted in so many updates in a row
  int open_requests = 8;          ///< most requests that wait at a time
  double least_gain = 0.005;      ///< a request must raise the brain's mean coverage score by this
  double same_plane_deg = 15.;    ///< two planes are the same if their normals differ by less
  double same_plane_share = 0.6;  ///< and their distance is below this share of the slice thickness

  template <class Visitor>
  void visit(Visitor&& v) {
    v("dry_run", dry_run, "only propose; false: the requests are meant to be obeyed");
    v("budget_s", budget_s, "scan time that requests may take in all, s");
    v("delay_s", delay_s, "a slice is not asked for again within this time, s");
    v("overhead_s", overhead_s, "cost of a request beside the slice's own repetition time, s");
    v("confirm_updates", confirm_updates, "a request is made once it was wanted in so many updates in a row");
    v("open_requests", open_requests, "most requests that wait at a time");
    v("least_gain", least_gain, "a request must raise the brain's mean coverage score by this");
    v("same_plane_deg", same_plane_deg, "two planes are the same if their normals differ by less, degrees");
    v("same_plane_share", same_plane_share, "and their distance is below this share of the slice thickness");
  }
};

/// @throws std::invalid_argument naming the option that is out of range
void validate(const ReacquisitionOptions& options);

enum class RequestState {
  proposed,   ///< dry run: nobody is asked to obey
  requested,  ///< the scanner should acquire it
  fulfilled,  ///< a slice has come that shows this plane
  vetoed,     ///< the operator does not want it
  withdrawn,  ///< no longer worth it
};
const char* to_string(RequestState state);

/// A slice to acquire.
struct ReacquisitionRequest {
  int id = 0;    ///< from 1
  int rank = 0;  ///< 1 is the most urgent of those that wait; 0 if it does not wait any more
  RequestState state = RequestState::proposed;
  std::int64_t asked_ns = 0;              ///< acquisition time of the newest slice when it was asked for
  bool again = false;                     ///< the prescription of slice `index` of `stack`, once more; else a new plane
  int stack = 0;                          ///< whose orientation and spacing it has
  int index = 0;                          ///< its place in that stack; may lie beyond its ends
  std::vector<std::string> reasons;       ///< codes: docs/reacquisition.md lists them
  Pose T_brain_slice = Pose::Identity();  ///< what it should show
  Pose T_scanner_slice = Pose::Identity();  ///< where that is now, moved with the head
  double thickness_mm = 0.;
  double gain = 0.;    ///< expected rise of the brain's mean coverage score
  double cost_s = 0.;  ///< scan time
};

/// One line of the audit log.
struct PlannerEvent {
  std::int64_t stamp_ns = 0;
  std::uint64_t revision = 0;
  std::string event;  ///< a RequestState, or "delayed", "over_budget", "options"
  ReacquisitionRequest request;
  double budget_left_s = 0.;
  std::string detail;  ///< e.g. the operator's reason for a veto
};

/// What the planner knows beside the map.
struct PlannerInput {
  const Estimate* estimate = nullptr;
  const QualityMonitor* quality = nullptr;
  const CoverageMap* coverage = nullptr;
  const MotionReport* motion = nullptr;
  std::vector<std::pair<int, int>> answered;  ///< stack and index of every slice that came, in that order, empty too
  double accept = 0.5;                        ///< score below which a slice should be acquired again
  CoverageOptions coverage_options;
};

/// What is still to do, at the present motion.
struct Completion {
  int slices = 0;       ///< that the scan still needs, those of the stacks in hand included
  double seconds = 0.;  ///< NaN if no slice can be expected to be good
  double yield = 1.;    ///< mean score of the last slices: what the next one is expected to be worth
};

/// Says which slices to acquire, again or newly, while the scan runs. Deterministic. Not thread-safe: one owner.
class ReacquisitionPlanner {
 public:
  /// @throws std::invalid_argument naming the option that is out of range
  explicit ReacquisitionPlanner(const ReacquisitionOptions& options);

  void update(const PlannerInput& input);

  /// The operator does not want a request (0: any of those that wait). It is not made again, nor the same plane.
  /// @return how many were vetoed
  int veto(int id, const std::string& reason);

  /// Those that wait, most urgent first.
  std::vector<ReacquisitionRequest> waiting() const;
  /// All requests so far.
  const std::vector<ReacquisitionRequest>& requests() const { return requests_; }
  const std::vector<PlannerEvent>& events() const { return events_; }
  const Completion& completion() const { return completion_; }
  double budget_left_s() const;
  void set_options(const ReacquisitionOptions& options);
  void note(const std::string& event, const std::string& detail);
  void clear();

 private:
  /// Fixes a request's plane to a slice, so that steps of the brain frame do not matter.
  struct Anchor {
    int stack = 0, index = 0;
    Pose T_slice_plan = Pose::Identity();
  };
  void follow(const PlannerInput& input);
  void mark(std::size_t request, RequestState state, const std::string& detail);

  ReacquisitionOptions options_;
  std::vector<ReacquisitionRequest> requests_;
  std::vector<Anchor> anchors_;
  std::vector<PlannerEvent> events_;
  Completion completion_;
  std::int64_t now_ns_ = 0;
  std::uint64_t revision_ = 0;
  std::size_t seen_arrivals_ = 0;
  std::set<std::pair<int, int>> known_;
  std::map<std::pair<int, int>, int> wishes_;  ///< planes that were wanted in the last updates, and in how many
  std::set<std::pair<int, int>> held_back_;    ///< plane and kind of notes that were made already
};

}  // namespace svort
