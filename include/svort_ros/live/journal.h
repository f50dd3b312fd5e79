#pragma once

#include <cstdint>
#include <filesystem>
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
  std::size_t sequence_length = 0;   ///< kept slices after this arrival
  std::uint64_t revision = 0;        ///< revision in which the slice's pose was published
  double latency_ms = 0.;            ///< arrival to published pose (rejected: to the answer)
  double volume_latency_ms = 0.;     ///< arrival to the volume that contains it; NaN if it was overtaken
  std::size_t encoded = 0;
  std::string device;
  Pose T_brain_slice = Pose::Identity();  ///< causal pose; NaN in the file if the slice was rejected
};

/// The record of a scan: every arrival with its answer and its causal pose.
class Journal {
 public:
  void add(const JournalEntry& entry) { entries_.push_back(entry); }
  /// Writes the volume latency of all entries since the last call that have none yet.
  void clear() { entries_.clear(); }
  const std::vector<JournalEntry>& entries() const { return entries_; }
  std::vector<JournalEntry>& entries() { return entries_; }

 private:
  std::vector<JournalEntry> entries_;
};

}  // namespace svort
