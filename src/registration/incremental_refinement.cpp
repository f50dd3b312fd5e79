#include "svort_ros/registration/incremental_refinement.h"

#include <torch/types.h>

#include <algorithm>
#include <array>
#include <cmath>
#include <iterator>
#include <limits>
#include <map>
#include <sstream>
#include <stdexcept>
#include <utility>

#include "../acquisition/parallel.h"
#include "piece_search.h"
#include "registration_level.h"
#include "slice_weight.h"
#include "svort_ros/acquisition/geometry_of_poses.h"
#include "svort_ros/acquisition/slice_acquisition.h"
#include "svort_ros/geometry/rigid_fit.h"
#include "trajectory.h"

namespace svort {
namespace {

constexpr double kFwhmPerSigma = 2.354820045;
constexpr double kInPlaneFwhm = 1.2;  // pixels (paper, sec. 2)
constexpr int kLevels = 3;            // of blur
constexpr double kBlurPixels[kLevels] = {2., 1., 0.5};
constexpr int kSteps = 3;           // Gauss-Newton steps per pass, as in refine_poses()
constexpr std::size_t kFewest = 4;  // slices that form a volume
constexpr double kWeightChange = 0.02;

// Looking for slices that are lost: what they show, blurred with its outline, in the volume of the others.
constexpr std::array<std::size_t, 3> kRuns = {1, 4, 8};  // slices that are looked for as one piece
constexpr double kReachAloneRad = 0.8;                   // of a slice alone
// Of what slices usually correlate: one with so much is where it belongs.
constexpr double kFits = 0.9;
// Likewise: a slice with less is lost, and shows nothing to others; one with that is found.
constexpr double kLostShare = 0.55, kFoundShare = 0.75;
constexpr double kSearchMargin = 0.02;
// Slices that lie across the first stack's; before, slices look alike in too many places of its volume.
constexpr std::size_t kFewestAcross = 6;
// What a slice must correlate better by to have been lost; far away something always looks like it.
constexpr double kLostMargin = 0.05, kLostMarginPerMm = 0.005;
constexpr double kLeastAreaMm2 = 1000.;  // of brain; smaller slices look like others everywhere

}  // namespace

class IncrementalRefinement::Engine {
 public:
  Engine(const RefinementOptions& refinement, const IncrementalOptions& options, double resolution_mm,
         double volume_size_mm)
      : refinement_(refinement), options_(options), resolution_mm_(resolution_mm) {
    target_pixel_mm_ = std::max(2., refinement.finest_mm);
    volume_size_mm_ = volume_size_mm;
  }

  void insert(std::size_t position, const IncrementalSlice& slice, const Pose& pose, double bright) {
    if (position > kept_.size())
      throw std::invalid_argument("IncrementalRefinement::insert: position " + std::to_string(position) + " of " +
                                  std::to_string(kept_.size()) + " slices");
    RegistrationInput one;
    one.slices = slice.pixels.view({1, 1, slice.pixels.size(0), slice.pixels.size(1)});
    one.masks = slice.mask.view_as(one.slices);
    one.T_world_slice = {slice.T_world_slice};
    one.stack = {slice.stack};
    one.time_s = {0.};
    one.thickness_mm = {slice.thickness_mm};
    one.resolution_mm = resolution_mm_;
    validate(one);
    Kept kept;
    kept.T_world_slice = slice.T_world_slice;
    kept.stack = slice.stack;
    kept.thickness_mm = slice.thickness_mm;
    const RegistrationLevel sharp = make_level(one, target_pixel_mm_, 0.);
    pixel_mm_ = sharp.pixel_mm;
    kept.pixels = sharp.slices;
    kept.mask = sharp.masks;
    for (int level = 0; level < kLevels; ++level)
      kept.points[level] = make_level(one, target_pixel_mm_, kBlurPixels[level] * pixel_mm_).points.front();
    RegistrationLevel outline = make_level(one, kSearchPixelMm, kSearchBlurMm, SliceContent::outline);
    kept.outline = outline.slices;
    kept.outline_mask = outline.masks;
    kept.outline_points = std::move(outline.points.front());
    outline_pixel_mm_ = outline.pixel_mm;
    bright_ = bright;
    if (!sums_.defined()) {
      size_ = static_cast<std::int64_t>(std::ceil(volume_size_mm_ / pixel_mm_)) + 6;
      sums_ = torch::zeros({size_, size_, size_, 2}, torch::kFloat64);
    }
    const auto at = static_cast<std::ptrdiff_t>(position);
    kept_.insert(kept_.begin() + at, std::move(kept));
    RefinedSlice refined;
    refined.T_brain_slice = pose;
    refined.ncc = std::numeric_limits<double>::quiet_NaN();
    slices_.insert(slices_.begin() + at, refined);
    if (sweep_end_ > position) ++sweep_end_;
  }

  const PoseCandidate& choose(std::size_t position, const std::vector<PoseCandidate>& candidates) {
    if (candidates.empty()) throw std::invalid_argument("IncrementalRefinement::choose: there is no candidate");
    const PoseCandidate* best = &candidates.front();
    slices_.at(position).T_brain_slice = best->T_brain_slice;
    from_afar_ = false;
    if (!compares()) return *best;
    double best_ncc = -std::numeric_limits<double>::infinity();
    RefinedSlice best_state = slices_[position];
    for (const PoseCandidate& candidate : candidates) {
      // A coarse start reaches further, but pulls slices towards where the blurred volume looks like them.
      for (const int coarsest : {1, 0}) {
        const RefinedSlice state = settled(position, candidate.T_brain_slice, coarsest);
        const bool first = &candidate == &candidates.front() && coarsest == 1;
        if (!std::isfinite(state.ncc) || !(first || state.ncc > best_ncc + options_.candidate_margin)) continue;
        best = &candidate;
        best_ncc = state.ncc;
        best_state = state;
        from_afar_ = coarsest == 0 || &candidate != &candidates.front();
      }
    }
    slices_[position] = best_state;
    weigh(position, position + 1);
    return *best;
  }

  std::size_t find_lost(std::size_t position) {
    const double usual = usual_ncc(position);
    const double area_mm2 = static_cast<double>(kept_[position].points[1].value.size()) * pixel_mm_ * pixel_mm_;
    if (!options_.find_lost || !compares() || beyond_first_stack() < kFewestAcross || area_mm2 < kLeastAreaMm2 ||
        !(slices_[position].ncc < kFits * usual))
      return 0;
    std::size_t first = position;
    while (first > 0 && position - first + 1 < kRuns.back() && kept_[first - 1].stack == kept_[position].stack) --first;
    // What is looked for does not show itself.
    std::vector<bool> entered;
    for (std::size_t i = first; i <= position; ++i) {
      entered.push_back(kept_[i].entered);
      kept_[i].entered = false;
    }
    Eigen::Vector3d centre;
    const SampledVolume volume = outline_volume(&centre);
    const double here_ncc = settled(position, slices_[position].T_brain_slice, 1).ncc;
    double best_ncc = kFoundShare * usual;
    std::vector<RefinedSlice> found;
    std::size_t last_length = 0;
    for (const std::size_t wanted : kRuns) {
      const std::size_t length = std::min(wanted, position - first + 1);
      if (length == last_length) break;
      last_length = length;
      const std::size_t from = position + 1 - length;
      Piece piece;
      piece.bright = bright_;
      // Lost slices lie anywhere: what is known of a run is that a head mostly rests.
      const Pose head = slices_[position].T_brain_slice * kept_[position].T_world_slice.inverse();
      for (std::size_t i = from; i <= position; ++i) {
        piece.points.push_back(&kept_[i].outline_points);
        piece.poses.push_back(head * kept_[i].T_world_slice);
      }
      const Placing placing =
          place_piece(piece, volume, centre, {}, length == 1 ? kReachAloneRad : kLargestReachRad, kSearchMargin);
      for (Pose& pose : piece.poses) pose = placing.best.motion * pose;
      for (int level = 0; level <= 1; ++level) {
        prepare_volume(level);
        for (std::size_t i = from; i <= position; ++i) piece.points[i - from] = &kept_[i].points[level];
        const Pose together = refine_piece(piece, volumes_[level]);
        for (Pose& pose : piece.poses) pose = together * pose;
      }
      std::vector<RefinedSlice> run;
      for (std::size_t i = from; i <= position; ++i) run.push_back(settled(i, piece.poses[i - from], 1, 2.));
      const double away_mm = motion_size(twist_of(run.back().T_brain_slice * slices_[position].T_brain_slice.inverse()),
                                         refinement_.lever_mm);
      if (!(run.back().ncc > std::max(best_ncc, here_ncc + kLostMargin + kLostMarginPerMm * away_mm))) continue;
      best_ncc = run.back().ncc;
      // Of a run those stay that were in their places.
      for (std::size_t i = from; i < position; ++i) {
        const RefinedSlice here = settled(i, slices_[i].T_brain_slice, 1);
        if (here.ncc + kLostMargin > run[i - from].ncc) run[i - from] = slices_[i];
      }
      found = std::move(run);
    }
    for (std::size_t i = first; i <= position; ++i) kept_[i].entered = entered[i - first];
    if (found.empty()) {
      kept_[position].lost = here_ncc < kLostShare * usual;
      weigh(position, position + 1);
      return 0;
    }
    from_afar_ = true;
    std::copy(found.begin(), found.end(), slices_.begin() + static_cast<std::ptrdiff_t>(position + 1 - found.size()));
    for (std::size_t i = position + 1 - found.size(); i <= position; ++i) kept_[i].lost = false;
    weigh(position + 1 - found.size(), position + 1);
    return found.size();
  }

  void refine_around(std::size_t position) {
    const std::size_t n = kept_.size();
    const auto window = static_cast<std::size_t>(options_.window);
    const std::size_t end = std::min(n, std::max(position + 1 + window / 2, window));
    const std::size_t begin = end - std::min(end, window);
    if (n < kFewest) return;
    // One stack says nothing about itself but where its slices are sharpest.
    const int coarsest = one_stack() ? kLevels - 1 : from_afar_ ? 0 : 1;
    for (int level = coarsest; level < kLevels; ++level)
      for (int pass = 0; pass < options_.passes; ++pass) refine_window(begin, end, level, level == coarsest);
  }

  double sweep() {
    const std::size_t n = kept_.size();
    if (n < kFewest) return 0.;
    const auto window = static_cast<std::size_t>(options_.window);
    // Windows overlap by half: what was a border in one is in the middle of the next.
    if (sweep_end_ >= n) sweep_end_ = 0;
    const std::size_t begin = sweep_end_ >= window / 2 ? sweep_end_ - window / 2 : 0;
    sweep_end_ = std::min(n, begin + window);
    return refine_window(begin, sweep_end_, kLevels - 1, false);
  }

  void measure_uncertainty() {
    const std::size_t n = kept_.size();
    if (n < kFewest) return;
    prepare_volume(kLevels - 1);
    const auto window = static_cast<std::size_t>(options_.window);
    for (std::size_t begin = 0; begin < n; begin += window / 2) {
      const std::size_t end = std::min(n, begin + window);
      const std::vector<RefinedSlice> as_they_are(slices_.begin() + static_cast<std::ptrdiff_t>(begin),
                                                  slices_.begin() + static_cast<std::ptrdiff_t>(end));
      evaluate(begin, end, kLevels - 1);
      set_sigma(begin, end);
      for (std::size_t i = begin; i < end; ++i) {
        const double sigma_mm = slices_[i].sigma_mm;
        slices_[i] = as_they_are[i - begin];
        slices_[i].sigma_mm = sigma_mm;
      }
    }
  }

  std::size_t windows() const {
    const std::size_t half = std::max<std::size_t>(1, static_cast<std::size_t>(options_.window) / 2);
    return (kept_.size() + half - 1) / half;
  }

  void set(const std::vector<RefinedSlice>& slices) {
    if (slices.size() != kept_.size())
      throw std::invalid_argument("IncrementalRefinement::set: " + std::to_string(slices.size()) + " poses for " +
                                  std::to_string(kept_.size()) + " slices");
    slices_ = slices;
    rebuild();
  }

  bool compares() const { return in_volume_ >= kFewest && !one_stack(); }

  torch::Tensor volume() {
    update_sums();
    return in_volume_ > 0 ? reconstructed() : torch::Tensor();
  }
  double voxel_mm() const { return pixel_mm_; }

  const std::vector<RefinedSlice>& slices() const { return slices_; }
  std::size_t take_replaced() { return std::exchange(replaced_, 0); }

 private:
  struct Kept {
    Pose T_world_slice;
    int stack = 0;
    double thickness_mm = 3.;
    torch::Tensor pixels, mask;           ///< 1 x 1 x s x s
    SlicePoints points[kLevels];          ///< blurred
    torch::Tensor outline, outline_mask;  ///< coarse, with the brain's outline, to look for it far away
    SlicePoints outline_points;
    bool lost = false;       ///< fits nowhere: shows nothing to the others
    bool entered = false;    ///< takes part in the volume, if its weight is not 0
    bool in_volume = false;  ///< its terms are in the sums, at this pose and weight
    Pose volume_pose = Pose::Identity();
    double volume_weight = 0.;
  };

  std::size_t beyond_first_stack() const {
    return static_cast<std::size_t>(
        std::count_if(kept_.begin(), kept_.end(), [&](const Kept& k) { return k.stack != kept_.front().stack; }));
  }

  /// Median of the others.
  double usual_ncc(std::size_t position) const {
    std::vector<double> ncc;
    for (std::size_t i = 0; i < slices_.size(); ++i)
      if (i != position && kept_[i].entered && slices_[i].weight > 0. && std::isfinite(slices_[i].ncc))
        ncc.push_back(slices_[i].ncc);
    if (ncc.empty()) return 0.;
    const auto middle = ncc.begin() + static_cast<std::ptrdiff_t>(ncc.size() / 2);
    std::nth_element(ncc.begin(), middle, ncc.end());
    return *middle;
  }

  /// A slice registered alone to the volume of the others, from a pose.
  /// @param freedom factor of how far it may go from there
  RefinedSlice settled(std::size_t position, const Pose& from, int coarsest, double freedom = 1.) {
    // Where the head was is where it most likely is: a walk away from there has to be worth it.
    Vector6d metric;
    metric << Eigen::Vector3d::Constant(refinement_.lever_mm * refinement_.lever_mm), Eigen::Vector3d::Ones();
    const double spread = freedom * refinement_.step_mm * refinement_.stack_gap_factor;
    RefinedSlice state = slices_[position];
    state.T_brain_slice = from;
    for (int level = coarsest; level <= 1; ++level) {
      prepare_volume(level);
      for (int step = 0; step < 2 * kSteps; ++step) {
        const SliceTerms terms = terms_of(position, state.T_brain_slice, state, level);
        state.gain = terms.gain;
        state.offset = terms.offset;
        const double trust = trust_of(2. * terms.cost);
        const Vector6d away = twist_of(state.T_brain_slice * from.inverse());
        const Matrix6d prior = (metric / (spread * spread)).asDiagonal();
        const Matrix6d hessian = trust * terms.hessian + prior;
        const Vector6d gradient = trust * terms.gradient + prior * away;
        state.T_brain_slice = motion(bounded(-hessian.ldlt().solve(gradient))) * state.T_brain_slice;
      }
    }
    state.ncc = terms_of(position, state.T_brain_slice, state, 1).ncc;
    return state;
  }

  /// The volume, blurred, with the brain's outline.
  SampledVolume outline_volume(Eigen::Vector3d* centre) const {
    std::vector<torch::Tensor> slices, masks;
    std::vector<Pose> poses;
    std::vector<double> thickness_mm, weights;
    for (std::size_t i = 0; i < kept_.size(); ++i) {
      if (!kept_[i].entered || !(slices_[i].weight > 0.)) continue;
      slices.push_back(kept_[i].outline);
      masks.push_back(kept_[i].outline_mask);
      poses.push_back(slices_[i].T_brain_slice);
      thickness_mm.push_back(kept_[i].thickness_mm);
      weights.push_back(slices_[i].weight);
    }
    const auto size = static_cast<std::int64_t>(std::ceil(volume_size_mm_ / outline_pixel_mm_)) + 6;
    if (poses.empty())
      return faded_volume({torch::zeros({size, size, size}), torch::zeros({size, size, size})}, outline_pixel_mm_,
                          centre);
    const SliceAcquisition acquisition =
        cube_acquisition(torch::cat(masks), poses, thickness_mm, outline_pixel_mm_, size, outline_pixel_mm_);
    return faded_volume(weighted_volume(torch::cat(slices), acquisition, weights), outline_pixel_mm_, centre);
  }

  bool one_stack() const {
    return std::all_of(kept_.begin(), kept_.end(), [&](const Kept& k) { return k.stack == kept_.front().stack; });
  }

  SliceAcquisition acquisition_of(const Kept& kept, const Pose& pose) const {
    return SliceAcquisition(geometry_of_poses({pose}, {kept.thickness_mm}, pixel_mm_, pixel_mm_),
                            static_cast<int>(kept.pixels.size(2)), static_cast<int>(kept.pixels.size(3)),
                            {size_, size_, size_}, AcquisitionFormulation::fast, {kept.mask, {}});
  }

  /// Replaces the terms of the slices that moved.
  void update_sums() {
    for (std::size_t i = 0; i < kept_.size(); ++i) {
      Kept& kept = kept_[i];
      const double weight = kept.entered ? slices_[i].weight : 0.;
      const Pose& pose = slices_[i].T_brain_slice;
      if (kept.in_volume) {
        const double moved = motion_size(twist_of(pose * kept.volume_pose.inverse()), refinement_.lever_mm);
        if (moved <= options_.moved_mm && std::abs(weight - kept.volume_weight) <= kWeightChange * kept.volume_weight)
          continue;
        acquisition_of(kept, kept.volume_pose).add_to_sums(kept.pixels, -kept.volume_weight, &sums_);
        kept.in_volume = false;
        --in_volume_;
        ++replaced_;
        forget_volumes();
      }
      if (weight > 0.) {
        acquisition_of(kept, pose).add_to_sums(kept.pixels, weight, &sums_);
        kept.in_volume = true;
        kept.volume_pose = pose;
        kept.volume_weight = weight;
        ++in_volume_;
        forget_volumes();
      }
    }
  }

  void forget_volumes() {
    std::fill(std::begin(prepared_), std::end(prepared_), false);
    volume_ = torch::Tensor();
  }

  const torch::Tensor& reconstructed() {
    if (!volume_.defined())
      volume_ = acquisition_of(kept_.front(), slices_.front().T_brain_slice).equalized_volume(sums_);
    return volume_;
  }

  void rebuild() {
    if (!sums_.defined()) return;
    sums_.zero_();
    in_volume_ = 0;
    for (Kept& kept : kept_) {
      kept.in_volume = kept.lost = false;
      kept.entered = true;
    }
    forget_volumes();
  }

  /// The volume as the slices of this level of blur see it. What no slice has seen is unknown, not dark: it is filled
  /// from what lies next to it.
  void prepare_volume(int level) {
    update_sums();
    if (prepared_[level]) return;
    const auto size = static_cast<int>(size_);
    const double psf = kInPlaneFwhm / kFwhmPerSigma;
    const std::int64_t voxels = size_ * size_ * size_;
    if (std::none_of(std::begin(prepared_), std::end(prepared_), [](bool is) { return is; })) {
      std::vector<float> total(static_cast<std::size_t>(voxels));
      const double* sum = sums_.data_ptr<double>();
      for (std::int64_t i = 0; i < voxels; ++i) total[static_cast<std::size_t>(i)] = static_cast<float>(sum[2 * i + 1]);
      total = blurred(std::move(total), size, psf);
      const float least = 1e-3F * std::max(1e-12F, *std::max_element(total.begin(), total.end()));
      seen_.assign(total.size(), 0.F);
      mean_.assign(total.size(), 0.F);
      const float* value = reconstructed().data_ptr<float>();
      for (std::size_t i = 0; i < total.size(); ++i) {
        if (total[i] <= least) continue;
        seen_[i] = 1.F;
        mean_[i] = value[i];
      }
      support_ = SampledVolume(std::move(total), size, pixel_mm_);
    }
    const double sigma = std::hypot(psf, kBlurPixels[level]);
    std::vector<float> value = blurred(mean_, size, sigma), share = blurred(seen_, size, sigma);
    for (std::size_t i = 0; i < value.size(); ++i) value[i] = share[i] > 0.05F ? value[i] / share[i] : 0.F;
    volumes_[level] = SampledVolume(std::move(value), size, pixel_mm_);
    prepared_[level] = true;
  }

  SliceTerms terms_of(std::size_t slice, const Pose& pose, const RefinedSlice& state, int level) const {
    const double in_plane = kInPlaneFwhm * pixel_mm_ / kFwhmPerSigma;
    const double through = kept_[slice].thickness_mm / kFwhmPerSigma;
    const ProfileTaps taps = profile_taps(std::sqrt(std::max(0., through * through - in_plane * in_plane)));
    SliceTermOptions options;
    options.image_scale = refinement_.image_scale * bright_;
    options.offset_spread = 0.1 * bright_;
    options.gain = state.gain;
    options.offset = state.offset;
    return slice_terms(kept_[slice].points[level], taps, volumes_[level], pose, options);
  }

  /// Independent measurements per pixel over the variance of the image's noise.
  double trust_of(double variance) const {
    const double noise = std::max(variance, 1e-6 * bright_ * bright_);
    return refinement_.image_trust * (one_stack() ? refinement_.one_stack_trust : 1.) * pixel_mm_ * pixel_mm_ / noise;
  }

  Vector6d bounded(const Vector6d& step) const {
    const double size = motion_size(step, refinement_.lever_mm);
    return size > refinement_.largest_step_mm ? Vector6d(step * (refinement_.largest_step_mm / size)) : step;
  }

  void evaluate(std::size_t begin, std::size_t end, int level) {
    terms_.resize(end - begin);
    parallel_tasks(static_cast<std::int64_t>(end - begin), [&](std::int64_t task) {
      const auto i = begin + static_cast<std::size_t>(task);
      terms_[i - begin] = terms_of(i, slices_[i].T_brain_slice, slices_[i], level);
    });
    double sum = 0., pixels = 0.;
    for (std::size_t i = begin; i < end; ++i) {
      const SliceTerms& terms = terms_[i - begin];
      slices_[i].gain = terms.gain;
      slices_[i].offset = terms.offset;
      slices_[i].ncc = terms.ncc;
      const auto count = static_cast<double>(kept_[i].points[level].value.size());
      sum += terms.cost * count;
      pixels += count;
    }
    cost_ = pixels > 0. ? sum / pixels : 0.;
  }

  /// One volume, and Gauss-Newton of the slices begin .. end to it; the others are held. @return mean motion, mm
  double refine_window(std::size_t begin, std::size_t end, int level, bool whole_stack) {
    for (std::size_t i = begin; i < end; ++i) kept_[i].entered = true;
    prepare_volume(level);
    std::vector<Pose> before;
    for (std::size_t i = begin; i < end; ++i) before.push_back(slices_[i].T_brain_slice);
    // A stack that has just begun may be off as a whole: what there is of it moves together first.
    if (whole_stack) step_young_stack(begin, end, level);
    for (int step = 0; step < kSteps; ++step) {
      evaluate(begin, end, level);
      step_trajectory(begin, end);
    }
    return_strays(begin, end);
    evaluate(begin, end, level);
    if (level == kLevels - 1) {
      const double enough = kLostShare * usual_ncc(kept_.size());
      for (std::size_t i = begin; i < end; ++i) kept_[i].lost = kept_[i].lost && !(slices_[i].ncc > enough);
    }
    weigh(begin, end);
    set_sigma(begin, end);
    if (begin == 0 && end == kept_.size()) hold_frame(before);
    double moved = 0.;
    for (std::size_t i = begin; i < end; ++i)
      moved += motion_size(twist_of(slices_[i].T_brain_slice * before[i - begin].inverse()), refinement_.lever_mm) /
               static_cast<double>(end - begin);
    return moved;
  }

  void step_young_stack(std::size_t begin, std::size_t end, int level) {
    const int stack = kept_[end - 1].stack;
    std::size_t first = end;
    while (first > 0 && kept_[first - 1].stack == stack) --first;
    if (first <= begin || one_stack()) return;  // it has left the window, or there is nothing to compare with
    for (int step = 0; step < kSteps; ++step) {
      evaluate(first, end, level);
      Matrix6d hessian = Matrix6d::Zero();
      Vector6d gradient = Vector6d::Zero();
      for (const SliceTerms& terms : terms_) {
        hessian += terms.hessian;
        gradient += terms.gradient;
      }
      hessian.diagonal() *= 1. + 1e-4;
      hessian.diagonal().array() += 1e-9;
      const Pose step_pose = motion(bounded(-hessian.ldlt().solve(gradient)));
      for (std::size_t i = first; i < end; ++i) slices_[i].T_brain_slice = step_pose * slices_[i].T_brain_slice;
    }
  }

  /// The normal equations of a window: begin .. end, and the neighbours on both sides, which are held by a stiffness
  /// that nothing moves.
  struct WindowSystem {
    std::size_t from = 0;
    std::vector<SliceTerms> terms;
    std::vector<Pose> motions;
    std::vector<double> spread_mm;
    WalkOptions walk;
    bool held = false;
    Matrix6d stiffness;
  };

  WindowSystem system_of(std::size_t begin, std::size_t end) const {
    const double trust = trust_of(2. * cost_);
    WindowSystem system;
    const std::size_t to = std::min(kept_.size(), end + 1);
    system.from = begin > 0 ? begin - 1 : begin;
    system.held = system.from < begin || to > end;
    Vector6d metric;
    metric << Eigen::Vector3d::Constant(refinement_.lever_mm * refinement_.lever_mm), Eigen::Vector3d::Ones();
    system.stiffness = (1e8 * metric).asDiagonal();
    system.terms.resize(to - system.from);
    for (std::size_t i = system.from; i < to; ++i) {
      SliceTerms& terms = system.terms[i - system.from];
      if (i < begin || i >= end) {
        terms.hessian = system.stiffness;
      } else {
        const double factor = trust * std::max(0.05, slices_[i].weight);
        terms = terms_[i - begin];
        terms.hessian *= factor;
        terms.gradient *= factor;
      }
      system.motions.push_back(slices_[i].T_brain_slice * kept_[i].T_world_slice.inverse());
      if (i + 1 < to) {
        const double factor = kept_[i].stack == kept_[i + 1].stack ? 1. : refinement_.stack_gap_factor;
        const double spread = refinement_.step_mm * factor;
        system.spread_mm.push_back(spread > 0. ? spread : std::numeric_limits<double>::infinity());
      }
    }
    system.walk.lever_mm = refinement_.lever_mm;
    system.walk.jump_mm = refinement_.jump_mm / refinement_.step_mm;
    return system;
  }

  void step_trajectory(std::size_t begin, std::size_t end) {
    const WindowSystem system = system_of(begin, end);
    const std::vector<Vector6d> steps = solve_trajectory(system.terms, system.motions, system.spread_mm, system.walk);
    for (std::size_t i = begin; i < end; ++i)
      slices_[i].T_brain_slice = motion(bounded(steps[i - system.from])) * slices_[i].T_brain_slice;
  }

  /// From the terms of the last evaluate() of this window.
  void set_sigma(std::size_t begin, std::size_t end) {
    WindowSystem system = system_of(begin, end);
    // How far the head goes from slice to slice just now, rather than what the solution expects of any head: one at
    // rest leaves its slices little freedom, a restless one much.
    double motion_mm = 0., steps = 0.;
    for (std::size_t i = 0; i + 1 < system.motions.size(); ++i) {
      const Pose step = system.motions[i + 1] * system.motions[i].inverse();
      motion_mm += motion_size(twist_of(step), refinement_.lever_mm);
      steps += 1.;
    }
    constexpr double kLeastStepMm = 0.1;
    const double scale = std::max(kLeastStepMm, motion_mm / std::max(1., steps)) / refinement_.step_mm;
    for (double& spread : system.spread_mm) spread *= scale;
    // Uncertain relative to the slices that are held; where none is, relative to the one in the middle.
    if (!system.held) system.terms[system.terms.size() / 2].hessian += system.stiffness;
    std::vector<Matrix6d> covariance;
    solve_trajectory(system.terms, system.motions, system.spread_mm, system.walk, &covariance);
    for (std::size_t i = begin; i < end; ++i)
      slices_[i].sigma_mm = covariance.empty()
                                ? std::numeric_limits<double>::quiet_NaN()
                                : expected_motion_size(covariance[i - system.from], refinement_.lever_mm);
  }

  double mean_support(const SampledVolume& support, std::size_t slice) const {
    const SlicePoints& points = kept_[slice].points[kLevels - 1];
    if (points.value.empty()) return 0.;
    const Eigen::Affine3f pose = slices_[slice].T_brain_slice.cast<float>();
    double sum = 0.;
    for (const Eigen::Vector2f& p : points.position) sum += support.at(pose * Eigen::Vector3f(p.x(), p.y(), 0.F)).value;
    return sum / static_cast<double>(points.value.size());
  }

  /// A slice that has left the others fits itself perfectly, wherever it is. It goes where its neighbour in time says
  /// that the head was.
  void return_strays(std::size_t begin, std::size_t end) {
    if (one_stack()) return;
    constexpr double kOwnShare = 0.8;
    std::vector<bool> stray(end - begin);
    for (std::size_t i = begin; i < end; ++i) {
      if (!kept_[i].in_volume || slices_[i].weight <= 0.) continue;
      if (!(own_support_ > 0.)) measure_own_support(i);
      stray[i - begin] = kept_[i].volume_weight * own_support_ > kOwnShare * mean_support(support_, i);
    }
    const std::vector<RefinedSlice> found(slices_.begin() + static_cast<std::ptrdiff_t>(begin),
                                          slices_.begin() + static_cast<std::ptrdiff_t>(end));
    for (std::size_t i = begin; i < end; ++i) {
      if (!stray[i - begin]) continue;
      for (std::size_t distance = 1; distance < end - begin; ++distance) {
        const auto usable = [&](std::size_t j) { return kept_[j].stack == kept_[i].stack && !stray[j - begin]; };
        std::size_t from = i;
        if (i >= begin + distance && usable(i - distance))
          from = i - distance;
        else if (i + distance < end && usable(i + distance))
          from = i + distance;
        if (from == i) continue;
        slices_[i].T_brain_slice =
            found[from - begin].T_brain_slice * kept_[from].T_world_slice.inverse() * kept_[i].T_world_slice;
        break;
      }
    }
  }

  /// What a slice of weight 1 gives to the voxels of its own plane, alone.
  void measure_own_support(std::size_t slice) {
    torch::Tensor alone = torch::zeros_like(sums_);
    acquisition_of(kept_[slice], slices_[slice].T_brain_slice).add_to_sums(kept_[slice].pixels, 1., &alone);
    std::vector<float> total(static_cast<std::size_t>(size_ * size_ * size_));
    const double* sum = alone.data_ptr<double>();
    for (std::size_t i = 0; i < total.size(); ++i) total[i] = static_cast<float>(sum[2 * i + 1]);
    const auto size = static_cast<int>(size_);
    own_support_ = mean_support(
        SampledVolume(blurred(std::move(total), size, kInPlaneFwhm / kFwhmPerSigma), size, pixel_mm_), slice);
  }

  void weigh(std::size_t begin, std::size_t end) {
    for (std::size_t i = begin; i < end; ++i) {
      weigh_slice(refinement_.outlier_ncc, &slices_[i]);
      if (!kept_[i].lost || !(slices_[i].weight > 0.)) continue;
      slices_[i].weight = 0.;
      slices_[i].reason = "lost: it fits neither where the head was nor anywhere else";
    }
    // All of them outliers: then none is, or there would be no volume to return to.
    if (std::any_of(slices_.begin(), slices_.end(), [](const RefinedSlice& s) { return s.weight > 0.; })) return;
    for (RefinedSlice& slice : slices_)
      if (std::isfinite(slice.ncc)) slice.weight = 1e-3;
  }

  /// While all slices move, nothing holds the frame but where they were.
  void hold_frame(const std::vector<Pose>& before) {
    std::vector<Pose> now;
    for (const RefinedSlice& slice : slices_) now.push_back(slice.T_brain_slice);
    const Pose held = fit_planes(now, before, refinement_.lever_mm);
    for (RefinedSlice& slice : slices_) slice.T_brain_slice = held * slice.T_brain_slice;
  }

  const RefinementOptions refinement_;
  const IncrementalOptions options_;
  const double resolution_mm_;
  double target_pixel_mm_ = 2., pixel_mm_ = 2., outline_pixel_mm_ = 4., volume_size_mm_ = 128., bright_ = 1.;
  std::vector<Kept> kept_;
  std::vector<RefinedSlice> slices_;
  std::vector<SliceTerms> terms_;
  double cost_ = 0.;  ///< mean robust cost per pixel at the last evaluate()
  std::int64_t size_ = 0;
  torch::Tensor sums_, volume_;  ///< of the volume, and the volume itself unless the sums have changed since
  std::size_t in_volume_ = 0, replaced_ = 0, sweep_end_ = 0;
  std::vector<float> mean_, seen_;  ///< the volume, and 1 where a slice has seen it
  SampledVolume support_;           ///< sum of the weights that each voxel received
  SampledVolume volumes_[kLevels];  ///< at each level of blur, where it is prepared
  bool prepared_[kLevels] = {};
  double own_support_ = 0.;
  bool from_afar_ = false;  ///< the newest slice was not found near its prediction
};

void validate(const IncrementalOptions& options) {
  const auto require = [](bool condition, const char* name, double value, const char* range) {
    if (condition) return;
    std::ostringstream message;
    message << "incremental." << name << " is " << value << "; it must be " << range;
    throw std::invalid_argument(message.str());
  };
  require(options.window >= 4 && options.window <= 1000, "window", options.window, "from 4 to 1000");
  require(options.passes >= 1 && options.passes <= 100, "passes", options.passes, "from 1 to 100");
  require(options.sweeps >= 0 && options.sweeps <= 1000, "sweeps", options.sweeps, "from 0 to 1000");
  require(options.candidate_margin >= 0. && options.candidate_margin <= 2., "candidate_margin",
          options.candidate_margin, "from 0 to 2");
  require(options.moved_mm >= 0. && std::isfinite(options.moved_mm), "moved_mm", options.moved_mm, "zero or positive");
}

IncrementalRefinement::IncrementalRefinement(const RefinementOptions& refinement, const IncrementalOptions& options,
                                             double resolution_mm, double volume_size_mm) {
  validate(refinement);
  validate(options);
  engine_ = std::make_unique<Engine>(refinement, options, resolution_mm, volume_size_mm);
}
IncrementalRefinement::~IncrementalRefinement() = default;

void IncrementalRefinement::insert(std::size_t position, const IncrementalSlice& slice, const Pose& T_brain_slice,
                                   double bright) {
  const torch::NoGradGuard no_grad;
  engine_->insert(position, slice, T_brain_slice, bright);
}

const PoseCandidate& IncrementalRefinement::choose(std::size_t position, const std::vector<PoseCandidate>& candidates) {
  const torch::NoGradGuard no_grad;
  return engine_->choose(position, candidates);
}

std::size_t IncrementalRefinement::find_lost(std::size_t position) {
  const torch::NoGradGuard no_grad;
  return engine_->find_lost(position);
}

void IncrementalRefinement::refine_around(std::size_t position) {
  const torch::NoGradGuard no_grad;
  engine_->refine_around(position);
}

double IncrementalRefinement::sweep() {
  const torch::NoGradGuard no_grad;
  return engine_->sweep();
}

void IncrementalRefinement::measure_uncertainty() {
  const torch::NoGradGuard no_grad;
  engine_->measure_uncertainty();
}

torch::Tensor IncrementalRefinement::volume() {
  const torch::NoGradGuard no_grad;
  return engine_->volume();
}

bool IncrementalRefinement::compares() const { return engine_->compares(); }
double IncrementalRefinement::voxel_mm() const { return engine_->voxel_mm(); }
std::size_t IncrementalRefinement::windows() const { return engine_->windows(); }
void IncrementalRefinement::set(const std::vector<RefinedSlice>& slices) { engine_->set(slices); }
std::size_t IncrementalRefinement::count() const { return engine_->slices().size(); }
const std::vector<RefinedSlice>& IncrementalRefinement::slices() const { return engine_->slices(); }
std::size_t IncrementalRefinement::take_replaced() { return engine_->take_replaced(); }

}  // namespace svort
