// Bags, and the offline replay from the command line on.

#include "svort_ros/ros/replay.h"

#include <gtest/gtest.h>
#include <rosbag/bag.h>
#include <std_msgs/String.h>

#include <fstream>
#include <nlohmann/json.hpp>
#include <sstream>

#include "ros/synthetic_scan.h"
#include "svort_ros/io/tables.h"
#include "svort_ros/ros/bag.h"
#include "svort_ros/ros/conversions.h"

namespace svort_ros {
namespace {

namespace fs = std::filesystem;
using svort_test::read_bytes;
using svort_test::TemporaryFolder;

std::vector<Slice> messages(const std::string& scan_id = "phantom") {
  svort_test::SyntheticScanOptions options;
  options.scan_id = scan_id;
  std::vector<Slice> result;
  for (const svort::Slice& slice : svort_test::synthetic_scan(options)) result.push_back(to_msg(slice, "scanner"));
  return result;
}

/// The message of the error.
template <class Action>
std::string error_of(const Action& action) {
  try {
    action();
  } catch (const std::runtime_error& error) {
    return error.what();
  }
  return "no error";
}

TEST(Bag, ComesBackInOrderEvenIfStampsGoBack) {
  const TemporaryFolder folder;
  const fs::path bag = folder.path() / "scan.bag";
  std::vector<Slice> slices = messages();
  std::swap(slices[2], slices[7]);         // acquired later, arrived earlier
  slices[5].header.stamp = ros::Time(0.);  // a sender without a clock
  write_slices(bag, slices, "slices");
  EXPECT_EQ(read_slices(bag, "slices"), slices);
  EXPECT_EQ(read_slices(bag, "/slices"), slices);
  EXPECT_FALSE(fs::exists(bag.string() + ".part"));
}

TEST(Bag, IsTheSameBytesEveryTime) {
  const TemporaryFolder folder;
  write_slices(folder.path() / "a.bag", messages(), "slices");
  write_slices(folder.path() / "b.bag", messages(), "slices");
  EXPECT_EQ(read_bytes(folder.path() / "a.bag"), read_bytes(folder.path() / "b.bag"));
}

TEST(Bag, ErrorsNameTheFileAndTheReason) {
  const TemporaryFolder folder;
  const fs::path bag = folder.path() / "scan.bag";
  EXPECT_EQ(error_of([&] { read_slices(bag, "slices"); }), bag.string() + ": there is no such file");
  write_slices(bag, messages(), "other");
  std::string error = error_of([&] { read_slices(bag, "slices"); });
  EXPECT_NE(error.find(bag.string() + ": no message on topic 'slices'; slices are on other"), std::string::npos)
      << error;
  std::ofstream(folder.path() / "text.bag") << "no bag at all";
  error = error_of([&] { read_slices(folder.path() / "text.bag", "slices"); });
  EXPECT_NE(error.find("text.bag: not a readable bag"), std::string::npos) << error;
  {
    rosbag::Bag strings((folder.path() / "strings.bag").string(), rosbag::bagmode::Write);
    strings.write("slices", ros::Time(1.), std_msgs::String());
  }
  error = error_of([&] { read_slices(folder.path() / "strings.bag", "slices"); });
  EXPECT_NE(error.find("holds std_msgs/String, not slices"), std::string::npos) << error;
  const std::string bytes = read_bytes(bag);
  std::ofstream(bag, std::ios::binary) << bytes.substr(0, bytes.size() / 2);  // a full disk, a copy cut short
  error = error_of([&] { read_slices(bag, "other"); });
  EXPECT_NE(error.find("not a readable bag"), std::string::npos) << error;
  error = error_of([&] { write_slices(folder.path() / "no" / "such.bag", messages(), "slices"); });
  EXPECT_NE(error.find("such.bag: cannot be written"), std::string::npos) << error;
}

struct Outcome {
  int code = 0;
  std::string out;
  std::string err;
};

/// Runs a program's main function as the command line would.
Outcome run(int (*program)(int, char**), std::vector<std::string> arguments) {
  arguments.insert(arguments.begin(), "program");
  std::vector<char*> argv;
  for (std::string& argument : arguments) argv.push_back(argument.data());
  testing::internal::CaptureStdout();
  testing::internal::CaptureStderr();
  Outcome outcome;
  outcome.code = program(static_cast<int>(argv.size()), argv.data());
  outcome.out = testing::internal::GetCapturedStdout();
  outcome.err = testing::internal::GetCapturedStderr();
  return outcome;
}

/// Coarse options, so that a replay takes a second.
std::vector<std::string> coarse(std::vector<std::string> arguments) {
  for (const char* option : {"--estimator.volume_resolution_mm=3", "--estimator.volume_size_mm=96",
                             "--sequence.resolution_mm=2", "--sequence.size_px=64", "--threads=1"})
    arguments.emplace_back(option);
  return arguments;
}

TEST(Replay, GivesTheSameBytesTwice) {
  const TemporaryFolder folder;
  const std::string bag = (folder.path() / "scan.bag").string();
  write_slices(bag, messages(), "slices");
  for (const char* name : {"a", "b"}) {
    const Outcome outcome =
        run(run_svort_replay, coarse({"--bag", bag, "--output", (folder.path() / name).string(), "--seed", "5"}));
    ASSERT_EQ(outcome.code, 0) << outcome.err;
    EXPECT_NE(outcome.out.find("24 slices: 24 kept, 0 rejected"), std::string::npos) << outcome.out;
    EXPECT_NE(outcome.err.find("[ 24/ 24] stack 2 slice  7  accepted"), std::string::npos) << outcome.err;
  }
  for (const char* file : {"poses.csv", "volume.nii.gz", "volume.png", "motion.csv", "quality.csv", "reacquisition.csv",
                           "decisions.jsonl", "coverage.nii.gz", "orientations.nii.gz"})
    EXPECT_EQ(read_bytes(folder.path() / "a" / file), read_bytes(folder.path() / "b" / file)) << file;
  const auto json = nlohmann::json::parse(read_bytes(folder.path() / "a" / "run.json"));
  EXPECT_EQ(json["seed"], 5);
  EXPECT_EQ(json["threads"], 1);
  EXPECT_EQ(json["options"]["estimator"]["volume_resolution_mm"], 3.);
  EXPECT_EQ(json["final"], true);
}

TEST(Replay, SaysWhatOtherThresholdsWouldDecide) {
  const TemporaryFolder folder;
  const std::string bag = (folder.path() / "scan.bag").string();
  const std::string thresholds = (folder.path() / "strict.yaml").string();
  const fs::path output = folder.path() / "out";
  write_slices(bag, messages(), "slices");
  std::ofstream(thresholds) << "decision: {quality: {accept: 0.9999}}\n";
  const auto arguments = coarse(
      {"--bag", bag, "--output", output.string(), "--what-if", thresholds, "--decision.reacquisition.budget_s", "11"});
  const Outcome outcome = run(run_svort_replay, arguments);
  ASSERT_EQ(outcome.code, 0) << outcome.err;
  const auto json = nlohmann::json::parse(read_bytes(output / "what_if" / "what_if.json"));
  EXPECT_EQ(json["decided"]["options"]["quality"]["accept"], svort::SliceQualityOptions().accept);
  EXPECT_EQ(json["what_if"]["options"]["quality"]["accept"], 0.9999);
  EXPECT_EQ(json["what_if"]["options"]["reacquisition"]["budget_s"], 11.);  // what the file does not name is as it is
  EXPECT_GT(json["decided"]["quality"]["accepted"].get<int>(), json["what_if"]["quality"]["accepted"].get<int>());
  const auto run_json = nlohmann::json::parse(read_bytes(output / "run.json"));
  EXPECT_EQ(run_json["options"]["decision"]["reacquisition"]["budget_s"], 11.);
  EXPECT_GT(run_json["latency"]["decision_ms"]["max"].get<double>(), 0.);
  EXPECT_TRUE(fs::exists(output / "report.html"));

  std::ofstream(thresholds) << "decision: {quality: {acept: 0.9}}\n";
  const Outcome wrong = run(run_svort_replay, arguments);
  EXPECT_EQ(wrong.code, 2);
  EXPECT_NE(wrong.err.find("unknown key 'decision.quality.acept'"), std::string::npos) << wrong.err;
}

TEST(Replay, PosesAreTheOnesOfTheMessages) {
  const TemporaryFolder folder;
  const std::string bag = (folder.path() / "scan.bag").string();
  const std::vector<Slice> slices = messages();
  write_slices(bag, slices, "slices");
  ASSERT_EQ(run(run_svort_replay, coarse({"--bag", bag, "--output", folder.path().string()})).code, 0);
  const auto rows = svort::read_pose_table(folder.path() / "poses.csv");
  ASSERT_EQ(rows.size(), slices.size());
  double ncc_sum = 0.;
  for (std::size_t i = 0; i < rows.size(); ++i) {
    // Nominal: what the scanner said is head pose times slice pose.
    const svort::Pose T_scanner_slice = rows[i].T_scanner_brain * rows[i].T_brain_slice;
    EXPECT_TRUE(T_scanner_slice.isApprox(from_msg(slices[i].nominal_pose), 1e-6)) << "row " << i;
    ncc_sum += rows[i].ncc;
  }
  // The phantom's outermost slices are nearly uniform and correlate less; misplaced slices come out near 0.
  EXPECT_GT(ncc_sum / static_cast<double>(rows.size()), 0.8);
}

TEST(Replay, WritesEachScanOfABagIntoItsOwnFolder) {
  const TemporaryFolder folder;
  const std::string bag = (folder.path() / "scan.bag").string();
  std::vector<Slice> slices = messages("first/scan");
  slices.resize(5);
  std::vector<Slice> second = messages("second");
  second.resize(4);
  slices.insert(slices.end(), second.begin(), second.end());
  write_slices(bag, slices, "slices");
  const fs::path output = folder.path() / "out";
  const Outcome outcome = run(run_svort_replay, coarse({"--bag", bag, "--output", output.string()}));
  ASSERT_EQ(outcome.code, 0) << outcome.err;
  EXPECT_EQ(svort::read_pose_table(output / "first_scan" / "poses.csv").size(), 5U);
  EXPECT_EQ(svort::read_pose_table(output / "second" / "poses.csv").size(), 4U);
  EXPECT_FALSE(fs::exists(output / "poses.csv"));
}

TEST(Replay, ReportsBrokenSlicesAndGoesOn) {
  const TemporaryFolder folder;
  const std::string bag = (folder.path() / "scan.bag").string();
  std::vector<Slice> slices = messages();
  slices.resize(4);
  slices[1].image.data.resize(10);
  slices[2].nominal_pose.orientation.w = 9.;
  write_slices(bag, slices, "slices");
  const Outcome outcome = run(run_svort_replay, coarse({"--bag", bag, "--output", folder.path().string()}));
  EXPECT_EQ(outcome.code, 0);
  EXPECT_NE(outcome.out.find("4 slices: 2 kept, 2 rejected"), std::string::npos) << outcome.out;
  const std::string updates = read_bytes(folder.path() / "updates.csv");
  EXPECT_NE(updates.find("bad_image"), std::string::npos);
  EXPECT_NE(updates.find("bad_geometry"), std::string::npos);
}

TEST(Replay, CommandLineOverridesTheConfigFile) {
  const TemporaryFolder folder;
  const std::string bag = (folder.path() / "scan.bag").string();
  std::vector<Slice> slices = messages();
  slices.resize(2);
  write_slices(bag, slices, "slices");
  const std::string config = (folder.path() / "c.yaml").string();
  std::ofstream(config) << "node: {threads: 1}\nestimator: {volume_resolution_mm: 6, volume_size_mm: 90}\n";
  const Outcome outcome = run(run_svort_replay, {"--bag", bag, "--output", folder.path().string(), "--config", config,
                                                 "--estimator.volume_size_mm", "60"});
  ASSERT_EQ(outcome.code, 0) << outcome.err;
  const auto json = nlohmann::json::parse(read_bytes(folder.path() / "run.json"));
  EXPECT_EQ(json["options"]["estimator"]["volume_resolution_mm"], 6.);
  EXPECT_EQ(json["options"]["estimator"]["volume_size_mm"], 60.);
  EXPECT_EQ(json["threads"], 1);
}

TEST(Replay, BadInputEndsWithCodeTwoAndAMessage) {
  const TemporaryFolder folder;
  const std::string out = folder.path().string();
  const std::string bag = (folder.path() / "scan.bag").string();
  std::vector<Slice> slices = messages();
  slices.resize(1);
  write_slices(bag, slices, "slices");
  const auto expect_error = [&](const std::vector<std::string>& arguments, const std::string& text) {
    const Outcome outcome = run(run_svort_replay, arguments);
    EXPECT_EQ(outcome.code, 2) << text;
    EXPECT_NE(outcome.err.find(text), std::string::npos) << outcome.err;
  };
  expect_error({"--output", out}, "either --bag or --stacks");
  expect_error({"--bag", bag, "--stacks", "a.nii", "--output", out}, "either --bag or --stacks");
  expect_error({"--bag", bag}, "--output is required");
  expect_error({"--bag", bag + "x", "--output", out}, "scan.bagx: there is no such file");
  expect_error({"--bag", bag, "--topic", "images", "--output", out}, "no message on topic 'images'");
  expect_error({"--stacks", out + "/no.nii.gz", "--output", out}, "no.nii.gz");
  expect_error({"--bag", bag, "--output", out, "--config", out + "/no.yaml"}, "no.yaml: cannot be read");
  expect_error({"--bag", bag, "--output", out, "--device", "cuda"}, "runs on the CPU only");
  expect_error({"--bag", bag, "--output", out, "--device", "tpu"}, "--device");
  expect_error({"--bag", bag, "--output", out, "--weights", "w.pt"}, "w.pt: cannot be read");
  expect_error({"--bag", bag, "--output", out, "--threads", "-2"}, "threads");
  expect_error({"--bag", bag, "--output", out, "--realtime", "-1"}, "realtime");
  expect_error({"--bag", bag, "--output", out, "--estimator.method", "magic"}, "estimator.method is 'magic'");
  expect_error({"--bag", bag, "--output", out, "--estimator.volume_resolution_mm", "0"}, "volume_resolution_mm");
  expect_error({"--bag", bag, "--output", bag}, "scan.bag");  // a file is no folder
  slices[0].image.data.clear();
  write_slices(bag, slices, "slices");
  expect_error({"--bag", bag, "--output", out}, "no slice was kept");
  EXPECT_EQ(run(run_svort_replay, {"--help"}).code, 0);
}

TEST(NiftiToBag, StacksAndTheirBagGiveTheSameResults) {
  const TemporaryFolder folder;
  svort_test::SyntheticScanOptions options;
  options.stacks = 2;
  const auto scan = svort_test::synthetic_scan(options);
  std::vector<std::string> input{"--stacks"};
  for (int stack = 0; stack < 2; ++stack) {
    svort_test::write_stack(folder.path() / ("s" + std::to_string(stack) + ".nii.gz"), scan, stack, false);
    svort_test::write_stack(folder.path() / ("m" + std::to_string(stack) + ".nii.gz"), scan, stack, true);
  }
  for (const char* name : {"s0", "s1"}) input.push_back((folder.path() / name).string() + ".nii.gz");
  input.emplace_back("--masks");
  for (const char* name : {"m0", "m1"}) input.push_back((folder.path() / name).string() + ".nii.gz");
  for (const char* word : {"--scan-id", "phantom", "--start", "1000", "--tr", "1.2"}) input.emplace_back(word);

  const std::string bag = (folder.path() / "scan.bag").string();
  std::vector<std::string> to_bag = input;
  for (const std::string& word : {std::string("--output"), bag, std::string("--scanner-frame"), std::string("lps")})
    to_bag.push_back(word);
  const Outcome made = run(run_nifti_to_bag, to_bag);
  ASSERT_EQ(made.code, 0) << made.err;
  EXPECT_NE(made.out.find("16 slices on topic slices"), std::string::npos) << made.out;

  const std::vector<Slice> slices = read_slices(bag, "slices");
  ASSERT_EQ(slices.size(), scan.size());
  for (std::size_t i = 0; i < slices.size(); ++i) {
    EXPECT_EQ(slices[i].header.frame_id, "lps");
    const SliceFromMessage slice = from_msg(slices[i]);
    ASSERT_TRUE(slice.ok) << slice.reason;
    EXPECT_EQ(slice.slice.info.stack, scan[i].info.stack);
    EXPECT_EQ(slice.slice.info.index, scan[i].info.index);
    EXPECT_NEAR(double(slice.slice.info.stamp_ns), double(scan[i].info.stamp_ns), 1000.);  // 1 us
    EXPECT_EQ(slice.slice.pixels, scan[i].pixels);
    EXPECT_EQ(slice.slice.mask, scan[i].mask);
    EXPECT_NEAR(slice.slice.info.thickness, 6., 1e-4);  // NIfTI holds float32
    // 1e-4 mm for float32 affines of some 100 mm
    EXPECT_LT((slice.slice.info.T_scanner_slice.matrix() - scan[i].info.T_scanner_slice.matrix()).norm(), 1e-4);
  }

  const fs::path from_bag = folder.path() / "from_bag";
  const fs::path from_stacks = folder.path() / "from_stacks";
  ASSERT_EQ(run(run_svort_replay, coarse({"--bag", bag, "--output", from_bag.string()})).code, 0);
  std::vector<std::string> arguments = coarse(input);
  arguments.insert(arguments.end(), {"--output", from_stacks.string()});
  ASSERT_EQ(run(run_svort_replay, arguments).code, 0);
  EXPECT_EQ(read_bytes(from_bag / "poses.csv"), read_bytes(from_stacks / "poses.csv"));
  EXPECT_EQ(read_bytes(from_bag / "volume.nii.gz"), read_bytes(from_stacks / "volume.nii.gz"));

  const Outcome bad = run(run_nifti_to_bag, {"--stacks", bag, "--output", bag + "2"});
  EXPECT_EQ(bad.code, 2);
  EXPECT_NE(bad.err.find("scan.bag"), std::string::npos) << bad.err;
}

}  // namespace
}  // namespace svort_ros
