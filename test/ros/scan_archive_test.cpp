#include "svort_ros/ros/scan_archive.h"

#include <gtest/gtest.h>

#include <fstream>

#include "ros/small_pipeline.h"

namespace svort_ros {
namespace {

namespace fs = std::filesystem;
using svort_test::pipeline_with;

TEST(FolderName, IsSafe) {
  EXPECT_EQ(folder_name("sub-01_run.2"), "sub-01_run.2");
  EXPECT_EQ(folder_name("a/b\\c d"), "a_b_c_d");
  EXPECT_EQ(folder_name("../../etc"), "_._.._etc");
  EXPECT_EQ(folder_name(".."), "_.");
  EXPECT_EQ(folder_name(""), "scan");
  EXPECT_EQ(folder_name("M\xC3\xBCller\n"), "M__ller_");
  EXPECT_EQ(folder_name(std::string(500, 'x')).size(), 100U);
}

TEST(ScanArchive, SavingAgainReplacesItsOwnFolderOnly) {
  const svort_test::TemporaryFolder folder;
  fs::create_directory(folder.path() / "head");  // from an earlier run
  std::ofstream(folder.path() / "head" / "poses.csv") << "old";
  ScanArchive archive(folder.path());
  const auto pipeline = pipeline_with("head");
  EXPECT_EQ(archive.save(*pipeline, {}), folder.path() / "head_2");
  EXPECT_EQ(archive.save(*pipeline, {}), folder.path() / "head_2");
  EXPECT_TRUE(fs::exists(folder.path() / "head_2" / "run.json"));
  EXPECT_EQ(svort_test::read_bytes(folder.path() / "head" / "poses.csv"), "old");
  EXPECT_EQ(archive.begin_scan(), folder.path() / "head_2");
  EXPECT_EQ(archive.save(*pipeline, {}), folder.path() / "head_3");
}

TEST(ScanArchive, WithoutFolderSaysSo) {
  ScanArchive archive("");
  EXPECT_FALSE(archive.enabled());
  try {
    archive.save(*pipeline_with("x"), {});
    ADD_FAILURE() << "saved into nowhere";
  } catch (const std::runtime_error& error) {
    EXPECT_NE(std::string(error.what()).find("output_directory"), std::string::npos) << error.what();
  }
}

TEST(ScanArchive, KeepsWhatCouldNotBeWrittenAndWritesItLater) {
  const svort_test::TemporaryFolder folder;
  const fs::path root = folder.path() / "results";
  std::ofstream(root) << "a file where the folder should be";
  ScanArchive archive(root);
  auto first = pipeline_with("first");
  EXPECT_THROW(archive.save(*first, {}), std::runtime_error);
  archive.keep({std::move(first), nullptr, {}, archive.begin_scan()});
  archive.keep({pipeline_with("second"), nullptr, {}, {}});
  EXPECT_EQ(archive.kept(), 2U);

  ScanArchive::Retry retry = archive.retry();
  EXPECT_EQ(retry.failures.size(), 2U);
  EXPECT_TRUE(retry.written.empty());
  EXPECT_EQ(archive.kept(), 2U);

  fs::remove(root);
  retry = archive.retry();
  EXPECT_TRUE(retry.failures.empty());
  EXPECT_EQ(retry.written, (std::vector<fs::path>{root / "first", root / "second"}));
  EXPECT_EQ(archive.kept(), 0U);
  EXPECT_TRUE(fs::exists(root / "first" / "poses.csv"));
  EXPECT_TRUE(fs::exists(root / "second" / "run.json"));
}

}  // namespace
}  // namespace svort_ros
