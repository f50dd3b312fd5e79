#include "svort_ros/io/decision_files.h"

#include <gtest/gtest.h>

#include <cmath>
#include <fstream>
#include <map>
#include <nlohmann/json.hpp>
#include <sstream>
#include <string>
#include <vector>

#include "decision/decision_fixture.h"
#include "io/scratch.h"
#include "svort_ros/io/closed_loop.h"
#include "svort_ros/io/nifti.h"
#include "svort_ros/io/report.h"
#include "svort_ros/io/results.h"

namespace svort {
namespace {

namespace fs = std::filesystem;

std::string read_text(const fs::path& path) {
  std::ifstream file(path, std::ios::binary);
  EXPECT_TRUE(file) << path;
  std::ostringstream text;
  text << file.rdbuf();
  return text.str();
}

/// Rows of a CSV file without quotes, by the name of the column.
std::vector<std::map<std::string, std::string>> read_rows(const fs::path& path) {
  std::istringstream text(read_text(path));
  const auto split = [](const std::string& line) {
    std::vector<std::string> fields;
    std::istringstream stream(line + ",");
    for (std::string field; std::getline(stream, field, ',');) fields.push_back(field);
    return fields;
  };
  std::string line;
  std::getline(text, line);
  const std::vector<std::string> header = split(line);
  std::vector<std::map<std::string, std::string>> rows;
  while (std::getline(text, line)) {
    const std::vector<std::string> fields = split(line);
    EXPECT_EQ(fields.size(), header.size()) << line;
    std::map<std::string, std::string> row;
    for (std::size_t i = 0; i < std::min(fields.size(), header.size()); ++i) row[header[i]] = fields[i];
    rows.push_back(row);
  }
  return rows;
}

DecisionOptions demanding() {
  DecisionOptions options;
  options.quality = svort_test::plain_quality();
  options.reacquisition.confirm_updates = 1;
  options.coverage.views = 2.6;
  options.coverage.sharp_views = 1.6;
  return options;
}

class DecisionFiles : public Scratch {};

struct Scan {
  explicit Scan(const DecisionOptions& options = demanding())
      : pipeline(svort_test::quick_pipeline()), engine(options) {
    for (int stack = 0; stack < 3; ++stack)
      for (svort_test::ScanSlice slice : svort_test::whole_stack(stack, stack, 30. * stack)) {
        if (stack == 1 && slice.index == 8) slice.gain = 0.15;
        if (stack == 2 && slice.index == 7) continue;
        svort_test::feed(svort_test::make_slice(slice), &pipeline, &engine);
      }
  }
  LivePipeline pipeline;
  DecisionEngine engine;
};

TEST_F(DecisionFiles, SayWhatWasDecidedAndWhy) {
  const Scan scan(demanding());
  RunInfo run;
  run.program = "test";
  write_results(path(""), scan.pipeline, run, &scan.engine);

  const auto motion = read_rows(path("motion.csv"));
  const auto quality = read_rows(path("quality.csv"));
  ASSERT_EQ(motion.size(), scan.pipeline.estimate().slices.size());
  ASSERT_EQ(quality.size(), motion.size());
  EXPECT_EQ(motion[0].at("reference"), "1");
  EXPECT_EQ(motion[5].at("moved"), "0");  // nominal poses: the head rests
  EXPECT_EQ(motion[5].at("displacement_mm"), "0");
  for (std::size_t i = 0; i < quality.size(); ++i) {
    EXPECT_EQ(std::stod(quality[i].at("score")), scan.engine.quality()[i].score);  // reads back as the same number
    EXPECT_EQ(quality[i].at("accepted"), scan.engine.quality()[i].score >= 0.5 ? "1" : "0");
    if (quality[i].at("stack") == "1" && quality[i].at("slice") == "8") {
      EXPECT_NE(quality[i].at("reasons").find("dark"), std::string::npos);
    }
  }
  const auto events = read_rows(path("reacquisition.csv"));
  ASSERT_EQ(events.size(), scan.engine.planner().events().size());
  ASSERT_FALSE(events.empty());
  EXPECT_EQ(events[0].at("event"), "proposed");
  EXPECT_EQ(events[0].at("id"), "1");
  EXPECT_FALSE(events[0].at("reasons").empty());

  std::istringstream log(read_text(path("decisions.jsonl")));
  std::size_t lines = 0;
  for (std::string line; std::getline(log, line); ++lines) {
    const auto json = nlohmann::json::parse(line);
    EXPECT_EQ(json.at("revision").get<std::uint64_t>(), scan.engine.records()[lines].revision);
    EXPECT_TRUE(json.at("newest").at("features").contains("similarity"));
    EXPECT_TRUE(json.at("requests").is_array());
  }
  EXPECT_EQ(lines, scan.engine.records().size());

  const auto run_json = nlohmann::json::parse(read_text(path("run.json")));
  EXPECT_EQ(run_json.at("options").at("decision").at("coverage").at("views"), 2.6);
  EXPECT_EQ(run_json.at("decisions").at("motion").at("class"), "none");
  EXPECT_TRUE(run_json.at("latency").contains("decision_ms"));

  const NiftiImage coverage = read_nifti(path("coverage.nii.gz"));
  EXPECT_EQ(coverage.values.size(), scan.engine.coverage().grid.voxel_count());
  EXPECT_TRUE(fs::exists(path("orientations.nii.gz")));
  for (const char* name : {"motion.png", "coverage.png"}) EXPECT_EQ(read_text(path(name)).substr(1, 3), "PNG") << name;
}

TEST_F(DecisionFiles, WithoutDecisionsTheFilesOfAnEarlierRunGo) {
  const Scan scan;
  write_results(path(""), scan.pipeline, RunInfo(), &scan.engine);
  ASSERT_TRUE(fs::exists(path("report.html")));
  LivePipeline empty(svort_test::quick_pipeline());
  const DecisionEngine nothing{DecisionOptions()};
  write_results(path(""), empty, RunInfo(), &nothing);
  for (const char* name : {"motion.csv", "quality.csv", "reacquisition.csv", "decisions.jsonl", "coverage.nii.gz",
                           "orientations.nii.gz", "motion.png", "coverage.png", "report.html"})
    EXPECT_FALSE(fs::exists(path(name))) << name;
}

TEST_F(DecisionFiles, WhatIfComparesThresholds) {
  const Scan scan(demanding());
  DecisionOptions strict = demanding();
  strict.quality.accept = 0.999;
  const Scan other(strict);
  write_what_if(path(""), "ellipsoid", scan.engine, other.engine);
  const auto json = nlohmann::json::parse(read_text(path("what_if/what_if.json")));
  EXPECT_LT(json.at("what_if").at("quality").at("accepted").get<int>(),
            json.at("decided").at("quality").at("accepted").get<int>());
  EXPECT_EQ(json.at("what_if").at("options").at("quality").at("accept"), 0.999);
  EXPECT_FALSE(json.at("slices_judged_otherwise").empty());
  EXPECT_TRUE(fs::exists(path("what_if/reacquisition.csv")));
}

TEST_F(DecisionFiles, ReportIsOneSelfContainedPage) {
  const Scan scan(demanding());
  write_results(path(""), scan.pipeline, RunInfo(), &scan.engine);
  const std::string page = read_text(path("report.html"));
  for (const char* heading : {"Head motion", "Slice quality", "Coverage", "Volume", "Requests", "Timings", "Versions"})
    EXPECT_NE(page.find("<h2>" + std::string(heading) + "</h2>"), std::string::npos) << heading;
  std::size_t pictures = 0;
  for (std::size_t at = page.find("<img"); at != std::string::npos; at = page.find("<img", at + 1)) {
    ++pictures;
    EXPECT_EQ(page.compare(page.find("src='", at) + 5, 22, "data:image/png;base64,"), 0);
  }
  EXPECT_EQ(pictures, 2U);
  for (const char* forbidden : {"http:", "https:", "<script", "<link", "url("})
    EXPECT_EQ(page.find(forbidden), std::string::npos) << forbidden;
  EXPECT_EQ(page.substr(page.size() - 15), "</body></html>\n");
}

TEST(Report, TextIsEscaped) {
  EXPECT_EQ(escape_html("<a href=\"x\">&'"), "&lt;a href=&quot;x&quot;&gt;&amp;&#39;");
  EXPECT_EQ(escape_html("\xC3\xBC \xFF\x01"), "\xC3\xBC ??");  // a whole letter stays, broken bytes do not
  EXPECT_EQ(base64(""), "");
  EXPECT_EQ(base64("f"), "Zg==");
  EXPECT_EQ(base64("fo"), "Zm8=");
  EXPECT_EQ(base64("foobar"), "Zm9vYmFy");
}

TEST(ClosedLoop, RequestsRepeatSlicesAndTheSameSeedGivesTheSame) {
  // A small, smooth phantom and coarse slices: seconds instead of minutes.
  PhantomOptions phantom;
  phantom.length_mm = 60.;
  phantom.resolution_mm = 2.;
  const BrainVolume brain = make_phantom(phantom);
  ClosedLoopOptions options;
  options.scanner.size_px = 32;
  options.scanner.pixel_mm = 3.;
  options.scanner.thickness_mm = 6.;
  options.scanner.void_share = 0.3;
  options.pipeline.sequence.size_px = 32;
  options.pipeline.sequence.resolution_mm = 3.;
  options.pipeline.estimator.method = "nominal";
  options.pipeline.estimator.volume_resolution_mm = 3.;
  options.pipeline.estimator.volume_size_mm = 96.;
  const auto run = [&](RepeatStrategy strategy) { return run_closed_loop(brain, "none", 3, strategy, options); };
  const ClosedLoopResult none = run(RepeatStrategy::none), requests = run(RepeatStrategy::requests);
  EXPECT_EQ(none.repeats, 0);
  EXPECT_GT(requests.repeats, 0);
  EXPECT_EQ(requests.slices, none.slices + requests.repeats);
  EXPECT_GT(requests.scan_s, none.scan_s);
  EXPECT_LE(requests.scan_s, none.scan_s + options.decision.reacquisition.budget_s + 1e-6);
  EXPECT_LT(none.volume_error, 0.5);  // the head rests, so the volume is the brain, at 6 mm
  EXPECT_LT(none.pose_error_mm, 0.01);
  const ClosedLoopResult again = run(RepeatStrategy::requests);
  EXPECT_EQ(again.volume_error, requests.volume_error);
  EXPECT_EQ(again.repeats, requests.repeats);
  const std::string table = to_markdown({none, requests});
  EXPECT_NE(table.find("| none | requests | 1 |"), std::string::npos) << table;
  EXPECT_EQ(to_csv({none}).find("motion,seed,strategy"), 0U);
}

}  // namespace
}  // namespace svort
