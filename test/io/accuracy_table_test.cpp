#include "svort_ros/io/accuracy_table.h"

#include <gtest/gtest.h>

#include <cmath>
#include <filesystem>
#include <fstream>
#include <stdexcept>

namespace svort {
namespace {

class AccuracyTable : public testing::Test {
 protected:
  void SetUp() override {
    folder_ = std::filesystem::path(testing::TempDir()) / "svort_accuracy_table";
    std::filesystem::remove_all(folder_);
    std::filesystem::create_directories(folder_);
  }
  void TearDown() override { std::filesystem::remove_all(folder_); }
  std::filesystem::path folder_;
};

AccuracyRow row(const std::string& method, std::uint64_t number, double relative) {
  AccuracyRow result;
  result.brain = "A";
  result.motion = "mild";
  result.masks = "usual";
  result.number = number;
  result.stacks = 3;
  result.method = method;
  result.slices = 63;
  result.relative_ed_mm = relative;
  result.atlas.ed_mm = 2. * relative;
  result.atlas.frame_rad = relative > 5. ? 3. : 0.1;
  result.atlas.sure = true;
  if (method == "guided") result.guide = result.atlas;
  result.seconds = 1.25;
  result.converged = false;
  return result;
}

TEST_F(AccuracyTable, ReadsBackWhatItWrote) {
  const auto path = folder_ / "accuracy.csv";
  EXPECT_TRUE(read_accuracy_rows(path).empty()) << "no file, no rows";
  write_accuracy_rows(path, {row("nominal", 1, 4.5), row("registration", 2, 0.125)});
  const std::vector<AccuracyRow> rows = read_accuracy_rows(path);
  ASSERT_EQ(rows.size(), 2U);
  EXPECT_EQ(rows[1].method, "registration");
  EXPECT_EQ(rows[1].number, 2U);
  EXPECT_EQ(rows[1].relative_ed_mm, 0.125);
  EXPECT_EQ(rows[1].slices, 63U);
  EXPECT_EQ(rows[1].seconds, 1.25);
  EXPECT_TRUE(rows[1].atlas.sure);
  EXPECT_FALSE(rows[1].shipped.sure);
  EXPECT_FALSE(rows[1].converged);
  EXPECT_TRUE(std::isnan(rows[1].shipped.ed_mm));
}

TEST_F(AccuracyTable, PoolsTheSlicesWithinTheirRadii) {
  AccuracyRow first = row("live", 1, 1.), second = row("live", 2, 1.);
  first.radius = {60, 59, 0.8};
  second.radius = {40, 30, 1.6};
  first.radius_one_stack = {20, 19, 0.9};
  first.agreement = {20, 17, 30, 1};
  second.agreement = {0, 0, 20, 1};
  second.network_starts = 3;
  second.search_starts = 5;
  first.followed_ed_mm = 1.;
  second.followed_ed_mm = 2.5;
  const auto path = folder_ / "accuracy.csv";
  write_accuracy_rows(path, {first, second});
  const std::string table = accuracy_markdown(read_accuracy_rows(path));
  EXPECT_NE(table.find("| mild | live | 89.0 (100; 1.20) | 95.0 (20; 0.90) | 85 (20) | 4 (50) | 3 | 5 | 1.75 / 1.75 |"),
            std::string::npos)
      << table;
  EXPECT_EQ(accuracy_markdown({row("nominal", 1, 1.)}).find("radius"), std::string::npos) << "no radii, no table";
}

TEST_F(AccuracyTable, NamesTheLineThatIsWrong) {
  const auto path = folder_ / "accuracy.csv";
  const auto message = [&]() -> std::string {
    try {
      read_accuracy_rows(path);
    } catch (const std::runtime_error& error) {
      return error.what();
    }
    return "";
  };
  std::ofstream(path) << "brain\nA,B\n";
  EXPECT_NE(message().find("accuracy.csv: line 2"), std::string::npos) << message();
  write_accuracy_rows(path, {row("nominal", 1, 4.5)});
  std::string text;
  {
    std::ifstream file(path);
    text.assign(std::istreambuf_iterator<char>(file), {});
  }
  text.replace(text.find("4.5"), 3, "x.5");
  std::ofstream(path) << text;
  EXPECT_NE(message().find("relative_ed_mm: 'x.5' is not a number"), std::string::npos) << message();
}

TEST_F(AccuracyTable, TablesHoldMeanMedianAndTurnedFrames) {
  const std::string table =
      accuracy_markdown({row("nominal", 1, 1.), row("nominal", 2, 2.), row("nominal", 3, 9.), row("live", 1, 0.5)});
  EXPECT_NE(
      table.find("| mild | nominal | 3 | 4.00 / 2.00 | - | 8.00 / 4.00 | - | 1 (1 sure) | - | - | - | - | - | 1.2"),
      std::string::npos)
      << table;
  EXPECT_NE(
      accuracy_markdown({row("guided", 1, 1.5)}).find("| 3.00 / 3.00 | - | 0 | - | - | 3.00 / 3.00 | - | 0 | 1.2"),
      std::string::npos);
  EXPECT_NE(table.find("| mild | live | 1 | 0.50 / 0.50 |"), std::string::npos) << table;
}

TEST_F(AccuracyTable, DrawsAPicture) {
  plot_accuracy(folder_ / "a.png", {row("nominal", 1, 4.), row("registration", 1, 1.)});
  EXPECT_GT(std::filesystem::file_size(folder_ / "a.png"), 1000U);
}

TEST(AccuracyProgram, SaysWhatIsMissing) {
  const auto run = [](std::vector<std::string> words) {
    words.insert(words.begin(), "svort_accuracy");
    std::vector<char*> argv;
    for (std::string& word : words) argv.push_back(word.data());
    testing::internal::CaptureStderr();
    const int code = run_svort_accuracy(static_cast<int>(argv.size()), argv.data());
    return std::to_string(code) + testing::internal::GetCapturedStderr();
  };
  const std::string output = testing::TempDir() + "/svort_accuracy_program";
  EXPECT_NE(run({"--output", output}).find("give either --brains or --real"), std::string::npos);
  const std::string missing = run({"--output", output, "--brains", "/no/such/folder"});
  EXPECT_EQ(missing[0], '2');
  EXPECT_NE(missing.find("/no/such/folder"), std::string::npos) << missing;
}

}  // namespace
}  // namespace svort
