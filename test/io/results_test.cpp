#include "svort_ros/io/results.h"

#include <cmath>
#include <limits>
#include <nlohmann/json.hpp>

#include "io/scratch.h"
#include "sequence/slice_fixture.h"
#include "svort_ros/io/nifti.h"
#include "svort_ros/io/tables.h"

namespace svort {
namespace {

using Results = Scratch;

PipelineOptions small_options() {
  PipelineOptions options;
  options.estimator.method = "nominal";
  options.estimator.volume_resolution_mm = 2.;
  options.estimator.volume_size_mm = 60.;
  options.estimator.final_volume.resolution_mm = options.estimator.volume_resolution_mm;
  return options;
}

/// A finished run on two small stacks, with one duplicate.
void run(LivePipeline& pipeline) {
  const auto send = [&pipeline](const Slice& slice) {
    const Arrival arrival = pipeline.add(slice);
    JournalEntry entry;
    entry.info = slice.info;
    entry.status = arrival.status;
    entry.reason = arrival.reason;
    entry.latency_ms = 5. + static_cast<double>(pipeline.journal().entries().size());
    entry.volume_latency_ms = is_kept(arrival.status) ? 100. : std::numeric_limits<double>::quiet_NaN();
    entry.sequence_length = pipeline.sequence().slices().size();
    entry.revision = pipeline.estimate().revision;
    entry.device = pipeline.device();
    if (pipeline.newest()) entry.T_brain_slice = pipeline.newest()->T_brain_slice;
    pipeline.journal().add(entry);
  };
  for (int stack = 0; stack < 2; ++stack)
    for (int index = 0; index < 6; ++index) {
      Slice slice = make_slice(stack, index);
      for (std::size_t i = 0; i < slice.pixels.size(); ++i)
        slice.pixels[i] = 100.F + 40.F * std::sin(0.01F * static_cast<float>(i % 977));
      send(slice);
    }
  send(make_slice(1, 3));
  pipeline.finalise();
}

TEST_F(Results, WritesTheWholeFolder) {
  LivePipeline pipeline(small_options());
  run(pipeline);
  RunInfo info;
  info.program = "results_test";
  info.inputs = {"a.nii.gz", "b.nii.gz"};
  info.seed = 17;
  info.threads = 2;
  info.wall_s = 1.5;
  const auto folder = path("new/folder");
  write_results(folder, pipeline, info);

  const std::vector<PoseRow> poses = read_pose_table(folder / "poses.csv");
  ASSERT_EQ(poses.size(), 12U);
  for (std::size_t i = 0; i < poses.size(); ++i) {
    const SliceEstimate& slice = pipeline.estimate().slices[i];
    EXPECT_EQ(poses[i].stamp_ns, slice.info.stamp_ns);
    EXPECT_LT((poses[i].T_brain_slice.matrix() - slice.T_brain_slice.matrix()).norm(), 1e-12);
    EXPECT_EQ(poses[i].status, "nominal");
  }
  const std::string updates = read(folder / "updates.csv");
  EXPECT_EQ(std::count(updates.begin(), updates.end(), '\n'), 1 + 13);
  EXPECT_TRUE(contains(updates, ",duplicate,"));
  const NiftiImage volume = read_nifti(folder / "volume.nii.gz");
  EXPECT_EQ(volume.values, pipeline.volume().values);
  EXPECT_GT(std::filesystem::file_size(folder / "volume.png"), 10000U);
  EXPECT_GT(std::filesystem::file_size(folder / "latency.png"), 10000U);

  const auto json = nlohmann::json::parse(read(folder / "run.json"));
  EXPECT_EQ(json["program"], "results_test");
  EXPECT_EQ(json["inputs"], (std::vector<std::string>{"a.nii.gz", "b.nii.gz"}));
  EXPECT_EQ(json["version"].get<std::string>().find_first_not_of("0123456789."), std::string::npos);
  EXPECT_TRUE(json["libtorch"].is_string());
  EXPECT_EQ(json["scan_id"], "a");
  EXPECT_EQ(json["seed"], 17);
  EXPECT_EQ(json["threads"], 2);
  EXPECT_EQ(json["wall_s"], 1.5);
  EXPECT_GT(json["peak_memory_mib"].get<double>(), 10.);
  EXPECT_EQ(json["estimator"]["method"], "nominal");
  EXPECT_TRUE(contains(json["estimator"]["note"], "no motion was estimated"));
  EXPECT_EQ(json["slices"], 12);
  EXPECT_EQ(json["final"], true);
  EXPECT_EQ(json["arrivals"], (nlohmann::json{{"accepted", 12}, {"duplicate", 1}}));
  EXPECT_EQ(json["latency"]["pose_ms"]["max"], 16.);  // 5 .. 16 ms, in steps of 1 ms
  EXPECT_EQ(json["latency"]["pose_ms"]["median"], 10.5);
  EXPECT_EQ(json["latency"]["volume_ms"]["p95"], 100.);
  EXPECT_EQ(json["latency"]["rejected_ms"]["median"], 17.);
  EXPECT_EQ(json["options"]["estimator"]["volume_resolution_mm"], 2.);
  EXPECT_EQ(json["options"]["sequence"]["size_px"], 128);
  double sum = 0.;
  for (const SliceEstimate& slice : pipeline.estimate().slices) sum += slice.ncc;
  EXPECT_NEAR(json["ncc"]["mean"].get<double>(), sum / 12., 1e-12);
  EXPECT_EQ(json["ncc"]["slices"], 12);
  EXPECT_EQ(json["ncc"]["stacks"]["1"]["slices"], 6);
}

TEST_F(Results, SameBytesForTheSameRun) {
  for (const std::string name : {"a", "b"}) {
    LivePipeline pipeline(small_options());
    run(pipeline);
    write_results(path(name), pipeline, {});
  }
  for (const std::string name : {"poses.csv", "updates.csv", "volume.nii.gz", "volume.png", "latency.png"})
    EXPECT_EQ(read(path("a/" + name)), read(path("b/" + name))) << name;
}

TEST_F(Results, WithoutSlicesThereIsNothingFromAnEarlierRun) {
  LivePipeline pipeline(small_options());
  run(pipeline);
  write_results(path("out"), pipeline, {});
  write("out/notes.txt", "the user's own");
  const LivePipeline empty(small_options());
  write_results(path("out"), empty, {});
  for (const std::string name : {"poses.csv", "volume.nii.gz", "volume.png", "latency.png"})
    EXPECT_FALSE(std::filesystem::exists(path("out/" + name))) << name;
  EXPECT_TRUE(std::filesystem::exists(path("out/notes.txt")));
  EXPECT_TRUE(std::filesystem::exists(path("out/updates.csv")));
  const auto json = nlohmann::json::parse(read(path("out/run.json")));
  EXPECT_EQ(json["slices"], 0);
  EXPECT_TRUE(json["ncc"]["mean"].is_null());
  EXPECT_TRUE(json["latency"]["pose_ms"]["median"].is_null());
}

TEST_F(Results, SurvivesAScanIdThatIsNotText) {
  LivePipeline pipeline(small_options());
  pipeline.add(make_slice(0, 0, "\xff\xfe,\n"));
  pipeline.finalise();
  write_results(path("out"), pipeline, {});
  EXPECT_TRUE(nlohmann::json::parse(read(path("out/run.json")))["scan_id"].is_string());
  EXPECT_EQ(read_pose_table(path("out/poses.csv"))[0].scan_id, "\xff\xfe,\n");
}

TEST_F(Results, NamesAFolderThatCannotBeMade) {
  const LivePipeline pipeline(small_options());
  write("file", "x");
  EXPECT_MESSAGE(write_results(path("file"), pipeline, {}), path("file").string() + ": cannot make this folder");
  EXPECT_MESSAGE(write_results(path("file/below"), pipeline, {}), "cannot make this folder");
}

TEST(Percentiles, InterpolateAndLeaveOutNan) {
  const double nan = std::numeric_limits<double>::quiet_NaN();
  const Percentiles p = percentiles({5., nan, 1., 2., 4., 3.});
  EXPECT_EQ(p.median, 3.);
  EXPECT_DOUBLE_EQ(p.p95, 4.8);
  EXPECT_EQ(p.max, 5.);
  EXPECT_EQ(percentiles({7.}).p95, 7.);
  EXPECT_TRUE(std::isnan(percentiles({}).median));
  EXPECT_TRUE(std::isnan(percentiles({nan}).max));
}

TEST(PeakMemory, GrowsWithMemory) {
  const double before = peak_memory_mib();
  std::vector<char> block(static_cast<std::size_t>(before + 100.) << 20U, 1);
  EXPECT_EQ(block[block.size() / 2], 1);
  EXPECT_GT(peak_memory_mib(), before + 50.);
}

}  // namespace
}  // namespace svort
