#include "svort_ros/io/tables.h"

#include <cmath>
#include <limits>
#include <random>

#include "io/scratch.h"

namespace svort {
namespace {

const double kNan = std::numeric_limits<double>::quiet_NaN();

Pose random_pose(std::mt19937& random) {
  std::normal_distribution<double> normal;
  const Eigen::Quaterniond q =
      Eigen::Quaterniond(normal(random), normal(random), normal(random), normal(random)).normalized();
  return Eigen::Translation3d(80. * normal(random), 80. * normal(random), 80. * normal(random)) * Pose(q);
}

using Tables = Scratch;

TEST_F(Tables, PosesAreExactlyAsDescribed) {
  Estimate estimate;
  SliceEstimate slice;
  slice.info.scan_id = "a";
  slice.info.stack = 1;
  slice.info.index = 4;
  slice.info.stamp_ns = 1700000000123456789;
  slice.T_brain_slice.translation() << 1.5, -2., 0.;
  slice.T_scanner_brain.linear() = Eigen::AngleAxisd(std::acos(-1.), Eigen::Vector3d::UnitX()).toRotationMatrix();
  slice.weight = 0.75;
  slice.ncc = kNan;
  slice.radius_95_mm = 1.25;
  estimate.slices.push_back(slice);
  write_pose_table(path("poses.csv"), estimate);
  const std::string text = read(path("poses.csv"));
  EXPECT_EQ(text.substr(0, text.find('\n')),
            "scan_id,stack,slice,stamp,tx,ty,tz,qx,qy,qz,qw,head_tx,head_ty,head_tz,head_qx,head_qy,head_qz,head_qw,"
            "weight,ncc,status,radius_95_mm");
  EXPECT_TRUE(contains(text, "\na,1,4,1700000000.123456789,1.5,-2,0,0,0,0,1,0,0,0,1,")) << text;
  EXPECT_TRUE(contains(text, ",0.75,nan,nominal,1.25\n")) << text;
}

TEST_F(Tables, PosesSurviveARoundTrip) {
  std::mt19937 random(3);
  Estimate estimate;
  for (int i = 0; i < 50; ++i) {
    SliceEstimate slice;
    slice.info.scan_id = i % 2 ? "scan, with \"quotes\"" : "two\nlines";
    slice.info.stack = i / 10;
    slice.info.index = i;
    slice.info.stamp_ns = 1700000000000000001 + 1234567891 * static_cast<std::int64_t>(i);
    slice.T_brain_slice = random_pose(random);
    slice.T_scanner_brain = random_pose(random);
    slice.weight = 1. / (i + 3);
    slice.ncc = i == 7 ? kNan : 0.1 * i;
    estimate.slices.push_back(slice);
  }
  write_pose_table(path("poses.csv"), estimate);
  const std::vector<PoseRow> rows = read_pose_table(path("poses.csv"));
  ASSERT_EQ(rows.size(), 50U);
  for (std::size_t i = 0; i < rows.size(); ++i) {
    const SliceEstimate& slice = estimate.slices[i];
    EXPECT_EQ(rows[i].scan_id, slice.info.scan_id);
    EXPECT_EQ(rows[i].stack, slice.info.stack);
    EXPECT_EQ(rows[i].slice, slice.info.index);
    EXPECT_EQ(rows[i].stamp_ns, slice.info.stamp_ns);
    EXPECT_NEAR(rows[i].stamp, 1e-9 * static_cast<double>(slice.info.stamp_ns), 1e-6);
    // Translations come back bit by bit, rotations within the rounding of the quaternion.
    EXPECT_EQ(rows[i].T_brain_slice.translation(), slice.T_brain_slice.translation());
    EXPECT_LT((rows[i].T_brain_slice.linear() - slice.T_brain_slice.linear()).norm(), 1e-14);
    EXPECT_EQ(rows[i].T_scanner_brain.translation(), slice.T_scanner_brain.translation());
    EXPECT_LT((rows[i].T_scanner_brain.linear() - slice.T_scanner_brain.linear()).norm(), 1e-14);
    EXPECT_EQ(rows[i].weight, slice.weight);
    if (i == 7)
      EXPECT_TRUE(std::isnan(rows[i].ncc));
    else
      EXPECT_EQ(rows[i].ncc, slice.ncc);
    EXPECT_EQ(rows[i].status, "nominal");
  }
  const std::string once = read(path("poses.csv"));
  write_pose_table(path("again.csv"), estimate);
  EXPECT_EQ(read(path("again.csv")), once);
}

const std::string kTruthHeader = "scan_id,stack,slice,stamp,tx,ty,tz,qx,qy,qz,qw";

TEST_F(Tables, ReadsTruthWithoutTheTrailingColumns) {
  const auto rows = read_pose_table(write("truth.csv", kTruthHeader + "\r\n\"a,b\",0,1,2.5,1,2,3,0,0,0,-1\r\n\r\n"));
  ASSERT_EQ(rows.size(), 1U);
  EXPECT_EQ(rows[0].scan_id, "a,b");
  EXPECT_EQ(rows[0].stamp_ns, 2500000000);
  EXPECT_EQ(rows[0].T_brain_slice.translation(), Eigen::Vector3d(1., 2., 3.));
  EXPECT_TRUE(rows[0].T_brain_slice.linear().isIdentity(1e-15));
  EXPECT_TRUE(rows[0].T_scanner_brain.matrix().isIdentity(0.));
  EXPECT_EQ(rows[0].weight, 1.);
  EXPECT_EQ(rows[0].status, "");
  EXPECT_TRUE(read_pose_table(write("empty.csv", kTruthHeader + "\n")).empty());
}

TEST_F(Tables, FindsColumnsByName) {
  const auto rows = read_pose_table(
      write("a.csv", "ncc,stack,slice,stamp,tz,ty,tx,qx,qy,qz,qw,scan_id\n0.5,2,1,-0.25,3,2,1,0,0,0,1,x"));
  ASSERT_EQ(rows.size(), 1U);
  EXPECT_EQ(rows[0].T_brain_slice.translation(), Eigen::Vector3d(1., 2., 3.));
  EXPECT_EQ(rows[0].ncc, 0.5);
  EXPECT_EQ(rows[0].stack, 2);
  EXPECT_EQ(rows[0].stamp_ns, -250000000);
}

TEST_F(Tables, NamesFileLineAndColumnOfEveryFault) {
  const auto message = [this](const std::string& content) {
    const std::string text = message_of([&] { read_pose_table(write("a.csv", content)); });
    EXPECT_EQ(text.rfind(path("a.csv").string() + ", line ", 0), 0U) << text;
    return text.substr(std::min(text.size(), path("a.csv").string().size() + 2));
  };
  const auto row = [&](const std::string& fields) {
    return message(kTruthHeader + "\na,0,0,1,0,0,0,0,0,0,1\n" + fields + "\n");
  };
  EXPECT_EQ(row("a,0,1,2,0,0,0,0,0,0"), "line 3: 10 fields, the header has 11");
  EXPECT_EQ(row("a,0,1,2,0,0,0,0,0,0,1,9"), "line 3: 12 fields, the header has 11");
  EXPECT_EQ(row("a,zero,1,2,0,0,0,0,0,0,1"), "line 3: column 'stack': 'zero' is not a number of the kind wanted");
  EXPECT_EQ(row("a,0,1.5,2,0,0,0,0,0,0,1"), "line 3: column 'slice': '1.5' is not a number of the kind wanted");
  EXPECT_EQ(row("a,0,1,2,0,,0,0,0,0,1"), "line 3: column 'ty': '' is not a number of the kind wanted");
  EXPECT_EQ(row("a,0,1,2,0,0,1e3x,0,0,0,1"), "line 3: column 'tz': '1e3x' is not a number of the kind wanted");
  EXPECT_EQ(row("a,0,1,2,nan,0,0,0,0,0,1"), "line 3: column 'tx' is not finite");
  EXPECT_TRUE(contains(row("a,0,1,noon,0,0,0,0,0,0,1"), "line 3: column 'stamp': 'noon' is not a time"));
  EXPECT_TRUE(contains(row("a,0,1,9999999999,0,0,0,0,0,0,1"), "line 3: column 'stamp': '9999999999' s is too large"));
  EXPECT_TRUE(contains(row("a,0,1,2,0,0,0,0,0,0,2"), "line 3: columns 'qx' to 'qw': length 2"));
  EXPECT_EQ(row("\"a,0,1,2,0,0,0,0,0,0,1"), "line 3: a quoted field does not end");
  EXPECT_EQ(row("a\"b,0,1,2,0,0,0,0,0,0,1"), "line 3: a quote in the middle of a field");
  EXPECT_EQ(row("\"two\nlines\",0,1,2,0,0,0,0,0,0"), "line 3: 10 fields, the header has 11");
  EXPECT_TRUE(contains(message(""), "line 1: the file is empty"));
  EXPECT_EQ(message(kTruthHeader + ",colour\n"), "line 1: unknown column 'colour'");
  EXPECT_EQ(message(kTruthHeader + ",tx\n"), "line 1: column 'tx' is there twice");
  EXPECT_EQ(message("scan_id,stack,slice,stamp,tx,ty,tz,qx,qy,qz\n"), "line 1: column 'qw' is missing");
  EXPECT_EQ(message(kTruthHeader + ",head_tx\n"), "line 1: columns 'head_tx' to 'head_qw' must all be there, or none");
  EXPECT_MESSAGE(read_pose_table(path("none.csv")), path("none.csv").string() + ": cannot be read");
}

TEST_F(Tables, UpdatesAreExactlyAsDescribed) {
  Journal journal;
  JournalEntry entry;
  entry.info.stack = 2;
  entry.info.index = 5;
  entry.info.stamp_ns = 1200000000;
  entry.sequence_length = 3;
  entry.revision = 4;
  entry.latency_ms = 1.23456;
  entry.volume_latency_ms = kNan;
  entry.decision_latency_ms = 7.5;
  entry.device = "cpu";
  entry.T_brain_slice.translation() << 1., 2., 3.;
  entry.start = "prediction";
  entry.radius_95_mm = 0.5;
  journal.add(entry);
  entry.start = "";
  entry.radius_95_mm = kNan;
  entry.status = ArrivalStatus::bad_image;
  entry.reason = "pixel is nan, must be \"finite\"";
  journal.add(entry);
  write_update_table(path("updates.csv"), journal);
  EXPECT_EQ(read(path("updates.csv")),
            "stamp,stack,slice,sequence_length,revision,latency_ms,encoded,device,tx,ty,tz,qx,qy,qz,qw,status,reason,"
            "volume_latency_ms,decision_latency_ms,start,radius_95_mm\n"
            "1.200000000,2,5,3,4,1.235,0,cpu,1,2,3,0,0,0,1,accepted,,nan,7.500,prediction,0.5\n"
            "1.200000000,2,5,3,4,1.235,0,cpu,nan,nan,nan,nan,nan,nan,nan,bad_image,"
            "\"pixel is nan, must be \"\"finite\"\"\",nan,7.500,,nan\n");
}

TEST_F(Tables, NamesTheFileThatCannotBeWritten) {
  EXPECT_MESSAGE(write_pose_table(path("none/poses.csv"), Estimate()), path("none/poses.csv").string());
  EXPECT_MESSAGE(write_update_table(path("none/updates.csv"), Journal()), path("none/updates.csv").string());
}

}  // namespace
}  // namespace svort
