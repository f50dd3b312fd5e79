#pragma once

#include <cstddef>
#include <cstdint>
#include <filesystem>
#include <memory>
#include <string>
#include <utility>
#include <vector>

#include "svort_ros/io/results.h"
#include "svort_ros/live/live_pipeline.h"

namespace svort_ros {

/// A scan id as the name of a folder: letters, digits, '.', '_' and '-' stay, all else becomes '_'; never empty,
/// hidden or longer than 100 characters.
std::string folder_name(const std::string& scan_id);

/// A scan, and what is written of it.
struct ArchivedScan {
  std::unique_ptr<svort::LivePipeline> pipeline;
  std::unique_ptr<svort::DecisionEngine> decisions;  ///< may be null
  svort::RunInfo run;
  std::filesystem::path folder;       ///< empty until it was written
  std::uint64_t revision_offset = 0;  ///< what was added to the pipeline's revisions where they were published
};

/// Where the node writes its scans: one folder per scan below `root`. A folder that another run left is not touched,
/// the scan's name gets a number then ("scan_2"). Saving a scan again replaces its own files.
class ScanArchive {
 public:
  /// @param root may be empty: then save() fails and says so
  explicit ScanArchive(std::filesystem::path root) : root_(std::move(root)) {}

  bool enabled() const { return !root_.empty(); }

  /// Writes the scan in hand. @return its folder @throws std::runtime_error naming the file and the reason
  std::filesystem::path save(const svort::LivePipeline& pipeline, const svort::RunInfo& run,
                             const svort::DecisionEngine* decisions = nullptr);

  /// The next save() is of another scan. @return the folder of the one that ends; empty if it was not saved
  std::filesystem::path begin_scan() { return std::exchange(folder_, {}); }

  /// Writes a scan that has ended, and sets its folder. Safe to call while another thread calls the other members.
  /// @throws std::runtime_error naming the file and the reason
  void write(ArchivedScan* scan) const { write(*scan->pipeline, scan->run, scan->decisions.get(), &scan->folder); }

  /// Keeps a scan that ended but could not be written; retry() tries again.
  void keep(ArchivedScan scan) { kept_.push_back(std::move(scan)); }
  std::size_t kept() const { return kept_.size(); }

  struct Retry {
    std::vector<std::filesystem::path> written;
    std::vector<std::string> failures;
  };
  /// Writes what keep() holds; what fails again stays.
  Retry retry();

 private:
  /// Fills `folder` if it is empty, and writes.
  void write(const svort::LivePipeline& pipeline, const svort::RunInfo& run, const svort::DecisionEngine* decisions,
             std::filesystem::path* folder) const;

  const std::filesystem::path root_;
  std::filesystem::path folder_;  ///< of the scan in hand; empty until it was saved
  std::vector<ArchivedScan> kept_;
};

}  // namespace svort_ros
