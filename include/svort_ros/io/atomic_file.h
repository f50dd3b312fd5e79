#pragma once

#include <filesystem>
#include <string>

namespace svort {

/// A file that appears under its name only when it is complete.
///
/// Write to temporary(), close it, then commit(). Without commit() the temporary file is removed again.
class AtomicFile {
 public:
  /// Removes a temporary file that an interrupted run left behind.
  /// @throws std::runtime_error naming the file if its folder does not exist
  explicit AtomicFile(std::filesystem::path path);
  ~AtomicFile();
  AtomicFile(const AtomicFile&) = delete;
  AtomicFile& operator=(const AtomicFile&) = delete;

  /// Beside the file itself, so that the final rename stays within one file system.
  const std::filesystem::path& temporary() const { return temporary_; }

  /// Brings the temporary file to the disk and renames it. @throws std::runtime_error naming the file and the reason
  void commit();

 private:
  std::filesystem::path path_;
  std::filesystem::path temporary_;
};

/// Writes a whole file or none. @throws std::runtime_error naming the file and the reason (no such folder, disk full)
void write_file(const std::filesystem::path& path, const std::string& content);

}  // namespace svort
