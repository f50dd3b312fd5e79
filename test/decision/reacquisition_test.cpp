#include <gtest/gtest.h>

#include <algorithm>
#include <cmath>
#include <functional>
#include <set>

#include "decision/decision_fixture.h"
#include "svort_ros/decision/decision_engine.h"

namespace svort {
namespace {

using svort_test::ScanSlice;

DecisionOptions plain() {
  DecisionOptions options;
  options.quality = svort_test::plain_quality();
  options.reacquisition.confirm_updates = 1;
  return options;
}

struct Scan {
  explicit Scan(const DecisionOptions& options = plain()) : pipeline(svort_test::quick_pipeline()), engine(options) {}
  void add(const ScanSlice& slice) { svort_test::feed(svort_test::make_slice(slice), &pipeline, &engine); }
  LivePipeline pipeline;
  DecisionEngine engine;
};

/// Three stacks; slices for which `come` is false never do.
void play(Scan* scan, const std::function<bool(ScanSlice&)>& come, int stacks = 3) {
  for (int stack = 0; stack < stacks; ++stack)
    for (ScanSlice slice : svort_test::whole_stack(stack, stack, 30. * stack))
      if (come(slice)) scan->add(slice);
}

DecisionOptions demanding() {
  DecisionOptions options = plain();  // every place in all three stacks, so that one slice that is missing counts
  options.coverage.views = 2.6;
  options.coverage.sharp_views = 1.6;
  options.quality.intercept = 50.;
  options.reacquisition.least_gain = 0.01;
  return options;
}

std::vector<std::string> events(const DecisionEngine& engine) {
  std::vector<std::string> names;
  for (const PlannerEvent& event : engine.planner().events()) names.push_back(event.event);
  return names;
}

TEST(Planner, AsksForWhatIsMissingWhereItIsNow) {
  Scan scan(demanding());
  play(&scan, [](ScanSlice& slice) { return slice.stack != 2 || slice.index < 7 || slice.index > 8; });
  const auto waiting = scan.engine.planner().waiting();
  ASSERT_GE(waiting.size(), 2U);
  std::vector<int> asked;
  for (const ReacquisitionRequest& request : waiting) {
    EXPECT_EQ(request.state, RequestState::proposed);  // dry run
    EXPECT_NEAR(request.cost_s, svort_test::kTrS + 0.5, 1e-9);
    if (request.stack != 2 || !request.again) continue;
    asked.push_back(request.index);
    EXPECT_EQ(request.reasons, std::vector<std::string>{"missing"});
    // The head rests: the slice is where the scanner would have taken it.
    ScanSlice same;
    same.stack = same.plane = 2;
    same.index = request.index;
    const Pose prescribed = svort_test::make_slice(same).info.T_scanner_slice;
    EXPECT_TRUE(request.T_scanner_slice.isApprox(prescribed, 1e-6));
  }
  std::sort(asked.begin(), asked.end());
  EXPECT_EQ(asked, (std::vector<int>{7, 8}));
  EXPECT_EQ(waiting[0].rank, 1);
  EXPECT_GE(waiting[0].gain / waiting[0].cost_s, waiting[1].gain / waiting[1].cost_s);
}

TEST(Planner, AsksDuringTheStackButNotForWhatIsComing) {
  Scan scan(demanding());
  std::set<int> came;
  bool asked_while_running = false;
  for (const ScanSlice& slice : svort_test::whole_stack(0, 0, 0.)) {
    if (slice.index == 6) continue;  // passed over in the first round of the interleave
    scan.add(slice);
    came.insert(slice.index);
    for (const ReacquisitionRequest& request : scan.engine.planner().waiting()) {
      if (!request.again) continue;
      EXPECT_TRUE(request.index == 6 || came.count(request.index)) << "slice " << request.index << " is still to come";
      if (request.index != 6 || slice.index == 15) continue;
      asked_while_running = true;
      EXPECT_EQ(request.reasons, std::vector<std::string>{"missing"});
    }
  }
  EXPECT_TRUE(asked_while_running);
}

TEST(Planner, ASpoiltSliceIsAskedForAgainWithItsReasonAndRequestsAreFulfilled) {
  DecisionOptions options = demanding();
  options.quality = svort_test::plain_quality();
  Scan scan(options);
  play(&scan, [](ScanSlice& slice) {
    if (slice.stack == 1 && slice.index == 8) slice.gain = 0.15;
    return true;
  });
  const auto& requests = scan.engine.planner().requests();
  const auto again = std::find_if(requests.begin(), requests.end(), [](const ReacquisitionRequest& request) {
    return request.stack == 1 && request.index == 8;
  });
  ASSERT_NE(again, requests.end());
  EXPECT_TRUE(again->again);
  EXPECT_NE(std::find(again->reasons.begin(), again->reasons.end(), "dark"), again->reasons.end());

  const auto waiting = scan.engine.planner().waiting();
  const auto wish =
      std::find_if(waiting.begin(), waiting.end(), [](const ReacquisitionRequest& request) { return request.again; });
  ASSERT_NE(wish, waiting.end());
  ScanSlice repeat;  // the head rests, so the prescription is where it was
  repeat.stack = 50;
  repeat.plane = wish->stack;
  repeat.index = wish->index;
  repeat.time_s = 120.;
  scan.add(repeat);
  EXPECT_EQ(scan.engine.planner().requests()[static_cast<std::size_t>(wish->id - 1)].state, RequestState::fulfilled);
  const auto names = events(scan.engine);
  EXPECT_NE(std::find(names.begin(), names.end(), "fulfilled"), names.end());
}

TEST(Planner, PlannedSlicesMoveWithTheHead) {
  Scan scan(demanding());
  play(&scan, [](ScanSlice& slice) { return slice.stack != 2 || slice.index != 7; });
  ASSERT_FALSE(scan.engine.planner().waiting().empty());
  const ReacquisitionRequest before = scan.engine.planner().waiting().front();

  // The same estimate, but the head has turned at the newest slice.
  Pose turn = Pose::Identity();
  turn.linear() = Eigen::AngleAxisd(0.3, Eigen::Vector3d::UnitX()).toRotationMatrix();
  turn.translation() << 4., 0., 0.;
  Estimate estimate = scan.pipeline.estimate();
  estimate.slices.back().T_scanner_brain = turn * estimate.slices.back().T_scanner_brain;
  ++estimate.revision;
  QualityMonitor quality(demanding().quality);
  quality.update(scan.pipeline.sequence(), estimate, scan.pipeline.volume(), 30.);
  const CoverageMap map = measure_coverage(estimate, quality, 3, demanding().coverage);
  const MotionReport motion = measure_motion(estimate, map.brain_mm3, {});
  ReacquisitionPlanner planner(demanding().reacquisition);
  PlannerInput input;
  input.estimate = &estimate;
  input.quality = &quality;
  input.coverage = &map;
  input.motion = &motion;
  input.coverage_options = demanding().coverage;
  for (int stack = 0; stack < 3; ++stack)
    for (int index = 0; index < 16; ++index) input.answered.emplace_back(stack, index);
  planner.update(input);
  ASSERT_FALSE(planner.waiting().empty());
  const ReacquisitionRequest after = planner.waiting().front();
  EXPECT_EQ(after.index, before.index);
  EXPECT_TRUE(after.T_brain_slice.isApprox(before.T_brain_slice, 1e-6));
  const Pose head = scan.pipeline.estimate().slices.back().T_scanner_brain;
  EXPECT_TRUE(after.T_scanner_slice.isApprox(turn * head * before.T_brain_slice, 1e-6));
}

TEST(Planner, RequestsFollowAStepOfTheBrainFrame) {
  Scan scan(demanding());
  play(&scan, [](ScanSlice& slice) { return slice.stack != 2 || slice.index != 7; });
  Estimate estimate = scan.pipeline.estimate();
  QualityMonitor quality(demanding().quality);
  ReacquisitionPlanner planner(demanding().reacquisition);
  PlannerInput input;
  input.estimate = &estimate;
  input.quality = &quality;
  input.coverage_options = demanding().coverage;
  for (int stack = 0; stack < 3; ++stack)
    for (int index = 0; index < 16; ++index) input.answered.emplace_back(stack, index);
  const auto update = [&] {
    quality.update(scan.pipeline.sequence(), estimate, Volume(), 30.);
    const CoverageMap map = measure_coverage(estimate, quality, 3, input.coverage_options);
    const MotionReport motion = measure_motion(estimate, map.brain_mm3, {});
    input.coverage = &map;
    input.motion = &motion;
    planner.update(input);
  };
  update();
  const auto before = planner.waiting();
  ASSERT_FALSE(before.empty());
  Pose T_new_old = Pose::Identity();
  T_new_old.linear() = Eigen::AngleAxisd(1., Eigen::Vector3d(1., 2., -1.).normalized()).toRotationMatrix();
  T_new_old.translation() << 5., -7., 2.;
  for (SliceEstimate& slice : estimate.slices) {
    slice.T_brain_slice = T_new_old * slice.T_brain_slice;
    slice.T_scanner_brain = slice.T_scanner_brain * T_new_old.inverse();
  }
  ++estimate.revision;
  update();
  for (const ReacquisitionRequest& old : before)
    for (const ReacquisitionRequest& request : planner.requests()) {
      if (request.id != old.id) continue;
      EXPECT_TRUE(request.T_scanner_slice.isApprox(old.T_scanner_slice, 1e-6));  // the head did not move
      EXPECT_TRUE(request.T_brain_slice.isApprox(T_new_old * old.T_brain_slice, 1e-6));
    }
}

TEST(Planner, VetoBudgetAndDelayHold) {
  const auto gap = [](ScanSlice& slice) { return slice.stack != 2 || slice.index < 6 || slice.index > 9; };
  Scan scan(demanding());
  play(&scan, gap);
  const auto before = scan.engine.planner().waiting();
  ASSERT_GE(before.size(), 3U);
  EXPECT_EQ(scan.engine.veto(before[0].id, "no time"), 1);
  EXPECT_EQ(scan.engine.veto(before[0].id, "again"), 0);
  EXPECT_EQ(scan.engine.planner().events().back().detail, "no time");
  ScanSlice more;  // something that changes little, for another update
  more.stack = 70;
  more.time_s = 200.;
  more.index = 3;
  scan.add(more);
  for (const ReacquisitionRequest& request : scan.engine.planner().waiting()) {
    const double distance = std::abs(before[0].T_brain_slice.linear().col(2).dot(
        request.T_brain_slice.translation() - before[0].T_brain_slice.translation()));
    EXPECT_TRUE(request.stack != before[0].stack || distance > 2.) << "the vetoed plane is asked for again";
  }

  DecisionOptions options = demanding();
  options.reacquisition.budget_s = 2. * (svort_test::kTrS + options.reacquisition.overhead_s);
  Scan poor(options);
  play(&poor, gap);
  EXPECT_EQ(poor.engine.planner().waiting().size(), 2U);
  EXPECT_NEAR(poor.engine.planner().budget_left_s(), 0., 1e-9);
  const auto names = events(poor.engine);
  EXPECT_NE(std::find(names.begin(), names.end(), "over_budget"), names.end());

  // A slice that came out as badly as before is not asked for at once.
  options = demanding();
  options.quality = svort_test::plain_quality();
  Scan bad(options);
  play(&bad, [](ScanSlice& slice) {
    if (slice.stack == 1 && slice.index == 8) slice.gain = 0.15;
    return true;
  });
  const auto count_of_plane = [&bad] {
    return std::count_if(bad.engine.planner().requests().begin(), bad.engine.planner().requests().end(),
                         [](const ReacquisitionRequest& request) { return request.stack == 1 && request.index == 8; });
  };
  ASSERT_EQ(count_of_plane(), 1);
  ScanSlice repeat;
  repeat.stack = 50;
  repeat.plane = 1;
  repeat.index = 8;
  repeat.gain = 0.15;
  const double asked_s = 1e-9 * static_cast<double>(bad.engine.planner().requests().front().asked_ns - 1000000000);
  repeat.time_s = std::max(91., asked_s + 2.);
  bad.add(repeat);
  EXPECT_EQ(count_of_plane(), 1);
}

TEST(Planner, WhatIsWantedForAMomentIsNotAskedFor) {
  const auto first_request = [](int confirm) {
    DecisionOptions options = demanding();
    options.reacquisition.confirm_updates = confirm;
    Scan scan(options);
    play(&scan, [](ScanSlice& slice) { return slice.stack != 1 || slice.index < 6 || slice.index > 7; });
    for (const ReacquisitionRequest& request : scan.engine.planner().requests())
      if (request.stack == 1 && request.index == 6) return request.asked_ns;
    return std::int64_t{0};
  };
  const std::int64_t at_once = first_request(1), later = first_request(4);
  ASSERT_GT(at_once, 0);
  EXPECT_NEAR(1e-9 * static_cast<double>(later - at_once), 3. * svort_test::kTrS, 1e-6);  // three more slices
}

TEST(Planner, PredictsTheTimeToCompletion) {
  Scan scan;
  for (const ScanSlice& slice : svort_test::whole_stack(0, 0, 0.)) scan.add(slice);
  const Completion early = scan.engine.planner().completion();
  // Two more stacks; the last slice of the first one showed no brain, and so brought no new volume.
  EXPECT_EQ(early.slices, 33);
  EXPECT_NEAR(early.seconds, 33 * svort_test::kTrS, 1e-6);
  EXPECT_GT(early.yield, 0.5);
  Scan whole;
  play(&whole, [](ScanSlice&) { return true; });
  EXPECT_LT(whole.engine.planner().completion().slices, 6);
  DecisionOptions options = plain();
  options.quality.intercept = -50.;  // nothing is ever good
  Scan hopeless(options);
  play(&hopeless, [](ScanSlice&) { return true; });
  EXPECT_TRUE(std::isnan(hopeless.engine.planner().completion().seconds));
}

TEST(Engine, IsDeterministicAndRecordsItsInputs) {
  const auto run = [] {
    Scan scan(demanding());
    play(&scan, [](ScanSlice& slice) { return slice.stack != 2 || slice.index != 7; });
    return scan.engine.records();
  };
  const auto a = run(), b = run();
  ASSERT_EQ(a.size(), b.size());
  for (std::size_t i = 0; i < a.size(); ++i) {
    EXPECT_EQ(a[i].newest.score, b[i].newest.score);
    EXPECT_EQ(a[i].coverage, b[i].coverage);
    ASSERT_EQ(a[i].waiting.size(), b[i].waiting.size());
    for (std::size_t k = 0; k < a[i].waiting.size(); ++k)
      EXPECT_EQ(a[i].waiting[k].T_scanner_slice.matrix(), b[i].waiting[k].T_scanner_slice.matrix());
  }
  EXPECT_EQ(a.front().slices, 1U);
  EXPECT_EQ(a.back().motion, MotionClass::none);
}

TEST(Engine, ThresholdsChangeWhileItRuns) {
  Scan scan(demanding());
  play(&scan, [](ScanSlice& slice) { return slice.stack != 2 || slice.index < 6 || slice.index > 9; });
  EXPECT_FALSE(scan.engine.update(scan.pipeline));  // the same revision
  DecisionOptions options = scan.engine.options();
  options.reacquisition.open_requests = 0;
  options.coverage.views = -1.;
  EXPECT_THROW(scan.engine.set_options(options), std::invalid_argument);
  EXPECT_EQ(scan.engine.options().coverage.views, 2.6);
  options.coverage.views = 0.5;
  options.coverage.sharp_views = 0.2;
  scan.engine.set_options(options);
  EXPECT_EQ(scan.engine.planner().events().back().event, "options");
  EXPECT_EQ(scan.engine.planner().events().back().detail,
            "coverage.sharp_views 1.6 -> 0.2; coverage.views 2.6 -> 0.5; reacquisition.open_requests 8 -> 0");
  ScanSlice more;
  more.stack = 70;
  more.index = 8;
  more.time_s = 200.;
  scan.add(more);
  EXPECT_TRUE(scan.engine.planner().waiting().empty());  // what was wanted is no longer
  EXPECT_EQ(scan.engine.records().back().options_version, 1U);
  scan.engine.clear();
  EXPECT_TRUE(scan.engine.records().empty());
  EXPECT_TRUE(scan.engine.planner().requests().empty());
}

}  // namespace
}  // namespace svort
