#pragma once

#include <atomic>
#include <chrono>
#include <cstddef>
#include <functional>
#include <string>
#include <thread>

#include "svort_ros/ros/inbox.h"
#include "svort_ros/ros/scan_archive.h"

namespace svort_ros {

/// What has become of a scan that ended.
struct FinishedScan {
  ArchivedScan scan;
  bool final = false;       ///< poses and volume are; else the finisher was stopped before, or the estimator failed
  std::string failure;      ///< of the estimator; empty: none
  bool written = false;     ///< into scan.folder
  std::string not_written;  ///< why; empty if there is an archive to write to, and it worked
  double seconds = 0.;      ///< since it was taken
};

/// Finalises scans that have ended and writes them, one after another, in a thread of its own: that takes from seconds
/// to a minute, and the next scan's slices must not wait for it. It takes one core, so that they find another.
class ScanFinisher {
 public:
  using Done = std::function<void(FinishedScan)>;

  /// @param archive write() is called; must outlive this object
  /// @param done    called from the finisher's thread, once for each scan
  ScanFinisher(const ScanArchive& archive, Done done);
  ~ScanFinisher() { stop(); }

  /// @throws std::logic_error after stop()
  void take(ArchivedScan scan);

  /// Scans that are not done yet.
  std::size_t count() const { return count_; }

  /// What is not finalised yet is written as it is. Returns when all scans are done.
  void stop();

 private:
  struct Item {
    ArchivedScan scan;
    std::chrono::steady_clock::time_point taken;
    int threads = 0;  ///< of the thread that gave it
  };
  void run();
  FinishedScan finish(Item item) const;

  const ScanArchive& archive_;
  const Done done_;
  Inbox<Item> inbox_;
  std::atomic<std::size_t> count_{0};
  std::atomic<bool> stop_{false};
  std::thread thread_;  ///< last: it uses all of the above
};

}  // namespace svort_ros
