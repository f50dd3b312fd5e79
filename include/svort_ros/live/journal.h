#pragma once

#include <cstdint>
#include <limits>
#include <string>
#include <vector>

#include "svort_ros/geometry/pose.h"
#include "svort_ros/sequence/slice_sequence.h"

namespace svort {

/// One arrival, as it was answered; a row of updates.csv.
struct JournalEntry {
  SliceInfo info;
  ArrivalStatus status = ArrivalStatus::accepted;
  std::string reason;
  std::size_t sequence_length = 0;  ///< kept slices after this arrival
  std::uint64_t revision = 0;       ///< revision in which the slice's pose was published; 0 if rejected
  double latency_ms = 0.;           ///< arrival to published pose (rejected: to the answer)
  /// Arrival to the first published volume that contains the slice; NaN if rejected or not there yet.
  double volume_latency_ms = std::numeric_limits<double>::quiet_NaN();
  /// Arrival to the first decision that was made with the slice; NaN likewise.
  double decision_latency_ms = std::numeric_limits<double>::quiet_NaN();
  std::size_t encoded = 0;  ///< slices that a network encoded for this revision
  std::string device;
  Pose T_brain_slice = Pose::Identity();  ///< causal pose, mm; meaningless if the slice was rejected
  std::string start;                      ///< SliceEstimate::start
  double radius_95_mm = std::numeric_limits<double>::quiet_NaN();  ///< SliceEstimate::radius_95_mm, of the causal pose
};

/// The record of a scan: every arrival with its answer and its causal pose, in arrival order.
class Journal {
 public:
  /// @return the number of the entry, to refer to it later
  std::size_t add(const JournalEntry& entry) {
    entries_.push_back(entry);
    return entries_.size() - 1;
  }
  /// @throws std::out_of_range if there is no such entry
  void set_volume_latency(std::size_t entry, double latency_ms) { entries_.at(entry).volume_latency_ms = latency_ms; }
  /// @throws std::out_of_range if there is no such entry
  void set_decision_latency(std::size_t entry, double latency_ms) {
    entries_.at(entry).decision_latency_ms = latency_ms;
  }
  void clear() { entries_.clear(); }
  const std::vector<JournalEntry>& entries() const { return entries_; }

 private:
  std::vector<JournalEntry> entries_;
};

}  // namespace svort
