#pragma once

#include <cstddef>
#include <filesystem>
#include <memory>
#include <string>
#include <vector>

#include "svort_ros/io/results.h"
#include "svort_ros/live/live_pipeline.h"

namespace svort_ros {

/// A scan id as the name of a folder: letters, digits, '.', '_' and '-' stay, all else becomes '_'; never empty,
/// hidden or longer than 100 characters.
std::string folder_name(const std::string& scan_id);

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

  /// The next save() is of another scan.
  void begin_scan() { folder_.clear(); }

  /// Keeps a scan that ended but could not be written; retry() tries again.
  void keep(std::unique_ptr<svort::LivePipeline> pipeline, svort::RunInfo run,
            std::unique_ptr<svort::DecisionEngine> decisions = nullptr);
  std::size_t kept() const { return kept_.size(); }

  struct Retry {
    std::vector<std::filesystem::path> written;
    std::vector<std::string> failures;
  };
  /// Writes what keep() holds; what fails again stays.
  Retry retry();

 private:
  struct Kept {
    std::unique_ptr<svort::LivePipeline> pipeline;
    std::unique_ptr<svort::DecisionEngine> decisions;
    svort::RunInfo run;
    std::filesystem::path folder;
  };
  /// Fills `folder` if it is empty, and writes.
  void write(const svort::LivePipeline& pipeline, const svort::RunInfo& run, const svort::DecisionEngine* decisions,
             std::filesystem::path* folder) const;

  std::filesystem::path root_;
  std::filesystem::path folder_;  ///< of the scan in hand; empty until it was saved
  std::vector<Kept> kept_;
};

}  // namespace svort_ros
