#include "svort_ros/registration/scan_registration.h"

#include <torch/types.h>

#include <algorithm>
#include <cstddef>
#include <functional>
#include <limits>
#include <map>
#include <stdexcept>
#include <string>
#include <utility>

#include "rough_volume.h"
#include "scan_pieces.h"

namespace svort {
namespace {

constexpr std::size_t kFewestSlices = 8;  // of a stack: fewer form no volume

// Of a scan that goes on: slices that lie across the first stack's. The pieces of one stack hardly meet, and agree
// anywhere.
constexpr std::ptrdiff_t kFewestAcross = 8;

constexpr int kPieceSlices = 8, kShortPieceSlices = 5;
constexpr double kJudgedMm = 2.;
// Of agreement: what is no better than this is noise.
constexpr double kBetter = 0.001, kBolder = 0.01;
// Pieces that correlate like this, blurred and sharp, are in their places: there is nothing to search for.
constexpr double kAgreed = 0.9, kAgreedSharp = 0.78;

/// One stack by itself.
struct StackAlone {
  std::vector<std::size_t> slices;  ///< places in the scan
  std::vector<Pose> poses;          ///< registered to each other
  Volume volume;                    ///< empty if they are too few
  std::size_t group = 0;            ///< stacks of one group have been put together
};

std::vector<Pose> poses_of(const Refinement& refinement) {
  std::vector<Pose> poses;
  for (const RefinedSlice& slice : refinement.slices) poses.push_back(slice.T_brain_slice);
  return poses;
}

RegistrationInput part_of(const RegistrationInput& input, const std::vector<std::size_t>& slices) {
  std::vector<std::int64_t> index(slices.begin(), slices.end());
  const torch::Tensor select = torch::tensor(index, torch::kInt64);
  RegistrationInput part;
  part.slices = input.slices.index_select(0, select);
  part.masks = input.masks.index_select(0, select);
  part.resolution_mm = input.resolution_mm;
  for (const std::size_t i : slices) {
    part.T_world_slice.push_back(input.T_world_slice[i]);
    part.stack.push_back(input.stack[i]);
    part.time_s.push_back(input.time_s[i]);
    part.thickness_mm.push_back(input.thickness_mm[i]);
  }
  return part;
}

StackAlone stack_alone(const RegistrationInput& input, const std::vector<std::size_t>& slices,
                       const std::vector<Pose>& start, double size_mm, const RefinementOptions& options,
                       double voxel_mm) {
  StackAlone stack;
  stack.slices = slices;
  for (const std::size_t i : slices) stack.poses.push_back(start[i]);
  if (slices.size() < kFewestSlices) return stack;
  const RegistrationInput part = part_of(input, slices);
  const Refinement refinement = refine_poses(part, stack.poses, options);
  std::vector<double> weights;
  for (std::size_t i = 0; i < slices.size(); ++i) {
    stack.poses[i] = refinement.slices[i].T_brain_slice;
    weights.push_back(refinement.slices[i].weight);
  }
  Volume volume = rough_volume(part, stack.poses, weights, size_mm, voxel_mm);
  if (brain_volume_mm3(volume) > 0.) stack.volume = std::move(volume);
  return stack;
}

bool several_stacks(const RegistrationInput& input) {
  return std::any_of(input.stack.begin(), input.stack.end(), [&](int stack) { return stack != input.stack.front(); });
}

bool enough_across(const RegistrationInput& input) {
  return std::count_if(input.stack.begin(), input.stack.end(),
                       [&](int stack) { return stack != input.stack.front(); }) >= kFewestAcross;
}

/// Refinements that are tried one after another. The one whose pieces agree best stays.
class Trials {
 public:
  Trials(const RegistrationInput& input, const RefinementOptions& options)
      : input_(input),
        asked_(options),
        judged_(at_judged_size(options)),
        judge_(input, kPieceSlices, judged_.finest_mm, judged_.finest_mm) {}

  /// @param trust factor of RefinementOptions::image_trust
  void attempt(const std::vector<Pose>& start, double trust = 1.) {
    RefinementOptions with = judged_;
    with.image_trust = std::min(1., trust * asked_.image_trust);
    const auto same = [&](const auto& tried) {
      return tried.second == trust && std::equal(start.begin(), start.end(), tried.first.begin(), tried.first.end(),
                                                 [](const Pose& a, const Pose& b) { return a.matrix() == b.matrix(); });
    };
    if (std::any_of(tried_.begin(), tried_.end(), same)) return;
    tried_.emplace_back(start, trust);
    Refinement other = refine_poses(input_, start, with);
    const double agreement = agreement_of(poses_of(other));
    // Poses that follow the images more agree a little better by following their noise.
    const bool bolder = with.image_trust > best_options_.image_trust;
    if (!best_.slices.empty() && agreement < agreement_ + (bolder ? kBolder : kBetter)) return;
    best_ = std::move(other);
    best_options_ = with;
    agreement_ = agreement;
  }

  const Refinement& best() const { return best_; }
  std::vector<Pose> poses() const { return poses_of(best_); }
  double agreement() const { return agreement_; }
  double agreement_of(const std::vector<Pose>& poses) const { return judge_.agreement(poses); }
  /// Of what is tried.
  const RefinementOptions& options() const { return judged_; }

  /// The best one at the finest level that was asked for.
  Refinement finest() const {
    if (asked_.finest_mm >= judged_.finest_mm) return best_;
    RefinementOptions with = best_options_;
    with.finest_mm = asked_.finest_mm;
    return refine_poses(input_, poses_of(best_), with);
  }

 private:
  /// What is tried is judged without the finest level, which costs the most and moves slices the least.
  static RefinementOptions at_judged_size(RefinementOptions options) {
    options.finest_mm = std::max(kJudgedMm, options.finest_mm);
    return options;
  }

  const RegistrationInput& input_;
  const RefinementOptions asked_, judged_;
  const ScanPieces judge_;
  Refinement best_;
  RefinementOptions best_options_;
  std::vector<std::pair<std::vector<Pose>, double>> tried_;  ///< starts and trusts, for none to be tried twice
  double agreement_ = -std::numeric_limits<double>::infinity();
};

}  // namespace

std::vector<Pose> assemble_stacks(const RegistrationInput& input, const std::vector<Pose>& start, double size_mm,
                                  const RefinementOptions& options, const TemplateOptions& match) {
  validate(input);
  if (start.size() != input.count())
    throw std::invalid_argument("assemble_stacks: " + std::to_string(start.size()) + " start poses for " +
                                std::to_string(input.count()) + " slices");
  std::map<int, std::vector<std::size_t>> members;
  for (std::size_t i = 0; i < input.count(); ++i) members[input.stack[i]].push_back(i);
  if (members.size() < 2) return start;
  std::vector<StackAlone> stacks;
  for (const auto& [number, slices] : members)
    stacks.push_back(stack_alone(input, slices, start, size_mm, options, match.voxel_mm));

  struct Pair {
    std::size_t a, b;  ///< b comes after a
    TemplateMatch match;
  };
  std::vector<Pair> pairs;
  for (std::size_t a = 0; a < stacks.size(); ++a)
    for (std::size_t b = a + 1; b < stacks.size(); ++b)
      if (!stacks[a].volume.empty() && !stacks[b].volume.empty()) {
        pairs.push_back({a, b, match_template(stacks[b].volume, {"stack", 0., stacks[a].volume}, match)});
        if (pairs.back().match.correlation < match.least_correlation) pairs.pop_back();
      }
  // The best matches first, each where it joins stacks that are still apart: a spanning tree.
  std::stable_sort(pairs.begin(), pairs.end(),
                   [](const Pair& x, const Pair& y) { return x.match.correlation > y.match.correlation; });
  for (std::size_t i = 0; i < stacks.size(); ++i) stacks[i].group = i;
  std::vector<Pose> moved(stacks.size(), Pose::Identity());  // each stack, from its own frame into its group's
  const auto join = [&](std::size_t to, std::size_t from, const Pose& T_to_from) {
    const Pose T = moved[to] * T_to_from * moved[from].inverse();
    const std::size_t old = stacks[from].group;
    for (std::size_t i = 0; i < stacks.size(); ++i) {
      if (stacks[i].group != old) continue;
      moved[i] = T * moved[i];
      stacks[i].group = stacks[to].group;
    }
  };
  for (const Pair& pair : pairs)
    if (stacks[pair.a].group != stacks[pair.b].group) join(pair.a, pair.b, pair.match.T_template_volume);
  // Groups that match no other stay to each other as their stacks that follow one another were at the start.
  for (std::size_t i = 1; i < stacks.size(); ++i)
    if (stacks[i].group != stacks[i - 1].group) join(i - 1, i, Pose::Identity());

  std::vector<Pose> poses = start;
  for (std::size_t at = 0; at < stacks.size(); ++at)
    for (std::size_t i = 0; i < stacks[at].slices.size(); ++i)
      poses[stacks[at].slices[i]] = moved[at] * stacks[at].poses[i];
  return poses;
}

Refinement register_scan(const RegistrationInput& input, const std::vector<std::vector<Pose>>& starts, double size_mm,
                         const RefinementOptions& options, const TemplateOptions& match,
                         const std::atomic<bool>* stop) {
  const auto stopped = [&] { return stop && stop->load(); };
  if (starts.empty()) throw std::invalid_argument("register_scan: there is no start");
  if (!several_stacks(input)) {
    // The pieces of one stack hardly meet: what is left is the cost.
    Refinement best = refine_poses(input, starts.front(), options);
    for (std::size_t i = 1; i < starts.size() && !stopped(); ++i) {
      Refinement other = refine_poses(input, starts[i], options);
      if (other.report.last_cost < best.report.last_cost) best = std::move(other);
    }
    return best;
  }
  validate(input);
  Trials trials(input, options);
  const auto take = [&](const std::vector<std::function<void()>>& steps) {
    for (const auto& step : steps) {
      if (stopped()) return;
      step();
    }
  };
  trials.attempt(starts.front());
  for (std::size_t i = 1; i < starts.size() && !stopped(); ++i) trials.attempt(starts[i]);
  take({
      [&] { trials.attempt(assemble_stacks(input, starts.back(), size_mm, trials.options(), match)); },
      // A head that jumps is restless between its jumps, too: its images count more, its smooth motion less.
      [&] { trials.attempt(trials.poses(), 4.); },
  });
  if (stopped()) return trials.best();

  const ScanPieces pieces(input, kPieceSlices, kSearchPixelMm, kSearchBlurMm);
  if (pieces.agreement(trials.poses()) < kAgreed || trials.agreement() < kAgreedSharp) {
    const ScanPieces short_pieces(input, kShortPieceSlices, kSearchPixelMm, kSearchBlurMm);
    take({
        [&] { trials.attempt(pieces.search(trials.poses(), stop)); },
        [&] { trials.attempt(pieces.search(starts.back(), stop)); },
        [&] { trials.attempt(short_pieces.search(trials.poses(), stop)); },
        [&] { trials.attempt(trials.poses(), 4.); },
        [&] { trials.attempt(short_pieces.search(trials.poses(), stop), 4.); },
        [&] { trials.attempt(trials.poses(), 16.); },
        [&] { trials.attempt(trials.poses(), 4.); },
    });
  }
  return stopped() ? trials.best() : trials.finest();
}

std::optional<Refinement> search_scan(const RegistrationInput& input, const std::vector<Pose>& followed,
                                      const std::vector<Pose>& guess, double size_mm, const RefinementOptions& options,
                                      const TemplateOptions& match, const std::atomic<bool>* stop) {
  validate(input);
  for (const std::vector<Pose>* poses : {&followed, &guess}) {
    if (poses->size() == input.count() || (poses == &guess && guess.empty())) continue;
    throw std::invalid_argument("search_scan: " + std::to_string(poses->size()) + " poses for " +
                                std::to_string(input.count()) + " slices");
  }
  if (!enough_across(input)) return std::nullopt;
  const auto stopped = [&] { return stop && stop->load(); };
  const ScanPieces pieces(input, kPieceSlices, kSearchPixelMm, kSearchBlurMm);
  Trials trials(input, options);
  const double agreement = trials.agreement_of(followed);
  const auto agreed = [&](const std::vector<Pose>& poses, double sharp) {
    return sharp >= kAgreedSharp && pieces.agreement(poses) >= kAgreed;
  };
  if (agreed(followed, agreement)) return std::nullopt;
  const ScanPieces short_pieces(input, kShortPieceSlices, kSearchPixelMm, kSearchBlurMm);
  const std::vector<std::function<void()>> steps = {
      [&] { trials.attempt(followed); },
      [&] { trials.attempt(guess.empty() ? followed : guess); },  // what has been tried is not tried again
      [&] { trials.attempt(pieces.search(trials.poses(), stop)); },
      [&] { trials.attempt(assemble_stacks(input, input.T_world_slice, size_mm, trials.options(), match)); },
      [&] { trials.attempt(pieces.search(trials.poses(), stop)); },
      [&] { trials.attempt(short_pieces.search(trials.poses(), stop), 4.); },
      [&] { trials.attempt(trials.poses(), 16.); },
  };
  for (const auto& step : steps) {
    if (stopped()) return std::nullopt;
    step();
    if (agreed(trials.poses(), trials.agreement())) break;
  }
  if (trials.agreement() < agreement + kBolder) return std::nullopt;
  return trials.best();
}

double coarse_agreement(const RegistrationInput& input, const std::vector<Pose>& poses) {
  validate(input);
  if (poses.size() != input.count())
    throw std::invalid_argument("coarse_agreement: " + std::to_string(poses.size()) + " poses for " +
                                std::to_string(input.count()) + " slices");
  if (!enough_across(input)) return std::numeric_limits<double>::quiet_NaN();
  return ScanPieces(input, kPieceSlices, kSearchPixelMm, kSearchBlurMm).agreement(poses);
}

}  // namespace svort
