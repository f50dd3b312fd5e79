#include "svort_ros/decision/decision_engine.h"

#include <algorithm>
#include <map>
#include <sstream>
#include <utility>

namespace svort {
namespace {

constexpr int kFewestSlicesOfAStack = 5;  // fewer are repeats, not a stack of the protocol

/// Stacks of the protocol whose slices have all been answered, or that a later one has followed.
int stacks_done(const Estimate& estimate, const std::vector<std::pair<int, int>>& answered) {
  std::vector<std::pair<int, int>> stacks;  // number and slices, by first acquisition
  for (const SliceEstimate& slice : estimate.slices) {
    const std::pair<int, int> stack(slice.info.stack, slice.info.slices_in_stack);
    if (stack.second >= kFewestSlicesOfAStack && std::find(stacks.begin(), stacks.end(), stack) == stacks.end())
      stacks.push_back(stack);
  }
  if (stacks.empty()) return 0;
  const auto [last, slices] = stacks.back();
  bool whole = true;
  for (int index = 0; index < slices; ++index) {
    const auto slice = std::make_pair(last, index);
    whole = whole && std::find(answered.begin(), answered.end(), slice) != answered.end();
  }
  return static_cast<int>(stacks.size()) - (whole ? 0 : 1);
}

/// Every option as text, by its full name.
class OptionLister {
 public:
  OptionLister(std::map<std::string, std::string>* list, std::string prefix)
      : list_(list), prefix_(std::move(prefix)) {}

  template <class Value>
  void operator()(const std::string& key, Value& value, const char* /*help*/) {
    std::ostringstream text;
    text << std::boolalpha << value;
    (*list_)[prefix_ + key] = text.str();
  }
  template <class Options>
  void section(const std::string& key, Options& options) {
    options.visit(OptionLister(list_, prefix_ + key + "."));
  }

 private:
  std::map<std::string, std::string>* list_;
  std::string prefix_;
};

/// "reacquisition.budget_s 60 -> 30", for the audit log.
std::string changes(DecisionOptions before, DecisionOptions after) {
  std::map<std::string, std::string> a, b;
  before.visit(OptionLister(&a, ""));
  after.visit(OptionLister(&b, ""));
  std::string text;
  for (const auto& [name, value] : b)
    if (a.at(name) != value) text += (text.empty() ? "" : "; ") + name + " " + a.at(name) + " -> " + value;
  return text;
}

}  // namespace

void validate(const DecisionOptions& options) {
  validate(options.motion);
  validate(options.quality);
  validate(options.coverage);
  validate(options.reacquisition);
}

DecisionEngine::DecisionEngine(const DecisionOptions& options)
    : options_(options), quality_(options.quality), planner_(options.reacquisition) {
  validate(options);
}

bool DecisionEngine::update(const LivePipeline& pipeline) {
  const Estimate& estimate = pipeline.estimate();
  if (estimate.slices.empty() || (!records_.empty() && estimate.revision == revision_)) return false;
  revision_ = estimate.revision;

  // The head's radius comes from the brain's volume, which the slices' poses show: that of the last update serves.
  motion_ = measure_motion(estimate, coverage_.brain_mm3, options_.motion);
  quality_.update(pipeline.sequence(), estimate, pipeline.volume(), motion_.head_radius_mm);
  PlannerInput input;
  for (const JournalEntry& entry : pipeline.journal().entries())
    if (is_kept(entry.status) || entry.status == ArrivalStatus::empty_mask)
      input.answered.emplace_back(entry.info.stack, entry.info.index);
  coverage_ = measure_coverage(estimate, quality_, stacks_done(estimate, input.answered), options_.coverage);

  input.estimate = &estimate;
  input.quality = &quality_;
  input.coverage = &coverage_;
  input.motion = &motion_;
  input.accept = options_.quality.accept;
  input.coverage_options = options_.coverage;
  planner_.update(input);

  DecisionRecord record;
  record.stamp_ns = estimate.slices.back().info.stamp_ns;
  record.revision = estimate.revision;
  record.frame_revision = estimate.frame_revision;
  record.slices = estimate.slices.size();
  const SliceEstimate* newest = pipeline.newest();
  for (const SliceQuality& quality : quality_.slices())
    if (newest && quality.stack == newest->info.stack && quality.index == newest->info.index) record.newest = quality;
  record.accepted = record.newest.score >= options_.quality.accept;
  record.motion = motion_.motion;
  if (const HeadMotion* head = motion_.now()) record.head = *head;
  record.window_displacement_mm = motion_.window_displacement_mm;
  record.coverage = coverage_.mean_score;
  record.seen_well = coverage_.seen_well;
  record.complete = coverage_.complete;
  record.completion = planner_.completion();
  record.budget_left_s = planner_.budget_left_s();
  record.waiting = planner_.waiting();
  record.options_version = options_version_;
  records_.push_back(record);
  return true;
}

void DecisionEngine::set_options(const DecisionOptions& options) {
  validate(options);
  quality_.set_options(options.quality);
  planner_.set_options(options.reacquisition);
  planner_.note("options", changes(options_, options));
  options_ = options;
  ++options_version_;
}

void DecisionEngine::clear() {
  motion_ = MotionReport();
  quality_.clear();
  coverage_ = CoverageMap();
  planner_.clear();
  records_.clear();
  revision_ = 0;
}

}  // namespace svort
