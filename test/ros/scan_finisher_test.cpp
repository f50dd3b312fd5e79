#include "svort_ros/ros/scan_finisher.h"

#include <gtest/gtest.h>

#include <fstream>
#include <mutex>
#include <stdexcept>
#include <vector>

#include "ros/small_pipeline.h"
#include "svort_ros/io/tables.h"
#include "svort_ros/live/threads.h"

namespace svort_ros {
namespace {

namespace fs = std::filesystem;
using svort_test::pipeline_with;

ArchivedScan ended(const std::string& scan_id, const svort::PipelineOptions& options = svort_test::small_pipeline()) {
  ArchivedScan scan;
  scan.pipeline = pipeline_with(scan_id, 3, options);
  return scan;
}

/// What was done, in order; look after stop().
class Results {
 public:
  ScanFinisher::Done done() {
    return [this](FinishedScan scan) {
      const std::lock_guard<std::mutex> lock(mutex_);
      scans_.push_back(std::move(scan));
    };
  }
  std::vector<FinishedScan>& all() { return scans_; }

 private:
  std::mutex mutex_;
  std::vector<FinishedScan> scans_;
};

/// stop() alone would give up what is waiting.
void stop_when_done(ScanFinisher& finisher) {
  while (finisher.count() > 0) std::this_thread::sleep_for(std::chrono::milliseconds(1));
  finisher.stop();
}

FinishedScan finish_one(const ScanArchive& archive) {
  Results results;
  ScanFinisher finisher(archive, results.done());
  finisher.take(ended("a"));
  stop_when_done(finisher);
  EXPECT_EQ(results.all().size(), 1U);
  return results.all().empty() ? FinishedScan() : std::move(results.all().front());
}

TEST(ScanFinisher, FinalisesAndWritesInOrder) {
  const svort_test::TemporaryFolder folder;
  const ScanArchive archive(folder.path());
  Results results;
  ScanFinisher finisher(archive, results.done());
  const int threads = svort::thread_count();
  for (const char* name : {"a", "b", "c"}) finisher.take(ended(name));
  stop_when_done(finisher);
  ASSERT_EQ(results.all().size(), 3U);
  for (std::size_t i = 0; i < 3; ++i) {
    const FinishedScan& scan = results.all()[i];
    const fs::path place = folder.path() / std::string(1, static_cast<char>('a' + i));
    EXPECT_EQ(scan.scan.folder, place);
    EXPECT_TRUE(scan.final);
    EXPECT_TRUE(scan.written);
    EXPECT_EQ(scan.failure + scan.not_written, "");
    EXPECT_EQ(svort::read_pose_table(place / "poses.csv").size(), 3U);
    EXPECT_TRUE(fs::exists(place / "volume.nii.gz"));
  }
  EXPECT_EQ(svort::thread_count(), threads) << "of this thread";
  EXPECT_THROW(finisher.take(ended("d")), std::logic_error);
}

TEST(ScanFinisher, StoppedItWritesWhatThereIs) {
  svort::PipelineOptions slow = svort_test::small_pipeline();
  slow.estimator.method = "registration";
  slow.estimator.registration.finest_mm = 3.;
  const svort_test::TemporaryFolder folder;
  const ScanArchive archive(folder.path());
  Results results;
  std::vector<ArchivedScan> scans;
  for (const char* name : {"a", "b", "c", "d"}) {
    ArchivedScan scan;
    scan.pipeline = pipeline_with(name, 100, slow);
    scans.push_back(std::move(scan));
  }
  {
    ScanFinisher finisher(archive, results.done());
    for (ArchivedScan& scan : scans) finisher.take(std::move(scan));
  }
  ASSERT_EQ(results.all().size(), 4U);
  EXPECT_FALSE(results.all().back().final) << "it was stopped long before";
  for (const FinishedScan& scan : results.all()) {
    EXPECT_TRUE(scan.written) << scan.not_written;
    EXPECT_EQ(svort::read_pose_table(scan.scan.folder / "poses.csv").size(), 24U);
  }
}

TEST(ScanFinisher, WhatCannotBeWrittenComesBackWithTheReason) {
  const svort_test::TemporaryFolder folder;
  const fs::path root = folder.path() / "results";
  std::ofstream(root) << "a file where the folder should be";
  const ScanArchive archive(root);
  FinishedScan scan = finish_one(archive);
  EXPECT_TRUE(scan.final);
  EXPECT_FALSE(scan.written);
  EXPECT_NE(scan.not_written.find(root.string()), std::string::npos) << scan.not_written;
  fs::remove(root);
  ASSERT_NE(scan.scan.pipeline, nullptr);
  archive.write(&scan.scan);
  EXPECT_TRUE(fs::exists(root / "a" / "run.json"));
}

TEST(ScanFinisher, WithoutAFolderItFinalisesOnly) {
  const FinishedScan scan = finish_one(ScanArchive(""));
  EXPECT_TRUE(scan.final);
  EXPECT_FALSE(scan.written);
  EXPECT_EQ(scan.not_written, "");
}

}  // namespace
}  // namespace svort_ros
