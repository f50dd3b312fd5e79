#include "svort_ros/decision/reacquisition_planner.h"

#include <Eigen/Geometry>
#include <algorithm>
#include <cmath>
#include <limits>
#include <map>
#include <optional>
#include <queue>

#include "checks.h"

namespace svort {
namespace {

constexpr int kFewestSlicesOfAStack = 5;  // fewer are repeats, not a stack of the protocol
constexpr std::size_t kRecentSlices = 20;
constexpr double kLeastYield = 0.05;  // below, nothing can be expected of another slice
constexpr double kUsefulYield = 0.3;  // a request is ranked as if it came out at least so well
constexpr int kMostPlanned = 150;     // slices to completion, before the prediction gives up
constexpr double kSameOrientationDeg = 35.;
constexpr int kFarthestIndex = 60;  // planes beyond a stack's reference slice, on either side
constexpr double kProfileReach = 1.25;
constexpr double kDegree = M_PI / 180.;

/// A place of the brain in the plane of a candidate.
struct Place {
  std::size_t number = 0;
  double amount = 0.;
};

struct Candidate {
  int stack = 0;
  int index = 0;
  bool new_orientation = false;
  Pose T_brain_slice = Pose::Identity();
  double thickness_mm = 0.;
  std::vector<Place> places;
};

/// The geometry of a stack, in the brain frame: what it was meant to show, had the head stayed where it was at one
/// slice.
struct StackGeometry {
  int stack = 0;
  int slices = 0;
  double thickness_mm = 0.;
  Pose T_brain_reference = Pose::Identity();
  int reference = 0;
  Eigen::Vector3d step = Eigen::Vector3d::Zero();  ///< from index to index, brain frame, mm
  Eigen::Vector3d step_scanner = Eigen::Vector3d::Zero();
  Pose T_scanner_reference = Pose::Identity();

  Pose plane(int index) const {
    Pose pose = T_brain_reference;
    pose.translation() += (index - reference) * step;
    return pose;
  }
  Pose prescription(int index) const {
    Pose pose = T_scanner_reference;
    pose.translation() += (index - reference) * step_scanner;
    return pose;
  }
};

std::vector<StackGeometry> stacks_of(const Estimate& estimate) {
  std::map<int, std::vector<const SliceEstimate*>> members;
  std::vector<int> order;  // by first acquisition
  for (const SliceEstimate& slice : estimate.slices) {
    if (slice.info.slices_in_stack < kFewestSlicesOfAStack) continue;
    if (!members.count(slice.info.stack)) order.push_back(slice.info.stack);
    members[slice.info.stack].push_back(&slice);
  }
  std::vector<StackGeometry> stacks;
  for (const int stack : order) {
    const auto& slices = members[stack];
    const SliceEstimate* reference = nullptr;
    double best = std::numeric_limits<double>::infinity();
    const double middle = 0.5 * (slices.front()->info.slices_in_stack - 1);
    for (const SliceEstimate* slice : slices) {
      const double distance = std::abs(slice->info.index - middle) + (slice->weight > 0. ? 0. : 1e6);
      if (distance < best) {
        best = distance;
        reference = slice;
      }
    }
    StackGeometry geometry;
    geometry.stack = stack;
    geometry.slices = reference->info.slices_in_stack;
    geometry.thickness_mm = reference->info.thickness;
    geometry.reference = reference->info.index;
    geometry.T_brain_reference = reference->T_brain_slice;
    geometry.T_scanner_reference = reference->info.T_scanner_slice;
    geometry.step_scanner = reference->info.T_scanner_slice.linear().col(2) * reference->info.thickness;
    const auto [low, high] = std::minmax_element(
        slices.begin(), slices.end(), [](const auto* a, const auto* b) { return a->info.index < b->info.index; });
    if ((*high)->info.index > (*low)->info.index)
      geometry.step_scanner =
          ((*high)->info.T_scanner_slice.translation() - (*low)->info.T_scanner_slice.translation()) /
          ((*high)->info.index - (*low)->info.index);
    geometry.step = reference->T_scanner_brain.linear().transpose() * geometry.step_scanner;
    stacks.push_back(geometry);
  }
  return stacks;
}

double angle_between_planes(const Pose& a, const Pose& b) {
  const double cosine = std::abs(a.linear().col(2).dot(b.linear().col(2)));
  return std::acos(std::min(1., cosine));
}

/// The places of the brain, once per update.
class Brain {
 public:
  explicit Brain(const CoverageMap& map) : count_(static_cast<double>(map.places)) {
    for (int k = 0; k < map.grid.size.z(); ++k)
      for (int j = 0; j < map.grid.size.y(); ++j)
        for (int i = 0; i < map.grid.size.x(); ++i) {
          const std::size_t at = map.grid.offset(i, j, k);
          if (!map.brain[at]) continue;
          positions_.push_back(map.grid.position({double(i), double(j), double(k)}));
          views_.push_back(map.views[at]);
        }
    for (const Eigen::Vector3d& position : positions_) centre_ += position / count_;
  }

  const std::vector<ViewTensor>& views() const { return views_; }
  const Eigen::Vector3d& centre() const { return centre_; }

  std::vector<Place> seen_by(const Pose& T_brain_slice, double thickness_mm) const {
    std::vector<Place> places;
    const Eigen::Vector3d normal = T_brain_slice.linear().col(2);
    const double offset = normal.dot(T_brain_slice.translation());
    for (std::size_t p = 0; p < positions_.size(); ++p) {
      const double z = normal.dot(positions_[p]) - offset;
      if (std::abs(z) <= kProfileReach * thickness_mm) places.push_back({p, profile_weight(z, thickness_mm)});
    }
    return places;
  }

  /// Rise of the brain's mean score if a slice of this quality came.
  double gain(const std::vector<ViewTensor>& views, const Candidate& candidate, double quality,
              const CoverageTarget& target) const {
    const Eigen::Vector3d normal = candidate.T_brain_slice.linear().col(2);
    double sum = 0.;
    for (const Place& place : candidate.places) {
      ViewTensor with = views[place.number];
      const double before = place_score(with, target);
      if (before >= 1.) continue;
      add_view(&with, normal, quality * place.amount);
      sum += place_score(with, target) - before;
    }
    return sum / count_;
  }

  static void acquire(std::vector<ViewTensor>* views, const Candidate& candidate, double quality) {
    const Eigen::Vector3d normal = candidate.T_brain_slice.linear().col(2);
    for (const Place& place : candidate.places) add_view(&(*views)[place.number], normal, quality * place.amount);
  }

 private:
  double count_ = 1.;
  std::vector<Eigen::Vector3d> positions_;
  std::vector<ViewTensor> views_;
  Eigen::Vector3d centre_ = Eigen::Vector3d::Zero();
};

/// Picks the candidate of the largest gain again and again. Gains mostly fall as others are picked, so only the top of
/// the queue is looked at again (lazy greedy).
template <class Wanted, class Picked>
void pick_greedily(const Brain& brain, const std::vector<Candidate>& candidates, double quality,
                   const CoverageTarget& target, double least_gain, std::vector<ViewTensor>* views,
                   const Wanted& wanted, const Picked& picked) {
  using Entry = std::pair<double, std::size_t>;
  const auto less = [](const Entry& a, const Entry& b) {
    return a.first < b.first || (a.first == b.first && a.second > b.second);  // of equals the first
  };
  std::priority_queue<Entry, std::vector<Entry>, decltype(less)> queue(less);
  for (std::size_t i = 0; i < candidates.size(); ++i) {
    const double gain = brain.gain(*views, candidates[i], quality, target);
    if (gain >= least_gain) queue.emplace(gain, i);
  }
  while (!queue.empty()) {
    const auto [old_gain, i] = queue.top();
    queue.pop();
    const double gain = brain.gain(*views, candidates[i], quality, target);
    if (gain < least_gain) continue;
    if (!queue.empty() && gain < queue.top().first && gain < old_gain) {
      queue.emplace(gain, i);
      continue;
    }
    if (!wanted(candidates[i], gain)) continue;
    Brain::acquire(views, candidates[i], quality);
    if (!picked(candidates[i], gain)) return;
    queue.emplace(gain, i);  // may be worth another time
  }
}

double repetition_time_s(const Estimate& estimate) {
  std::vector<std::int64_t> steps;
  for (std::size_t i = 1; i < estimate.slices.size(); ++i) {
    const std::int64_t step = estimate.slices[i].info.stamp_ns - estimate.slices[i - 1].info.stamp_ns;
    if (step > 0) steps.push_back(step);
  }
  if (steps.empty()) return 0.;
  const auto middle = steps.begin() + static_cast<std::ptrdiff_t>(steps.size() / 2);
  std::nth_element(steps.begin(), middle, steps.end());
  return 1e-9 * static_cast<double>(*middle);
}

/// Slices of the stack in hand that are still to come. The order of acquisition is that of the interleave that its
/// slices have followed so far: a slice that was passed over will not come. If they have followed none, all that have
/// not come may still do.
std::vector<int> coming_slices(const StackGeometry& stack, const std::vector<std::pair<int, int>>& answered) {
  std::vector<int> came;
  for (const auto& [number, index] : answered)
    if (number == stack.stack) came.push_back(index);
  std::vector<int> steps;
  for (std::size_t i = 1; i < came.size(); ++i)
    if (came[i] > came[i - 1]) steps.push_back(came[i] - came[i - 1]);
  std::vector<int> left;
  for (int index = 0; index < stack.slices; ++index)
    if (std::find(came.begin(), came.end(), index) == came.end()) left.push_back(index);
  if (steps.empty()) return left;
  std::nth_element(steps.begin(), steps.begin() + static_cast<std::ptrdiff_t>(steps.size() / 2), steps.end());
  const std::vector<int> order = interleaved_order(stack.slices, steps[steps.size() / 2]);
  const auto place = [&order](int index) { return std::find(order.begin(), order.end(), index) - order.begin(); };
  for (std::size_t i = 1; i < came.size(); ++i)
    if (place(came[i]) < place(came[i - 1])) return left;
  const auto reached = place(came.back());
  left.erase(std::remove_if(left.begin(), left.end(), [&](int index) { return place(index) < reached; }), left.end());
  return left;
}

const SliceEstimate* find_slice(const Estimate& estimate, int stack, int index) {
  for (const SliceEstimate& slice : estimate.slices)
    if (slice.info.stack == stack && slice.info.index == index) return &slice;
  return nullptr;
}

}  // namespace

const char* to_string(RequestState state) {
  switch (state) {
    case RequestState::proposed:
      return "proposed";
    case RequestState::requested:
      return "requested";
    case RequestState::fulfilled:
      return "fulfilled";
    case RequestState::vetoed:
      return "vetoed";
    case RequestState::withdrawn:
      return "withdrawn";
  }
  return "unknown";
}

void validate(const ReacquisitionOptions& o) {
  const OptionCheck check("decision.reacquisition.");
  check(o.budget_s >= 0. && std::isfinite(o.budget_s), "budget_s", o.budget_s, "zero or positive");
  check(o.delay_s >= 0. && o.delay_s <= 1e6, "delay_s", o.delay_s, "from 0 to 1000000 s");
  check(o.overhead_s >= 0. && std::isfinite(o.overhead_s), "overhead_s", o.overhead_s, "zero or positive");
  check(o.confirm_updates >= 1 && o.confirm_updates <= 1000, "confirm_updates", o.confirm_updates, "from 1 to 1000");
  check(o.open_requests >= 0 && o.open_requests <= 1000, "open_requests", o.open_requests, "from 0 to 1000");
  check(o.least_gain > 0. && o.least_gain <= 1., "least_gain", o.least_gain, "in (0, 1]");
  check(o.same_plane_deg > 0. && o.same_plane_deg <= 90., "same_plane_deg", o.same_plane_deg, "in (0, 90] degrees");
  check(o.same_plane_share > 0. && o.same_plane_share <= 10., "same_plane_share", o.same_plane_share, "in (0, 10]");
}

ReacquisitionPlanner::ReacquisitionPlanner(const ReacquisitionOptions& options) : options_(options) {
  validate(options);
}

void ReacquisitionPlanner::set_options(const ReacquisitionOptions& options) {
  validate(options);
  options_ = options;
}

void ReacquisitionPlanner::note(const std::string& event, const std::string& detail) {
  PlannerEvent line;
  line.stamp_ns = now_ns_;
  line.revision = revision_;
  line.event = event;
  line.budget_left_s = budget_left_s();
  line.detail = detail;
  events_.push_back(line);
}

void ReacquisitionPlanner::clear() { *this = ReacquisitionPlanner(options_); }

double ReacquisitionPlanner::budget_left_s() const {
  double left = options_.budget_s;
  for (const ReacquisitionRequest& request : requests_)
    if (request.state != RequestState::vetoed && request.state != RequestState::withdrawn) left -= request.cost_s;
  return left;
}

std::vector<ReacquisitionRequest> ReacquisitionPlanner::waiting() const {
  std::vector<ReacquisitionRequest> result;
  for (const ReacquisitionRequest& request : requests_)
    if (request.rank > 0) result.push_back(request);
  std::sort(result.begin(), result.end(), [](const auto& a, const auto& b) { return a.rank < b.rank; });
  return result;
}

void ReacquisitionPlanner::mark(std::size_t request, RequestState state, const std::string& detail) {
  requests_[request].state = state;
  if (state != RequestState::proposed && state != RequestState::requested) requests_[request].rank = 0;
  PlannerEvent line;
  line.stamp_ns = now_ns_;
  line.revision = revision_;
  line.event = to_string(state);
  line.request = requests_[request];
  line.budget_left_s = budget_left_s();
  line.detail = detail;
  events_.push_back(line);
}

int ReacquisitionPlanner::veto(int id, const std::string& reason) {
  int count = 0;
  for (std::size_t i = 0; i < requests_.size(); ++i) {
    if (requests_[i].rank == 0 || (id != 0 && requests_[i].id != id)) continue;
    mark(i, RequestState::vetoed, reason);
    ++count;
  }
  return count;
}

/// Requests move with the brain frame and the head; slices that have come since may fulfil them.
void ReacquisitionPlanner::follow(const PlannerInput& input) {
  const HeadMotion* head = input.motion->now();
  std::vector<const SliceEstimate*> arrived;
  for (const SliceEstimate& slice : input.estimate->slices)
    if (known_.insert({slice.info.stack, slice.info.index}).second) arrived.push_back(&slice);
  for (std::size_t i = 0; i < requests_.size(); ++i) {
    ReacquisitionRequest& request = requests_[i];
    const SliceEstimate* anchor = find_slice(*input.estimate, anchors_[i].stack, anchors_[i].index);
    if (anchor) request.T_brain_slice = anchor->T_brain_slice * anchors_[i].T_slice_plan;
    if (request.rank == 0) continue;
    request.T_scanner_slice = head->T_scanner_brain * request.T_brain_slice;
    for (const SliceEstimate* slice : arrived) {
      const double distance = std::abs(request.T_brain_slice.linear().col(2).dot(slice->T_brain_slice.translation() -
                                                                                 request.T_brain_slice.translation()));
      if (slice->info.stamp_ns <= request.asked_ns ||
          angle_between_planes(request.T_brain_slice, slice->T_brain_slice) > options_.same_plane_deg * kDegree ||
          distance > options_.same_plane_share * request.thickness_mm)
        continue;
      mark(i, RequestState::fulfilled,
           "by stack " + std::to_string(slice->info.stack) + " slice " + std::to_string(slice->info.index));
      break;
    }
  }
}

void ReacquisitionPlanner::update(const PlannerInput& input) {
  const Estimate& estimate = *input.estimate;
  if (estimate.slices.empty() || input.coverage->empty()) return;
  now_ns_ = std::max(now_ns_, estimate.slices.back().info.stamp_ns);
  revision_ = estimate.revision;
  follow(input);

  const HeadMotion* head = input.motion->now();
  const Pose T_brain_scanner = head->T_scanner_brain.inverse();
  const std::vector<StackGeometry> stacks = stacks_of(estimate);
  const double repetition_s = repetition_time_s(estimate);
  const Brain brain(*input.coverage);

  // What another slice is expected to be worth: what the last ones were.
  std::vector<std::pair<std::int64_t, double>> scores;
  for (const SliceQuality& slice : input.quality->slices()) scores.emplace_back(slice.stamp_ns, slice.score);
  std::sort(scores.begin(), scores.end());
  double sum = 0.;
  const std::size_t recent = std::min(scores.size(), kRecentSlices);
  for (std::size_t i = scores.size() - recent; i < scores.size(); ++i) sum += scores[i].second;
  const double yield = sum / static_cast<double>(recent);
  const double expected = std::max(kUsefulYield, yield);

  // 1. What will come anyway: the rest of the stack in hand, through the head as it lies now.
  std::vector<ViewTensor> views = brain.views();
  int pending = 0;
  std::set<std::pair<int, int>> coming;
  if (!stacks.empty()) {
    const StackGeometry& current = stacks.back();
    for (const int index : coming_slices(current, input.answered)) {
      ++pending;
      coming.insert({current.stack, index});
      Candidate slice;
      slice.T_brain_slice = T_brain_scanner * current.prescription(index);
      slice.places = brain.seen_by(slice.T_brain_slice, current.thickness_mm);
      Brain::acquire(&views, slice, expected);
    }
  }
  const std::vector<ViewTensor> without_requests = views;

  // 2. Planes that might be asked for: those of the stacks, continued beyond their ends.
  std::vector<Candidate> candidates;
  const auto offer = [&](Candidate candidate) {
    candidate.places = brain.seen_by(candidate.T_brain_slice, candidate.thickness_mm);
    if (!candidate.places.empty()) candidates.push_back(std::move(candidate));
  };
  for (const StackGeometry& stack : stacks)
    for (int index = stack.reference - kFarthestIndex; index <= stack.reference + kFarthestIndex; ++index) {
      if (coming.count({stack.stack, index})) continue;
      offer({stack.stack, index, false, stack.plane(index), stack.thickness_mm, {}});
    }
  const int begun = static_cast<int>(stacks.size());
  const bool protocol_begun = begun >= input.coverage_options.planned_stacks;
  const bool one_orientation = std::all_of(stacks.begin(), stacks.end(), [&](const StackGeometry& stack) {
    return angle_between_planes(stack.T_brain_reference, stacks.front().T_brain_reference) <
           kSameOrientationDeg * kDegree;
  });
  if (!stacks.empty() && protocol_begun && one_orientation) {
    // No protocol will bring another orientation: two more, at right angles.
    const StackGeometry& stack = stacks.front();
    for (const Eigen::Vector3d& axis :
         {Eigen::Vector3d(Eigen::Vector3d::UnitX()), Eigen::Vector3d(Eigen::Vector3d::UnitY())})
      for (int index = -kFarthestIndex; index <= kFarthestIndex; ++index) {
        Pose plane = stack.T_brain_reference * Eigen::AngleAxisd(0.5 * M_PI, axis);
        plane.translation() = brain.centre() + index * stack.thickness_mm * plane.linear().col(2);
        offer({stack.stack, index, true, plane, stack.thickness_mm, {}});
      }
  }

  // 3. Requests that wait: are they still worth it?
  const CoverageTarget target = coverage_target(input.coverage_options, begun);
  for (std::size_t i = 0; i < requests_.size(); ++i) {
    ReacquisitionRequest& request = requests_[i];
    if (request.rank == 0) continue;
    Candidate plane;
    plane.T_brain_slice = request.T_brain_slice;
    plane.places = brain.seen_by(request.T_brain_slice, request.thickness_mm);
    request.gain = brain.gain(views, plane, expected, target);
    if (request.gain < 0.5 * options_.least_gain) {
      mark(i, RequestState::withdrawn, "the gain has fallen below half of least_gain");
      continue;
    }
    Brain::acquire(&views, plane, expected);
  }

  // 4. New ones, as many as may wait, the budget allows and nobody has ruled out.
  const auto same_plane = [&](const ReacquisitionRequest& request, const Candidate& candidate) {
    const double distance = std::abs(request.T_brain_slice.linear().col(2).dot(candidate.T_brain_slice.translation() -
                                                                               request.T_brain_slice.translation()));
    return angle_between_planes(request.T_brain_slice, candidate.T_brain_slice) < options_.same_plane_deg * kDegree &&
           distance < options_.same_plane_share * request.thickness_mm;
  };
  int open = 0;
  for (const ReacquisitionRequest& request : requests_) open += request.rank > 0 ? 1 : 0;
  const double cost_s = repetition_s + options_.overhead_s;
  const auto hold_back = [&](const Candidate& candidate, double gain, const char* event, int kind) {
    // Once per plane and cause: the log would else repeat it at every slice.
    if (!held_back_.insert({candidate.stack * 1000 + candidate.index, kind}).second) return;
    PlannerEvent line;
    line.stamp_ns = now_ns_;
    line.revision = revision_;
    line.event = event;
    line.request.stack = candidate.stack;
    line.request.index = candidate.index;
    line.request.T_brain_slice = candidate.T_brain_slice;
    line.request.T_scanner_slice = head->T_scanner_brain * candidate.T_brain_slice;
    line.request.thickness_mm = candidate.thickness_mm;
    line.request.gain = gain;
    line.request.cost_s = cost_s;
    line.budget_left_s = budget_left_s();
    events_.push_back(line);
  };
  const auto wanted = [&](const Candidate& candidate, double gain) {
    for (const ReacquisitionRequest& request : requests_) {
      if (!same_plane(request, candidate)) continue;
      if (request.state == RequestState::vetoed || request.rank > 0) return false;
      if (static_cast<double>(now_ns_ - request.asked_ns) * 1e-9 < options_.delay_s) {
        hold_back(candidate, gain, "delayed", 0);
        return false;
      }
    }
    if (budget_left_s() < cost_s) {
      hold_back(candidate, gain, "over_budget", 1);
      return false;
    }
    return true;
  };
  std::map<std::pair<int, int>, int> wishes;
  const auto ask = [&](const Candidate& candidate, double gain) {
    // Poses and hull are rough at first: what is wanted for a moment only is not asked for.
    const std::pair<int, int> plane(candidate.stack, candidate.index + (candidate.new_orientation ? 1000 : 0));
    const int times = wishes_.count(plane) ? wishes_.at(plane) + 1 : 1;
    wishes[plane] = times;
    if (times < options_.confirm_updates) return open + static_cast<int>(wishes.size()) < options_.open_requests;
    ReacquisitionRequest request;
    request.id = static_cast<int>(requests_.size()) + 1;
    request.rank = 1;  // settled below
    request.asked_ns = now_ns_;
    request.stack = candidate.stack;
    request.index = candidate.index;
    request.T_brain_slice = candidate.T_brain_slice;
    request.T_scanner_slice = head->T_scanner_brain * candidate.T_brain_slice;
    request.thickness_mm = candidate.thickness_mm;
    request.gain = gain;
    request.cost_s = cost_s;

    const auto stack = std::find_if(stacks.begin(), stacks.end(),
                                    [&](const StackGeometry& each) { return each.stack == candidate.stack; });
    request.again = !candidate.new_orientation && candidate.index >= 0 && candidate.index < stack->slices;
    if (candidate.new_orientation) {
      request.reasons = {"new_orientation"};
    } else if (!request.again) {
      request.reasons = {"beyond_stack"};
    } else if (const SliceEstimate* slice = find_slice(estimate, candidate.stack, candidate.index)) {
      for (const SliceQuality& quality : input.quality->slices()) {
        if (quality.stack != candidate.stack || quality.index != candidate.index || quality.score >= input.accept)
          continue;
        for (const QualityReason reason : quality.reasons) request.reasons.emplace_back(to_string(reason));
        if (request.reasons.empty()) request.reasons = {"low_score"};
      }
      const double distance = std::abs(candidate.T_brain_slice.linear().col(2).dot(
          slice->T_brain_slice.translation() - candidate.T_brain_slice.translation()));
      if (angle_between_planes(slice->T_brain_slice, candidate.T_brain_slice) > options_.same_plane_deg * kDegree ||
          distance > options_.same_plane_share * candidate.thickness_mm)
        request.reasons.emplace_back("displaced");
      if (request.reasons.empty()) request.reasons = {"few_views"};
    } else {
      const bool came = std::find(input.answered.begin(), input.answered.end(),
                                  std::make_pair(candidate.stack, candidate.index)) != input.answered.end();
      request.reasons = {came ? "no_brain" : "missing"};
    }

    // Held by the slice whose plane is nearest.
    const SliceEstimate* nearest = &estimate.slices.front();
    double best = std::numeric_limits<double>::infinity();
    for (const SliceEstimate& slice : estimate.slices) {
      if (!(slice.weight > 0.)) continue;
      const double distance = sphere_displacement(slice.T_brain_slice, candidate.T_brain_slice, 40.);
      if (distance < best) {
        best = distance;
        nearest = &slice;
      }
    }
    anchors_.push_back(
        {nearest->info.stack, nearest->info.index, nearest->T_brain_slice.inverse() * candidate.T_brain_slice});
    requests_.push_back(request);
    ++open;
    wishes.erase(plane);
    mark(requests_.size() - 1, options_.dry_run ? RequestState::proposed : RequestState::requested, "");
    return open + static_cast<int>(wishes.size()) < options_.open_requests;
  };
  if (open < options_.open_requests)
    pick_greedily(brain, candidates, expected, target, options_.least_gain, &views, wanted, ask);
  wishes_ = std::move(wishes);

  std::vector<std::size_t> order;
  for (std::size_t i = 0; i < requests_.size(); ++i)
    if (requests_[i].rank > 0) order.push_back(i);
  std::stable_sort(order.begin(), order.end(), [&](std::size_t a, std::size_t b) {
    return requests_[a].gain / requests_[a].cost_s > requests_[b].gain / requests_[b].cost_s;
  });
  for (std::size_t i = 0; i < order.size(); ++i) requests_[order[i]].rank = static_cast<int>(i) + 1;

  // 5. How long it will take.
  completion_ = Completion();
  completion_.yield = yield;
  completion_.slices = pending;
  const CoverageOptions& wish = input.coverage_options;
  const CoverageTarget full{wish.views, wish.sharp_views};
  int extra = 0;
  bool reachable = yield >= kLeastYield;
  if (!protocol_begun) {
    int prescribed = 0;
    for (const StackGeometry& stack : stacks) prescribed += stack.slices;
    if (begun > 0) completion_.slices += (wish.planned_stacks - begun) * prescribed / begun;
  } else if (reachable) {
    views = without_requests;
    const auto share_well = [&] {
      std::size_t well = 0;
      for (const ViewTensor& place : views) well += place_score(place, full) >= wish.well ? 1 : 0;
      return static_cast<double>(well) / static_cast<double>(views.size());
    };
    bool complete = share_well() >= wish.complete;
    if (!complete)
      pick_greedily(
          brain, candidates, yield, full, 1e-6, &views, [](const Candidate&, double) { return true; },
          [&](const Candidate&, double) {
            ++extra;
            complete = share_well() >= wish.complete;
            return !complete && extra < kMostPlanned;
          });
    reachable = complete;
    completion_.slices += extra;
  }
  completion_.seconds = reachable ? completion_.slices * repetition_s + extra * options_.overhead_s
                                  : std::numeric_limits<double>::quiet_NaN();
}

}  // namespace svort
