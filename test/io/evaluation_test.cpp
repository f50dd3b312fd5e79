#include "svort_ros/io/evaluation.h"

#include <cmath>

#include "io/scratch.h"

namespace svort {
namespace {

using EvaluationFile = Scratch;

std::vector<PoseRow> some_truth(const std::string& scan_id, int stacks) {
  std::vector<PoseRow> rows;
  for (int stack = 0; stack < stacks; ++stack)
    for (int slice = 0; slice < 4; ++slice) {
      PoseRow row;
      row.scan_id = scan_id;
      row.stack = stack;
      row.slice = slice;
      row.T_brain_slice.linear() =
          Eigen::AngleAxisd(0.3 * slice + stack, Eigen::Vector3d(1., 0.5 * stack, -0.2).normalized())
              .toRotationMatrix();
      row.T_brain_slice.translation() << 2. * slice, -3. * stack, 5.;
      rows.push_back(row);
    }
  return rows;
}

template <class Action>
std::string error_of(const Action& action) {
  try {
    action();
  } catch (const std::runtime_error& error) {
    return error.what();
  }
  return "no error";
}

TEST_F(EvaluationFile, ScoresAShiftedStack) {
  const std::vector<PoseRow> truth = some_truth("a", 2);
  std::vector<PoseRow> poses = truth;
  Pose frame = Pose::Identity();
  frame.translation() << 0., 30., 40.;  // the method's own frame: 50 mm away
  for (PoseRow& row : poses) row.T_brain_slice = frame * row.T_brain_slice;
  poses.pop_back();  // one slice was rejected
  const Evaluation evaluation = evaluate_poses(poses, truth, {}, "poses.csv", "truth.csv");
  EXPECT_EQ(evaluation.missing, 1U);
  ASSERT_EQ(evaluation.scores.size(), 3U);
  EXPECT_EQ(evaluation.scores[0].stack, -1);
  EXPECT_EQ(evaluation.scores[0].slices, 7U);
  EXPECT_EQ(evaluation.scores[2].slices, 3U);
  for (const PoseScore& score : evaluation.scores) {
    EXPECT_NEAR(score.ed.mean, 50., 1e-9);
    EXPECT_NEAR(score.gd.maximum, 0., 1e-9);
    EXPECT_NEAR(score.relative_ed.maximum, 0., 1e-9);
  }
  EXPECT_NE(to_markdown(evaluation).find("| a | all | 7 | 50.00 (0.00), median 50.00 |"), std::string::npos)
      << to_markdown(evaluation);
  EXPECT_NE(to_csv(evaluation).find("a,1,3,50,"), std::string::npos) << to_csv(evaluation);
}

TEST_F(EvaluationFile, EachScanHasItsOwnFrame) {
  std::vector<PoseRow> truth = some_truth("a", 1);
  const std::vector<PoseRow> b = some_truth("b", 1);
  truth.insert(truth.end(), b.begin(), b.end());
  std::vector<PoseRow> poses = truth;
  for (PoseRow& row : poses) {
    Pose frame = Pose::Identity();
    frame.translation().x() = row.scan_id == "a" ? 10. : -10.;
    row.T_brain_slice = frame * row.T_brain_slice;
  }
  for (const PoseScore& score : evaluate_poses(poses, truth, {}, "p", "t").scores)
    EXPECT_NEAR(score.relative_ed.maximum, 0., 1e-9) << score.scan_id;
}

TEST_F(EvaluationFile, ErrorsNameFileAndSlice) {
  const std::vector<PoseRow> truth = some_truth("a", 1);
  std::vector<PoseRow> poses = truth;
  poses[1].slice = 9;
  EXPECT_EQ(error_of([&] { evaluate_poses(poses, truth, {}, "p.csv", "t.csv"); }),
            "p.csv: slice 9 of stack 0 of scan 'a' is not in t.csv");
  poses[1].slice = 0;
  EXPECT_EQ(error_of([&] { evaluate_poses(poses, truth, {}, "p.csv", "t.csv"); }),
            "p.csv: slice 0 of stack 0 of scan 'a' is there twice");
  EXPECT_EQ(error_of([&] { evaluate_poses({}, truth, {}, "p.csv", "t.csv"); }), "p.csv: holds no slice");
}

TEST_F(EvaluationFile, TruthTableComesBack) {
  std::vector<PoseRow> truth = some_truth("scan, 1", 2);
  truth[2].displaced = truth[3].voided = truth[4].noisy = true;
  truth[5].stamp_ns = 12000000001;
  write_truth_table(path("truth.csv"), truth);
  const std::vector<PoseRow> back = read_pose_table(path("truth.csv"));
  ASSERT_EQ(back.size(), truth.size());
  for (std::size_t i = 0; i < truth.size(); ++i) {
    EXPECT_EQ(back[i].scan_id, truth[i].scan_id);
    EXPECT_TRUE(back[i].T_brain_slice.isApprox(truth[i].T_brain_slice, 1e-12));
    EXPECT_EQ(back[i].stamp_ns, truth[i].stamp_ns);
    EXPECT_EQ(back[i].displaced, truth[i].displaced);
    EXPECT_EQ(back[i].voided, truth[i].voided);
    EXPECT_EQ(back[i].noisy, truth[i].noisy);
  }
  std::string text = read(path("truth.csv"));
  EXPECT_EQ(text.substr(0, text.find('\n')), "scan_id,stack,slice,stamp,tx,ty,tz,qx,qy,qz,qw,displaced,void,noisy");
  text.replace(text.rfind("0\n"), 2, "2\n");
  EXPECT_NE(error_of([&] { read_pose_table(write("bad.csv", text)); }).find("column 'noisy': '2' is not 0 or 1"),
            std::string::npos);
}

TEST_F(EvaluationFile, ProgramSaysWhatIsWrong) {
  const auto run = [](std::vector<std::string> words) {
    std::vector<char*> argv;
    for (std::string& word : words) argv.push_back(word.data());
    return run_svort_evaluate(static_cast<int>(argv.size()), argv.data());
  };
  EXPECT_EQ(run({"svort_evaluate", "--help"}), 0);
  EXPECT_EQ(run({"svort_evaluate"}), 2);
  EXPECT_EQ(run({"svort_evaluate", "--poses", path("none.csv").string(), "--truth", path("none.csv").string()}), 2);
  EXPECT_EQ(run({"svort_evaluate", "--table", path("none.yaml").string(), "--output", path("out").string()}), 2);
  EXPECT_EQ(run({"svort_evaluate", "--table", path("none.yaml").string(), "--poses", path("none.csv").string()}), 2);
}

}  // namespace
}  // namespace svort
