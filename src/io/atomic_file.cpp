#include "svort_ros/io/atomic_file.h"

#include <fcntl.h>
#include <unistd.h>

#include <cerrno>
#include <cstring>
#include <stdexcept>
#include <utility>

namespace svort {
namespace {

[[noreturn]] void fail(const std::filesystem::path& path, const char* what, int error) {
  throw std::runtime_error(path.string() + ": cannot " + what + ": " + std::strerror(error));
}

}  // namespace

AtomicFile::AtomicFile(std::filesystem::path path) : path_(std::move(path)), temporary_(path_.string() + ".partial") {
  const std::filesystem::path folder = path_.has_parent_path() ? path_.parent_path() : std::filesystem::path(".");
  if (!std::filesystem::is_directory(folder))
    throw std::runtime_error(path_.string() + ": cannot be written, there is no folder " + folder.string());
  std::error_code ignored;  // nothing there is the usual case; anything worse shows when the file is opened
  std::filesystem::remove(temporary_, ignored);
}

AtomicFile::~AtomicFile() {
  std::error_code ignored;
  std::filesystem::remove(temporary_, ignored);
}

void AtomicFile::commit() {
  const int file = ::open(temporary_.c_str(), O_RDONLY | O_CLOEXEC);
  if (file < 0) fail(path_, "reopen its temporary file", errno);
  const int error = ::fsync(file) == 0 ? 0 : errno;
  ::close(file);
  if (error != 0) fail(path_, "bring it to the disk", error);
  if (::rename(temporary_.c_str(), path_.c_str()) != 0) fail(path_, "rename the temporary file", errno);
}

void write_file(const std::filesystem::path& path, const std::string& content) {
  AtomicFile target(path);
  const int file = ::open(target.temporary().c_str(), O_WRONLY | O_CREAT | O_EXCL | O_CLOEXEC, 0666);
  if (file < 0) fail(path, "create its temporary file", errno);
  std::size_t written = 0;
  while (written < content.size()) {
    const ssize_t count = ::write(file, content.data() + written, content.size() - written);
    if (count < 0 && errno == EINTR) continue;
    if (count < 0) {
      const int error = errno;
      ::close(file);
      fail(path, "write it", error);
    }
    written += static_cast<std::size_t>(count);
  }
  if (::close(file) != 0) fail(path, "write it", errno);
  target.commit();
}

}  // namespace svort
