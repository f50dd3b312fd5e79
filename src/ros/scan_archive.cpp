#include "svort_ros/ros/scan_archive.h"

#include <cctype>
#include <stdexcept>
#include <system_error>
#include <utility>

namespace svort_ros {
namespace {

/// Makes root/name, or root/name_2, ... if that is there already; making it is what reserves the name.
std::filesystem::path make_new_folder(const std::filesystem::path& root, const std::string& name) {
  std::error_code error;
  std::filesystem::create_directories(root, error);
  if (error) throw std::runtime_error(root.string() + ": cannot make this folder: " + error.message());
  for (int number = 1; number < 10000; ++number) {
    const std::filesystem::path folder = root / (number == 1 ? name : name + "_" + std::to_string(number));
    if (std::filesystem::create_directory(folder, error)) return folder;
    if (error && error != std::errc::file_exists)
      throw std::runtime_error(folder.string() + ": cannot make this folder: " + error.message());
  }
  throw std::runtime_error((root / name).string() + ": 9999 folders of this name are there already");
}

}  // namespace

std::string folder_name(const std::string& scan_id) {
  constexpr std::size_t kLongest = 100;
  std::string name = scan_id.substr(0, kLongest);
  for (char& c : name) {
    const auto byte = static_cast<unsigned char>(c);
    if (byte >= 128 || (!std::isalnum(byte) && c != '.' && c != '_' && c != '-')) c = '_';
  }
  if (name.empty()) return "scan";
  if (name.front() == '.') name.front() = '_';
  return name;
}

std::filesystem::path ScanArchive::save(const svort::LivePipeline& pipeline, const svort::RunInfo& run,
                                        const svort::DecisionEngine* decisions) {
  write(pipeline, run, decisions, &folder_);
  return folder_;
}

ScanArchive::Retry ScanArchive::retry() {
  Retry result;
  std::vector<ArchivedScan> left;
  for (ArchivedScan& scan : kept_) {
    try {
      write(&scan);
      result.written.push_back(scan.folder);
    } catch (const std::exception& error) {
      result.failures.emplace_back(error.what());
      left.push_back(std::move(scan));
    }
  }
  kept_ = std::move(left);
  return result;
}

void ScanArchive::write(const svort::LivePipeline& pipeline, const svort::RunInfo& run,
                        const svort::DecisionEngine* decisions, std::filesystem::path* folder) const {
  if (!enabled())
    throw std::runtime_error("parameter ~node/output_directory is not set, so there is no place to write");
  if (folder->empty()) *folder = make_new_folder(root_, folder_name(pipeline.sequence().scan_id()));
  svort::write_results(*folder, pipeline, run, decisions);
}

}  // namespace svort_ros
