#include "svort_ros/io/closed_loop.h"

#include <torch/types.h>

#include <Eigen/Geometry>
#include <algorithm>
#include <cmath>
#include <cstdio>
#include <map>
#include <set>
#include <sstream>

#include "svort_ros/geometry/rigid_transform.h"
#include "svort_ros/metrics/pose_error.h"

namespace svort {
namespace {

constexpr int kStacks = 3;
constexpr int kFirstRepeat = 100;  // stack number of the first repeated slice

/// Scanner, pipeline and decisions of one scan.
class Loop {
 public:
  Loop(const BrainVolume& brain, const std::string& motion, std::uint64_t seed, const ClosedLoopOptions& options)
      : options_(options),
        scanner_(brain, motion, options.scanner, seed),
        pipeline_(options.pipeline),
        engine_(options.decision) {}

  InteractiveScanner& scanner() { return scanner_; }
  LivePipeline& pipeline() { return pipeline_; }
  DecisionEngine& engine() { return engine_; }
  int slices() const { return slices_; }
  int repeats() const { return repeats_; }

  void acquire(const Pose& T_scanner_slice, int stack, int index, int slices_in_stack, bool decide) {
    const Slice slice = scanner_.acquire(T_scanner_slice, stack, index, slices_in_stack);
    ++slices_;
    const Arrival arrival = pipeline_.add(slice);
    JournalEntry entry;
    entry.info = slice.info;
    entry.status = arrival.status;
    pipeline_.journal().add(entry);
    if (!is_kept(arrival.status)) return;
    truth_[{stack, index}] = scanner_.true_T_brain_slice();
    if (!decide) return;
    pipeline_.update_volume();
    engine_.update(pipeline_);
  }

  void repeat(const Pose& T_scanner_slice, bool decide) {
    ++repeats_;
    acquire(T_scanner_slice, kFirstRepeat + repeats_, 0, 1, decide);
  }

  /// The planner's wishes, most urgent first, until there are none or the time for them is used up.
  void obey() {
    for (auto waiting = engine_.planner().waiting(); !waiting.empty(); waiting = engine_.planner().waiting()) {
      const ReacquisitionRequest request = waiting.front();
      // The planner gives the time of a veto back, but here it was spent.
      if (spent_s_ + request.cost_s > options_.decision.reacquisition.budget_s) return;
      spent_s_ += request.cost_s;
      scanner_.wait(options_.decision.reacquisition.overhead_s);
      repeat(request.T_scanner_slice, true);
      // If the head has moved on, the slice shows another plane; the scanner does not try for ever.
      for (const ReacquisitionRequest& left : engine_.planner().waiting())
        if (left.id == request.id) engine_.veto(left.id, "acquired, but it came out elsewhere");
    }
  }

  /// Which slices of a stack look bad, from the images alone.
  std::vector<int> bad_slices(int stack) {
    QualityMonitor monitor(options_.decision.quality);
    std::vector<int> bad;
    for (const SliceQuality& quality : monitor.update(pipeline_.sequence(), pipeline_.estimate(), Volume(), 40.))
      if (quality.stack == stack && quality.image_score < options_.decision.quality.accept)
        bad.push_back(quality.index);
    return bad;
  }

  void score(ClosedLoopResult* result) const;

 private:
  const ClosedLoopOptions& options_;
  InteractiveScanner scanner_;
  LivePipeline pipeline_;
  DecisionEngine engine_;
  std::map<std::pair<int, int>, Pose> truth_;
  int slices_ = 0;
  int repeats_ = 0;
  double spent_s_ = 0.;  ///< on requests
};

/// Trilinear value at a position in the volume's frame; 0 outside.
double sample(const Volume& volume, const Eigen::Vector3d& position) {
  const Eigen::Vector3d index = volume.grid.index(position), floor = index.array().floor();
  double value = 0.;
  for (int corner = 0; corner < 8; ++corner) {
    const Eigen::Vector3i offset(corner & 1, (corner >> 1) & 1, (corner >> 2) & 1);
    const Eigen::Vector3i voxel = floor.cast<int>() + offset;
    if ((voxel.array() < 0).any() || (voxel.array() >= volume.grid.size.array()).any()) continue;
    double weight = 1.;
    for (int axis = 0; axis < 3; ++axis)
      weight *= offset[axis] ? index[axis] - floor[axis] : 1. - index[axis] + floor[axis];
    value += weight * static_cast<double>(volume.values[volume.grid.offset(voxel.x(), voxel.y(), voxel.z())]);
  }
  return value;
}

void Loop::score(ClosedLoopResult* result) const {
  std::vector<torch::Tensor> estimated, truth;
  for (const SliceEstimate& slice : pipeline_.estimate().slices) {
    if (!(slice.weight > 0.)) continue;
    estimated.push_back(tensor_from_pose(slice.T_brain_slice));
    truth.push_back(tensor_from_pose(truth_.at({slice.info.stack, slice.info.index})));
  }
  AnchorFrame frame;
  frame.width = frame.height = options_.scanner.size_px;
  frame.resolution = options_.scanner.pixel_mm;
  const torch::Tensor a = torch::cat(estimated), b = torch::cat(truth);
  result->pose_error_mm = relative_pose_errors(a, b, frame).ed.mean().item<double>();
  const Pose T_estimate_truth = global_alignment(a, b, frame).inverse();

  const Volume& brain = scanner_.truth();
  double xx = 0., xy = 0., yy = 0.;
  for (int k = 0; k < brain.grid.size.z(); ++k)
    for (int j = 0; j < brain.grid.size.y(); ++j)
      for (int i = 0; i < brain.grid.size.x(); ++i) {
        const std::size_t at = brain.grid.offset(i, j, k);
        if (!scanner_.truth_mask()[at]) continue;
        const double y = static_cast<double>(brain.values[at]);
        const double x =
            sample(pipeline_.volume(), T_estimate_truth * brain.grid.position({double(i), double(j), double(k)}));
        xx += x * x;
        xy += x * y;
        yy += y * y;
      }
  // With the best gain g = xy / xx: |g x - y|^2 = yy - xy^2 / xx.
  result->volume_error = xx > 0. ? std::sqrt(std::max(0., yy - xy * xy / xx) / yy) : 1.;
}

struct Spread {
  double mean = 0., deviation = 0.;
};
template <class Value>
Spread spread_of(const std::vector<const ClosedLoopResult*>& results, const Value& value) {
  Spread spread;
  const auto n = static_cast<double>(results.size());
  for (const ClosedLoopResult* result : results) spread.mean += value(*result) / n;
  for (const ClosedLoopResult* result : results) spread.deviation += std::pow(value(*result) - spread.mean, 2.);
  spread.deviation = results.size() > 1 ? std::sqrt(spread.deviation / (n - 1.)) : 0.;
  return spread;
}

std::string fixed(double value, int decimals) {
  char text[64];
  std::snprintf(text, sizeof text, "%.*f", decimals, value);
  return text;
}

}  // namespace

const char* to_string(RepeatStrategy strategy) {
  switch (strategy) {
    case RepeatStrategy::none:
      return "none";
    case RepeatStrategy::whole_stacks:
      return "whole_stacks";
    case RepeatStrategy::end_of_stack:
      return "end_of_stack";
    case RepeatStrategy::requests:
      return "requests";
  }
  return "unknown";
}

ClosedLoopOptions::ClosedLoopOptions() {
  scanner.size_px = pipeline.sequence.size_px = 40;
  scanner.pixel_mm = pipeline.sequence.resolution_mm = 3.;
  scanner.thickness_mm = 4.5;
  pipeline.estimator.volume_resolution_mm = 3.;
  pipeline.estimator.registration.finest_mm = 3.;
  decision.reacquisition.dry_run = false;
}

ClosedLoopResult run_closed_loop(const BrainVolume& brain, const std::string& motion, std::uint64_t seed,
                                 RepeatStrategy strategy, const ClosedLoopOptions& options) {
  Loop loop(brain, motion, seed, options);
  const bool decide = strategy == RepeatStrategy::requests;
  const auto run_stack = [&](int number) {
    const StackPrescription stack = loop.scanner().plan(number);
    for (const int index : interleaved_order(stack.slices, options.scanner.interleave)) {
      loop.acquire(stack.slice(index, options.scanner.thickness_mm), number, index, stack.slices, decide);
      if (decide) loop.obey();
    }
    if (strategy == RepeatStrategy::end_of_stack)
      for (const int index : loop.bad_slices(number))
        loop.repeat(stack.slice(index, options.scanner.thickness_mm), false);
    return stack;
  };
  std::vector<StackPrescription> stacks;
  for (int number = 0; number < kStacks; ++number) stacks.push_back(run_stack(number));
  int repeated = loop.repeats();
  if (strategy == RepeatStrategy::whole_stacks)
    for (int number = 0; number < kStacks; ++number) {
      const auto bad = static_cast<double>(loop.bad_slices(number).size());
      const int slices = stacks[static_cast<std::size_t>(number)].slices;
      if (bad < options.repeat_stack_share * slices) continue;
      repeated += run_stack(number + kStacks).slices;
    }

  ClosedLoopResult result;
  result.motion = motion;
  result.seed = seed;
  result.strategy = strategy;
  result.scan_s = loop.scanner().time_s();
  result.slices = loop.slices();
  result.repeats = std::max(repeated, loop.repeats());
  loop.pipeline().finalise();
  loop.engine().update(loop.pipeline());
  result.complete = loop.engine().coverage().complete;
  loop.score(&result);
  return result;
}

std::string to_csv(const std::vector<ClosedLoopResult>& results) {
  std::ostringstream csv;
  csv << "motion,seed,strategy,scan_s,slices,repeats,volume_error,pose_error_mm,complete\n";
  for (const ClosedLoopResult& r : results)
    csv << r.motion << ',' << r.seed << ',' << to_string(r.strategy) << ',' << fixed(r.scan_s, 3) << ',' << r.slices
        << ',' << r.repeats << ',' << fixed(r.volume_error, 6) << ',' << fixed(r.pose_error_mm, 4) << ','
        << fixed(r.complete, 4) << '\n';
  return csv.str();
}

std::string to_markdown(const std::vector<ClosedLoopResult>& results) {
  std::vector<std::pair<std::string, RepeatStrategy>> groups;
  for (const ClosedLoopResult& result : results)
    if (const std::pair<std::string, RepeatStrategy> group(result.motion, result.strategy);
        std::find(groups.begin(), groups.end(), group) == groups.end())
      groups.push_back(group);
  std::ostringstream text;
  text << "| motion | strategy | scans | scan time, s | repeats | volume error | pose error, mm | complete |\n"
       << "|---|---|---|---|---|---|---|---|\n";
  for (const auto& [motion, strategy] : groups) {
    std::vector<const ClosedLoopResult*> members;
    for (const ClosedLoopResult& result : results)
      if (result.motion == motion && result.strategy == strategy) members.push_back(&result);
    const auto cell = [&](const auto& value, int decimals) {
      const Spread spread = spread_of(members, value);
      return fixed(spread.mean, decimals) + " (" + fixed(spread.deviation, decimals) + ")";
    };
    text << "| " << motion << " | " << to_string(strategy) << " | " << members.size() << " | "
         << cell([](const ClosedLoopResult& r) { return r.scan_s; }, 0) << " | "
         << cell([](const ClosedLoopResult& r) { return static_cast<double>(r.repeats); }, 1) << " | "
         << cell([](const ClosedLoopResult& r) { return r.volume_error; }, 3) << " | "
         << cell([](const ClosedLoopResult& r) { return r.pose_error_mm; }, 2) << " | "
         << cell([](const ClosedLoopResult& r) { return r.complete; }, 2) << " |\n";
  }
  text << "\nMean (standard deviation over scans).\n";
  return text.str();
}

}  // namespace svort
