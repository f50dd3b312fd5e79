#pragma once

#include <chrono>
#include <cstddef>
#include <string>
#include <utility>
#include <vector>

#include "svort_ros/live/live_pipeline.h"

namespace svort_ros {

// What the live node and the offline replay say about an arriving slice, in one place, so that they agree.

using Clock = std::chrono::steady_clock;

double milliseconds_since(Clock::time_point start);

/// The journal's row for a slice that was answered just now; `latency_ms` and the later volume are for the caller.
svort::JournalEntry make_journal_entry(const svort::LivePipeline& pipeline, const svort::SliceInfo& info,
                                       const svort::Arrival& arrival);

/// How far the head was from where it was at the first slice (by acquisition time). Both poses are of the same
/// revision, so a step of the brain frame does not count as motion.
struct HeadDisplacement {
  double distance_mm = 0.;  ///< of the brain frame's origin
  double angle_deg = 0.;
};
HeadDisplacement head_displacement(const svort::SliceEstimate& first, const svort::SliceEstimate& slice);

/// How many slices are done of how many that the stacks seen so far prescribe.
class ScanProgress {
 public:
  /// Slices that are kept or empty count; repeated and broken ones do not.
  void add(const svort::SliceInfo& info, svort::ArrivalStatus status);
  void clear() { *this = ScanProgress(); }
  std::size_t done() const { return done_; }
  std::size_t prescribed() const;

 private:
  std::size_t done_ = 0;
  std::vector<std::pair<int, int>> stacks_;  // number, prescribed slices
};

/// "[ 12/ 66] stack 0 slice  4  accepted", the beginning of a slice's line in every progress display.
std::string progress_head(const ScanProgress& progress, const svort::SliceInfo& info, svort::ArrivalStatus status);

/// The line of a rejected slice: head and reason.
std::string rejection_line(const std::string& head, const svort::JournalEntry& entry);

/// The line of a kept slice: head, latencies, head motion, where the pose comes from.
std::string progress_line(const std::string& head, const svort::JournalEntry& entry, const svort::SliceEstimate& first,
                          const svort::SliceEstimate& slice);

/// Kept slices that no volume contains yet.
class AwaitingVolume {
 public:
  struct Item {
    std::size_t entry = 0;  ///< number in the journal
    Clock::time_point arrived;
    std::string head;  ///< see progress_head()
  };
  void add(Item item) { items_.push_back(std::move(item)); }
  std::size_t size() const { return items_.size(); }
  void clear() { items_.clear(); }

  struct Published {
    Item slice;
    double latency_ms = 0.;  ///< arrival to volume
    std::string line;        ///< see progress_line()
  };
  /// Call when a volume was published: notes the latencies in the journal.
  std::vector<Published> volume_published(svort::LivePipeline& pipeline);

 private:
  std::vector<Item> items_;
};

}  // namespace svort_ros
