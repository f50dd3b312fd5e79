#include "svort_ros/io/atomic_file.h"

#include <sys/resource.h>

#include <csignal>
#include <stdexcept>

#include "io/scratch.h"

namespace svort {
namespace {

using AtomicFileTest = Scratch;

TEST_F(AtomicFileTest, WritesTheContentAndNothingElse) {
  std::string content = "line\n";
  content.push_back('\0');
  content += "after a zero";
  write_file(path("a.txt"), content);
  EXPECT_EQ(read(path("a.txt")), content);
  EXPECT_EQ(file_count(), 1U);
  write_file(path("a.txt"), "shorter");
  EXPECT_EQ(read(path("a.txt")), "shorter");
}

TEST_F(AtomicFileTest, WithoutCommitNothingStays) {
  write_file(path("a.txt"), "old");
  {
    AtomicFile file(path("a.txt"));
    std::ofstream(file.temporary()) << "half";
    EXPECT_EQ(file_count(), 2U);
  }
  EXPECT_EQ(read(path("a.txt")), "old");
  EXPECT_EQ(file_count(), 1U);
}

TEST_F(AtomicFileTest, RemovesWhatAnInterruptedRunLeft) {
  write("a.txt.partial", "half a file of an earlier run, much longer than the new one");
  write_file(path("a.txt"), "new");
  EXPECT_EQ(read(path("a.txt")), "new");
  EXPECT_EQ(file_count(), 1U);
}

TEST_F(AtomicFileTest, NamesTheMissingFolder) {
  EXPECT_MESSAGE(write_file(path("none/a.txt"), "x"), path("none/a.txt").string() + ": cannot be written");
  EXPECT_MESSAGE(write_file(path("none/a.txt"), "x"), "there is no folder");
}

TEST_F(AtomicFileTest, NamesAFolderInItsPlace) {
  std::filesystem::create_directories(path("a.txt"));
  EXPECT_MESSAGE(write_file(path("a.txt"), "x"), path("a.txt").string() + ": cannot rename");
  EXPECT_EQ(file_count(), 1U);
}

/// A full disk, played by a limit on the size of files.
TEST_F(AtomicFileTest, FullDiskLeavesTheOldFile) {
  write_file(path("a.txt"), "old");
  rlimit before{};
  ASSERT_EQ(getrlimit(RLIMIT_FSIZE, &before), 0);
  const auto handler = std::signal(SIGXFSZ, SIG_IGN);
  rlimit small = before;
  small.rlim_cur = 1000;
  ASSERT_EQ(setrlimit(RLIMIT_FSIZE, &small), 0);
  const std::string message = message_of([&] { write_file(path("a.txt"), std::string(5000, 'x')); });
  ASSERT_EQ(setrlimit(RLIMIT_FSIZE, &before), 0);
  std::signal(SIGXFSZ, handler);
  EXPECT_TRUE(contains(message, path("a.txt").string() + ": cannot write it")) << message;
  EXPECT_EQ(read(path("a.txt")), "old");
  EXPECT_EQ(file_count(), 1U);
}

}  // namespace
}  // namespace svort
