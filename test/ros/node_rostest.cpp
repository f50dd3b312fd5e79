// svort_node as its users see it; node.test starts it.

#include <diagnostic_msgs/DiagnosticArray.h>
#include <dynamic_reconfigure/Reconfigure.h>
#include <geometry_msgs/PoseStamped.h>
#include <gtest/gtest.h>
#include <sensor_msgs/PointCloud2.h>
#include <visualization_msgs/MarkerArray.h>

#include <filesystem>
#include <fstream>
#include <functional>
#include <limits>

#include "ros/node_client.h"
#include "svort_ros/Coverage.h"
#include "svort_ros/HeadMotion.h"
#include "svort_ros/ReacquisitionPlan.h"
#include "svort_ros/Veto.h"
#include "svort_ros/io/tables.h"

namespace svort_ros {
namespace {

namespace fs = std::filesystem;
using svort_test::Collector;
using svort_test::eventually;
using svort_test::synthetic_messages;

class NodeTest : public testing::Test {
 protected:
  void SetUp() override {
    ASSERT_TRUE(client_.connect());
    std::string folder;
    ASSERT_TRUE(ros::param::get("svort/node/output_directory", folder));
    output_ = folder;
    fs::remove_all(output_);
    ASSERT_TRUE(client_.call(kResetService).success);
  }
  void TearDown() override { fs::remove_all(output_); }

  svort_test::NodeClient client_;
  fs::path output_;
};

TEST_F(NodeTest, EverySliceGetsOneAnswerAndItsPlaceInTf) {
  const auto slices = synthetic_messages("tf");
  for (const Slice& slice : slices) {
    const SliceStatus status = client_.send_and_wait(slice);
    EXPECT_EQ(status.status, SliceStatus::ACCEPTED) << status.reason;
    EXPECT_TRUE(status.kept);
    EXPECT_EQ(status.stack, slice.stack);
    EXPECT_EQ(status.index, slice.index);
    EXPECT_EQ(status.header.stamp, slice.header.stamp);
    EXPECT_GT(status.revision, 0U);
    EXPECT_GE(status.latency, 0.);
    EXPECT_LT(status.latency, 5.);
  }
  for (const Slice& slice : slices) {
    const svort::Pose expected = from_msg(slice.nominal_pose);
    // tf is double precision; 1e-6 mm leaves room for one interpolation.
    EXPECT_LT((client_.lookup_slice(slice).matrix() - expected.matrix()).norm(), 1e-6)
        << "stack " << slice.stack << " slice " << slice.index;
  }
}

TEST_F(NodeTest, EstimateHoldsAllSlicesInOrderOfAcquisition) {
  auto slices = synthetic_messages("order");
  std::swap(slices[3], slices[4]);
  std::swap(slices[7], slices[8]);  // across two stacks
  const auto answers = client_.send_and_wait(slices);
  ASSERT_EQ(answers.size(), slices.size());
  EXPECT_EQ(answers[4].status, SliceStatus::OUT_OF_ORDER);
  EXPECT_EQ(answers[8].status, SliceStatus::LATE);
  ASSERT_TRUE(eventually([&] {
    const auto estimates = client_.estimate().all();
    return !estimates.empty() && estimates.back().slices.size() == slices.size();
  }));
  const SequenceEstimate estimate = client_.estimate().all().back();
  EXPECT_EQ(estimate.scan_id, "order");
  EXPECT_EQ(estimate.scanner_frame, "scanner");
  EXPECT_EQ(estimate.header.frame_id, "fetal_brain");
  EXPECT_EQ(estimate.header.stamp, slices.back().header.stamp);
  for (std::size_t i = 1; i < estimate.slices.size(); ++i)
    EXPECT_LT(estimate.slices[i - 1].stamp, estimate.slices[i].stamp);
  for (const SlicePose& pose : estimate.slices) EXPECT_EQ(pose.status, SlicePose::NOMINAL);
  for (const Slice& slice : slices)
    EXPECT_LT((client_.lookup_slice(slice).matrix() - from_msg(slice.nominal_pose).matrix()).norm(), 1e-6);
}

TEST_F(NodeTest, BadSlicesAreAnsweredWithTheReasonAndLeaveNoTrace) {
  const auto slices = synthetic_messages("bad");
  ASSERT_TRUE(client_.send_and_wait(slices[0]).kept);
  ASSERT_TRUE(client_.send_and_wait(slices[1]).kept);
  const auto expect_rejected = [&](const char* what, std::uint8_t status, const std::function<void(Slice&)>& spoil) {
    Slice slice = slices[2];
    spoil(slice);
    const SliceStatus answer = client_.send_and_wait(slice);
    EXPECT_EQ(int{answer.status}, int{status}) << what << ": " << answer.reason;
    EXPECT_FALSE(answer.kept) << what;
    EXPECT_FALSE(answer.reason.empty()) << what;
    EXPECT_EQ(answer.sequence_length, 2U) << what;
    EXPECT_EQ(answer.revision, 0U) << what;
  };
  const auto set_pixel = [](Slice& slice, float value) {
    std::memcpy(&slice.image.data[4 * 1000], &value, sizeof(value));
  };
  expect_rejected("duplicate", SliceStatus::DUPLICATE, [&](Slice& s) { s = slices[1]; });
  expect_rejected("NaN", SliceStatus::BAD_IMAGE,
                  [&](Slice& s) { set_pixel(s, std::numeric_limits<float>::quiet_NaN()); });
  expect_rejected("infinity", SliceStatus::BAD_IMAGE,
                  [&](Slice& s) { set_pixel(s, std::numeric_limits<float>::infinity()); });
  expect_rejected("truncated", SliceStatus::BAD_IMAGE, [](Slice& s) { s.image.data.resize(100); });
  expect_rejected("no image", SliceStatus::BAD_IMAGE, [](Slice& s) { s.image = sensor_msgs::Image(); });
  expect_rejected("encoding", SliceStatus::BAD_IMAGE, [](Slice& s) { s.image.encoding = "bgr8"; });
  expect_rejected("mask size", SliceStatus::BAD_IMAGE, [](Slice& s) { s.mask.width = 3; });
  expect_rejected("empty mask", SliceStatus::EMPTY_MASK,
                  [](Slice& s) { std::fill(s.mask.data.begin(), s.mask.data.end(), std::uint8_t{0}); });
  expect_rejected("quaternion", SliceStatus::BAD_GEOMETRY, [](Slice& s) { s.nominal_pose.orientation.z += 1.; });
  expect_rejected("zero spacing", SliceStatus::BAD_GEOMETRY, [](Slice& s) { s.pixel_spacing_x = 0.; });
  expect_rejected("NaN thickness", SliceStatus::BAD_GEOMETRY,
                  [](Slice& s) { s.thickness = std::numeric_limits<double>::quiet_NaN(); });
  expect_rejected("index", SliceStatus::BAD_GEOMETRY, [](Slice& s) { s.index = -1; });
  expect_rejected("inconsistent", SliceStatus::INCONSISTENT_STACK, [](Slice& s) { s.pixel_spacing_y *= 2.; });
  EXPECT_TRUE(client_.send_and_wait(slices[2]).kept);

  Collector<diagnostic_msgs::DiagnosticArray> diagnostics("/diagnostics");
  const auto reports = [&](const std::string& name, const std::string& text) {
    return eventually([&] {
      for (const auto& array : diagnostics.all())
        for (const auto& status : array.status)
          if (status.name == name && status.message.find(text) != std::string::npos) return true;
      return false;
    });
  };
  // On a machine that is busy, being too slow is what the message tells of first: the count is there all the same.
  EXPECT_TRUE(eventually([&] {
    for (const auto& array : diagnostics.all())
      for (const auto& status : array.status)
        for (const auto& entry : status.values)
          if (status.name == "svort: slices" && entry.key == "rejected" && std::stoul(entry.value) >= 13U)
            return status.level == diagnostic_msgs::DiagnosticStatus::WARN;
    return false;
  }));
  EXPECT_TRUE(reports("svort: estimator", "poses are nominal"));
  EXPECT_TRUE(reports("svort: results", "written to"));
}

TEST_F(NodeTest, ForeignScannerFrameIsRemarkedOn) {
  Slice slice = synthetic_messages("frame")[0];
  slice.header.frame_id = "elsewhere";
  const SliceStatus status = client_.send_and_wait(slice);
  EXPECT_TRUE(status.kept);
  ASSERT_FALSE(status.warnings.empty());
  EXPECT_NE(status.warnings.back().find("'elsewhere'"), std::string::npos);
}

TEST_F(NodeTest, BurstLosesNothing) {
  auto slices = synthetic_messages("burst");
  while (slices.size() < 30) slices.push_back(slices[slices.size() - 24]);  // six of them twice
  client_.status().clear();
  const auto answers = client_.send_and_wait(slices);
  ASSERT_EQ(answers.size(), 30U);
  for (std::size_t i = 0; i < answers.size(); ++i) {
    EXPECT_EQ(answers[i].header.stamp, slices[i].header.stamp);  // in order of arrival
    EXPECT_EQ(int{answers[i].status}, i < 24 ? int{SliceStatus::ACCEPTED} : int{SliceStatus::DUPLICATE});
  }
  // The volume catches up with the newest slice, however many updates it took.
  Collector<Volume> volumes(kVolumeTopic);
  EXPECT_TRUE(eventually([&] {
    const auto all = volumes.all();
    return !all.empty() && all.back().scan_id == "burst" && all.back().header.stamp == slices[23].header.stamp;
  }));
  ros::Duration(0.5).sleep();
  EXPECT_EQ(client_.status().count(), 30U);  // exactly one answer each
}

TEST_F(NodeTest, LateSubscribersGetTheLastState) {
  auto slices = synthetic_messages("late");
  slices.resize(8);
  ASSERT_EQ(client_.send_and_wait(slices).size(), 8U);
  ASSERT_TRUE(client_.call(kFinaliseService).success);

  Collector<Volume> volumes(kVolumeTopic);
  Collector<Volume> compacts(kVolumeCompactTopic);
  Collector<sensor_msgs::PointCloud2> clouds(kVolumeCloudTopic);
  Collector<visualization_msgs::Marker> surfaces(kSurfaceTopic);
  Collector<visualization_msgs::MarkerArray> markers(kCurrentSliceTopic);
  Collector<SequenceEstimate> estimates(kEstimateTopic);
  Collector<geometry_msgs::PoseStamped> heads(kHeadPoseTopic);
  ASSERT_TRUE(eventually([&] { return volumes.count() > 0; })) << "volume";
  ASSERT_TRUE(eventually([&] { return compacts.count() > 0; })) << "compact volume";
  ASSERT_TRUE(eventually([&] { return clouds.count() > 0; })) << "cloud";
  ASSERT_TRUE(eventually([&] { return surfaces.count() > 0; })) << "surface";
  ASSERT_TRUE(eventually([&] { return markers.count() > 0; })) << "slice";
  ASSERT_TRUE(eventually([&] { return estimates.count() > 0; })) << "estimate";
  ASSERT_TRUE(eventually([&] { return heads.count() > 0; })) << "head pose";

  const Volume volume = volumes.all().back();
  EXPECT_EQ(volume.scan_id, "late");
  EXPECT_TRUE(volume.final);
  EXPECT_TRUE(estimates.all().back().final);
  EXPECT_EQ(volume.revision, estimates.all().back().revision);
  const svort::Volume exact = from_msg(volume);
  EXPECT_GT(reference_intensity(exact), 0.5);  // intensities are normalised to about 1
  EXPECT_LT(reference_intensity(exact), 2.);
  const Volume compact = compacts.all().back();
  EXPECT_EQ(compact.revision, volume.revision);
  EXPECT_LT(compact.data.size(), volume.data.size() / 2);
  EXPECT_NEAR(reference_intensity(from_msg(compact)), reference_intensity(exact), 1e-3);
  EXPECT_GT(clouds.all().back().width, 1000U);
  EXPECT_EQ(clouds.all().back().header.frame_id, "fetal_brain");
  EXPECT_GT(surfaces.all().back().points.size(), 300U);
  EXPECT_EQ(markers.all().back().markers.size(), 4U);  // outline, axes, label, plane
  EXPECT_EQ(heads.all().back().header.frame_id, "scanner");
  // The brain frame's origin is the centre of what the masks show: within 3 mm of the phantom's centre in plane.
  EXPECT_NEAR(heads.all().back().pose.position.x, 0.012, 0.006);
}

TEST_F(NodeTest, SaveWritesAndResetForgets) {
  EXPECT_FALSE(client_.call(kSaveService).success);  // nothing there yet
  EXPECT_FALSE(client_.call(kFinaliseService).success);
  auto slices = synthetic_messages("save/me");
  slices.resize(6);
  ASSERT_EQ(client_.send_and_wait(slices).size(), 6U);
  auto answer = client_.call(kFinaliseService);
  EXPECT_TRUE(answer.success) << answer.message;
  EXPECT_NE(answer.message.find("6 slices"), std::string::npos) << answer.message;
  answer = client_.call(kSaveService);
  EXPECT_TRUE(answer.success) << answer.message;
  const fs::path folder = output_ / "save_me";
  EXPECT_NE(answer.message.find(folder.string()), std::string::npos) << answer.message;
  for (const char* file : {"poses.csv", "updates.csv", "volume.nii.gz", "volume.png", "latency.png", "run.json"})
    EXPECT_TRUE(fs::exists(folder / file)) << file;
  EXPECT_EQ(svort::read_pose_table(folder / "poses.csv").size(), 6U);

  client_.estimate().clear();
  ASSERT_TRUE(client_.call(kResetService).success);
  ASSERT_TRUE(eventually([&] { return client_.estimate().count() > 0; }));
  EXPECT_TRUE(client_.estimate().all().back().slices.empty());
  Collector<Volume> volumes(kVolumeTopic);
  ASSERT_TRUE(eventually([&] { return volumes.count() > 0; }));
  EXPECT_TRUE(volumes.all().back().data.empty());

  const SliceStatus status = client_.send_and_wait(slices[0]);  // no duplicate any more
  EXPECT_EQ(int{status.status}, int{SliceStatus::ACCEPTED}) << status.reason;
  EXPECT_EQ(status.sequence_length, 1U);
  EXPECT_TRUE(client_.call(kSaveService).success);
  EXPECT_TRUE(fs::exists(output_ / "save_me_2" / "poses.csv"));  // the first one is left alone
  EXPECT_EQ(svort::read_pose_table(folder / "poses.csv").size(), 6U);
}

TEST_F(NodeTest, DecidesAndTakesVetoesAndThresholds) {
  Collector<ReacquisitionPlan> plans(kReacquisitionTopic);
  Collector<HeadMotion> motion(kHeadMotionTopic);
  Collector<Coverage> coverage(kCoverageTopic);
  Collector<visualization_msgs::MarkerArray> planned(kPlannedSlicesTopic);
  // Every place in all three stacks, and at once: then the slice that is left out is missed.
  dynamic_reconfigure::Reconfigure change;
  for (const auto& [name, value] :
       {std::pair{"coverage__views", 2.6}, {"coverage__sharp_views", 1.6}, {"reacquisition__budget_s", 500.}}) {
    dynamic_reconfigure::DoubleParameter parameter;
    parameter.name = name;
    parameter.value = value;
    change.request.config.doubles.push_back(parameter);
  }
  dynamic_reconfigure::IntParameter at_once;
  at_once.name = "reacquisition__confirm_updates";
  at_once.value = 1;
  change.request.config.ints.push_back(at_once);
  ASSERT_TRUE(ros::service::call("svort/decision/set_parameters", change));
  const auto in_use = [&change](const std::string& name) {
    for (const auto& parameter : change.response.config.doubles)
      if (parameter.name == name) return parameter.value;
    return -1.;
  };
  EXPECT_EQ(in_use("reacquisition__budget_s"), 500.);
  change.request.config.doubles[0].value = -1.;  // out of range: nothing changes
  ASSERT_TRUE(ros::service::call("svort/decision/set_parameters", change));
  EXPECT_EQ(in_use("coverage__views"), 2.6);

  for (const Slice& slice : synthetic_messages("decisions"))
    if (slice.stack != 1 || slice.index != 3) {
      ASSERT_TRUE(client_.send_and_wait(slice).kept);
    }
  ASSERT_TRUE(client_.call(kFinaliseService).success);
  ASSERT_TRUE(eventually([&] { return plans.count() > 0 && !plans.all().back().requests.empty(); }));
  EXPECT_TRUE(plans.all().back().dry_run);
  EXPECT_EQ(plans.all().back().header.frame_id, "scanner");
  ASSERT_TRUE(eventually([&] { return coverage.count() > 0 && motion.count() > 0 && planned.count() > 0; }));
  EXPECT_GT(coverage.all().back().brain_volume, 0.);
  EXPECT_EQ(int{motion.all().back().motion_class}, int{HeadMotion::NONE});  // nominal poses

  Veto veto;
  veto.request.id = plans.all().back().requests.front().id;
  veto.request.reason = "the mother needs a break";
  ASSERT_TRUE(ros::service::call("svort/veto", veto));
  EXPECT_TRUE(veto.response.success) << veto.response.message;
  ASSERT_TRUE(ros::service::call("svort/veto", veto));
  EXPECT_FALSE(veto.response.success);
  EXPECT_TRUE(eventually([&] {
    for (const ReacquisitionRequest& request : plans.all().back().requests)
      if (request.id == veto.request.id) return false;
    return true;
  }));

  ASSERT_TRUE(client_.call(kSaveService).success);
  const std::string audit = svort_test::read_bytes(output_ / "decisions" / "reacquisition.csv");
  EXPECT_NE(audit.find("the mother needs a break"), std::string::npos);
  EXPECT_NE(audit.find("coverage.views 2 -> 2.6"), std::string::npos) << audit;
  EXPECT_TRUE(fs::exists(output_ / "decisions" / "report.html"));
}

TEST_F(NodeTest, ANewScanWritesTheOldOne) {
  const auto old_slices = synthetic_messages("old");
  const auto new_slices = synthetic_messages("new");
  Collector<SequenceEstimate> estimates(kFinalEstimateTopic);
  Collector<Volume> volumes(kFinalVolumeTopic);
  for (std::size_t i = 0; i < 5; ++i) ASSERT_TRUE(client_.send_and_wait(old_slices[i]).kept);
  const SliceStatus status = client_.send_and_wait(new_slices[0]);
  EXPECT_TRUE(status.kept) << status.reason;
  EXPECT_EQ(status.sequence_length, 1U);
  // The old one is finalised and written meanwhile.
  const auto is_old = [](const auto& message) { return message.scan_id == "old"; };
  ASSERT_TRUE(eventually([&] {
    const auto all = volumes.all();  // published after the estimate
    return std::any_of(all.begin(), all.end(), is_old);
  }));
  ASSERT_TRUE(eventually([&] {
    const auto all = estimates.all();
    return std::any_of(all.begin(), all.end(), is_old);
  }));
  EXPECT_EQ(svort::read_pose_table(output_ / "old" / "poses.csv").size(), 5U);
  EXPECT_EQ(estimates.all().back().slices.size(), 5U);
  EXPECT_TRUE(estimates.all().back().final);
  EXPECT_TRUE(volumes.all().back().final);
  EXPECT_FALSE(fs::exists(output_ / "new"));
  EXPECT_EQ(int{client_.send_and_wait(old_slices[5]).status}, int{SliceStatus::ENDED_SCAN});
  EXPECT_EQ(client_.send_and_wait(new_slices[1]).sequence_length, 2U);
}

TEST_F(NodeTest, ADiskThatFailsLosesNothing) {
  // A file stands where the folder should be: every write fails, as on a full disk.
  std::ofstream(output_) << "in the way";
  const auto first = synthetic_messages("first");
  const auto second = synthetic_messages("second");
  for (std::size_t i = 0; i < 4; ++i) ASSERT_TRUE(client_.send_and_wait(first[i]).kept);
  auto answer = client_.call(kSaveService);
  EXPECT_FALSE(answer.success);
  EXPECT_NE(answer.message.find(output_.string()), std::string::npos) << answer.message;

  const std::uint64_t before = client_.send_and_wait(first[4]).revision;
  const SliceStatus status = client_.send_and_wait(second[0]);  // ends the first scan, which cannot be written
  EXPECT_TRUE(status.kept) << status.reason;
  EXPECT_EQ(status.sequence_length, 1U);
  EXPECT_GT(status.revision, before);  // revisions go on counting
  EXPECT_EQ(int{client_.send_and_wait(first[5]).status}, int{SliceStatus::ENDED_SCAN});
  Collector<diagnostic_msgs::DiagnosticArray> diagnostics("/diagnostics");
  EXPECT_TRUE(eventually([&] {
    for (const auto& array : diagnostics.all())
      for (const auto& report : array.status)
        if (report.name == "svort: results" && report.level == diagnostic_msgs::DiagnosticStatus::ERROR &&
            report.message.find("1 scans could not be written and are kept in memory") != std::string::npos)
          return true;
    return false;
  }));
  EXPECT_FALSE(client_.call(kSaveService).success);

  fs::remove(output_);
  answer = client_.call(kSaveService);
  EXPECT_TRUE(answer.success) << answer.message;
  EXPECT_EQ(svort::read_pose_table(output_ / "first" / "poses.csv").size(), 5U);
  EXPECT_EQ(svort::read_pose_table(output_ / "second" / "poses.csv").size(), 1U);
}

}  // namespace
}  // namespace svort_ros

int main(int argc, char** argv) { return svort_test::run_node_tests(argc, argv, "node_rostest"); }
