#include "svort_ros/live/registration_estimator.h"

#include <torch/types.h>

#include <algorithm>
#include <cmath>
#include <limits>
#include <optional>
#include <stdexcept>
#include <string>
#include <utility>

#include "scan_search.h"
#include "svort_ros/geometry/rigid_fit.h"
#include "svort_ros/live/sequence_tensors.h"
#include "svort_ros/live/volume_update.h"
#include "svort_ros/registration/canonical_frame.h"
#include "svort_ros/registration/scan_registration.h"

namespace svort {
namespace {

constexpr std::size_t kFewestSlices = 4;        // fewer form no volume to register to
constexpr std::size_t kFewestForTemplate = 20;  // about one stack: a rough volume
constexpr std::size_t kSlicesBetweenMatches = 15;
constexpr std::size_t kIdleSweeps = 4;  // after a slice; what they have not moved, the next slices will
constexpr double kMovingMm = 2.;        // from slice to slice; a head that moves less is at rest
constexpr int kLongestSearchPause = 4;
constexpr double kBetterAgreement = 0.003;
constexpr double kElsewhereMm = 5.;                       // what a search moves by more has been found elsewhere
constexpr double kFrameDisagreement = 40. * M_PI / 180.;  // a template's match that lies so far off is not believed
constexpr double kFrameAngle = 3. * M_PI / 180., kFrameShiftMm = 3.;  // smaller corrections are not worth a revision

double half_field_mm(const SliceSequence& sequence) {
  return 0.5 * sequence.options().size_px * sequence.options().resolution_mm;
}

}  // namespace

RegistrationEstimator::RegistrationEstimator(const EstimatorOptions& options, std::vector<BrainTemplate> templates,
                                             std::unique_ptr<CandidateSource> source,
                                             std::unique_ptr<NetworkGuide> guide)
    : options_(options), templates_(std::move(templates)), source_(std::move(source)), guide_(std::move(guide)) {
  svort::validate(options);
  validate(options.registration);
  validate(options.template_match);
  validate(options.incremental);
  if (options.update != "incremental" && options.update != "full")
    throw std::invalid_argument("estimator.update is '" + options.update + "'; known: incremental, full");
  if (source_ && options.update != "incremental")
    throw std::invalid_argument("estimator.update is '" + options.update +
                                "', which knows no candidates; estimator.network.candidate needs incremental");
  if (options.search_every < 0)
    throw std::invalid_argument("estimator.search_every is " + std::to_string(options.search_every) +
                                "; it must be 0 (no search) or more");
  if (options.budget != "iterations" && options.budget != "time")
    throw std::invalid_argument("estimator.budget is '" + options.budget + "'; known: iterations, time");
  formulation_ = acquisition_formulation(options.formulation);
  grid_ = volume_grid(options);
}

RegistrationEstimator::~RegistrationEstimator() = default;

std::vector<Pose> RegistrationEstimator::crop_poses(const SliceSequence& sequence) const {
  std::vector<Pose> poses;
  for (std::size_t i = 0; i < estimate_.slices.size(); ++i)
    poses.push_back(estimate_.slices[i].T_brain_slice * sequence.slices()[i]->T_slice_crop);
  return poses;
}

void RegistrationEstimator::add(const SliceSequence& sequence) {
  estimate_.encoded = 0;
  const auto newest = sequence.newest_arrival();
  if (!newest) throw std::logic_error("RegistrationEstimator::add: the sequence holds no slice");
  const auto& ordered = sequence.slices();
  const auto position = static_cast<std::size_t>(std::find(ordered.begin(), ordered.end(), newest) - ordered.begin());

  SliceEstimate slice;
  slice.info = newest->info;
  slice.ncc = std::numeric_limits<double>::quiet_NaN();
  std::vector<SliceEstimate>& slices = estimate_.slices;
  if (slices.empty()) {
    slice.T_scanner_brain.translation() =
        sequence.brain_roi().empty() ? newest->info.T_scanner_slice.translation() : sequence.brain_roi().centre();
    slice.status = PoseStatus::nominal;
  } else {
    slice.T_scanner_brain = slices[position > 0 ? position - 1 : 0].T_scanner_brain;
    slice.status = PoseStatus::predicted;
  }
  slice.T_brain_slice = slice.T_scanner_brain.inverse() * slice.info.T_scanner_slice;
  slices.insert(slices.begin() + static_cast<std::ptrdiff_t>(position), slice);

  // The origin follows the brain's centre while the first slices show where that is.
  if (!aligned_ && !sequence.brain_roi().empty() && slices.size() > 1) {
    const Eigen::Vector3d centre = slices[position].T_scanner_brain.inverse() * sequence.brain_roi().centre();
    if (centre.norm() > options_.recentre_mm) {
      Pose T_new_old = Pose::Identity();
      T_new_old.translation() = -centre;
      move_frame(T_new_old);
    }
  }
  if (options_.update == "incremental") {
    add_incrementally(sequence, position);
    search(sequence);
  } else if (slices.size() >= kFewestSlices) {
    const std::vector<Pose> start = crop_poses(sequence);
    take(sequence, refine_poses(registration_input(sequence), start, options_.registration, RefinementEffort::warm),
         start);
  }
  const bool stack_began = slices[position].info.stack != slices[position > 0 ? position - 1 : 0].info.stack;
  if (slices.size() >= kFewestForTemplate &&
      (stack_began || (!aligned_ && slices.size() >= aligned_count_ + kSlicesBetweenMatches))) {
    align(sequence, registration_input(sequence));
  }
  if (guide_) estimate_.encoded += guide_->take_encoded();
  estimate_.scan_id = sequence.scan_id();
  estimate_.final = false;
  ++estimate_.revision;
}

void RegistrationEstimator::add_incrementally(const SliceSequence& sequence, std::size_t position) {
  const SliceSequenceOptions& prepared = sequence.options();
  if (!incremental_)
    incremental_ = std::make_unique<IncrementalRefinement>(options_.registration, options_.incremental,
                                                           prepared.resolution_mm, options_.volume_size_mm);
  const PreparedSlice& newest = *sequence.slices()[position];
  std::vector<SliceEstimate>& slices = estimate_.slices;
  IncrementalSlice slice;
  slice.pixels = pixel_tensor(newest)[0][0];
  slice.mask = torch::empty({prepared.size_px, prepared.size_px}, torch::kBool);
  std::transform(newest.mask.begin(), newest.mask.end(), slice.mask.data_ptr<bool>(),
                 [](std::uint8_t value) { return value != 0; });
  slice.T_world_slice = newest.info.T_scanner_slice * newest.T_slice_crop;
  slice.stack = newest.info.stack;
  slice.thickness_mm = newest.info.thickness;
  // The engine's frame is the published one, but for what holding that moved it since.
  Pose T_engine_brain = Pose::Identity();
  if (incremental_->count() > 0) {
    const std::size_t old = position == 0 ? 1 : 0;
    T_engine_brain = incremental_->slices().front().T_brain_slice *
                     (slices[old].T_brain_slice * sequence.slices()[old]->T_slice_crop).inverse();
  }
  const auto start = [&](const Pose& T_scanner_brain) -> Pose {
    return T_engine_brain * T_scanner_brain.inverse() * slice.T_world_slice;
  };
  const Pose predicted = start(slices[position].T_scanner_brain);
  incremental_->insert(position, slice, predicted, sequence.intensity_scale());
  // The head may have gone back to where it was when its stack, or the scan, began.
  std::vector<PoseCandidate> candidates = {{"prediction", predicted}};
  const auto same_stack = [&](const SliceEstimate& each) { return each.info.stack == newest.info.stack; };
  const auto began = std::find_if(slices.begin(), slices.end(), same_stack);
  for (const auto& [name, where] : {std::pair{"stack begin", began}, std::pair{"scan begin", slices.begin()}})
    if (where != slices.begin() + static_cast<std::ptrdiff_t>(position))
      candidates.push_back({name, start(where->T_scanner_brain)});
  // Or it goes on turning as it did between the two slices before.
  if (position >= 2 && slices[position - 2].info.stack == newest.info.stack) {
    const Pose& before = slices[position - 1].T_scanner_brain;
    const Pose on = before * slices[position - 2].T_scanner_brain.inverse() * before;
    if (plane_distance(start(on), predicted, options_.registration.lever_mm) > kMovingMm)
      candidates.push_back({"motion goes on", start(on)});
  }
  if (source_) {
    for (PoseCandidate& candidate : source_->propose(sequence, position, *incremental_))
      candidates.push_back(std::move(candidate));
    estimate_.encoded += source_->take_encoded();
  }
  slices[position].start = incremental_->choose(position, candidates).name;
  for (std::size_t moved = incremental_->find_lost(position); moved > 0; --moved)
    slices[position + 1 - moved].start = "search";
  if (slices[position].start == "search" || incremental_->slices()[position].weight == 0.) search_pause_ = 1;
  incremental_->refine_around(position);
  for (int i = 0; i < options_.incremental.sweeps; ++i) incremental_->sweep();
  take_incremental(sequence, position);
  idle_left_ = kIdleSweeps * incremental_->windows();
  idle_motion_mm_ = 0.;
}

void RegistrationEstimator::take_incremental(const SliceSequence& sequence, std::size_t newest) {
  // The slices that were here hold the frame where it was.
  std::vector<Pose> before, after;
  for (std::size_t i = 0; i < estimate_.slices.size(); ++i) {
    if (i == newest) continue;
    before.push_back(estimate_.slices[i].T_brain_slice * sequence.slices()[i]->T_slice_crop);
    after.push_back(incremental_->slices()[i].T_brain_slice);
  }
  publish_incremental(sequence, before.empty() ? Pose::Identity() : fit_planes(after, before, half_field_mm(sequence)));
}

void RegistrationEstimator::publish_incremental(const SliceSequence& sequence, const Pose& T_brain_engine) {
  const bool registered = estimate_.slices.size() >= kFewestSlices;
  for (std::size_t i = 0; i < estimate_.slices.size(); ++i) {
    SliceEstimate& slice = estimate_.slices[i];
    const RefinedSlice& refined = incremental_->slices()[i];
    slice.T_brain_slice = T_brain_engine * refined.T_brain_slice * sequence.slices()[i]->T_slice_crop.inverse();
    slice.T_scanner_brain = slice.info.T_scanner_slice * slice.T_brain_slice.inverse();
    if (!registered) continue;
    slice.weight = refined.weight;
    slice.reason = refined.reason;
    slice.status = refined.weight > 0. ? PoseStatus::registered : PoseStatus::outlier;
  }
  take_uncertainty();
}

void RegistrationEstimator::search(const SliceSequence& sequence) {
  if (options_.search_every == 0 || !incremental_->compares()) return;
  if (!search_) search_ = std::make_unique<ScanSearch>();
  const auto waited = [&](int times) {
    return sequence.slices().size() >= search_->count() + static_cast<std::size_t>(times * options_.search_every);
  };
  if (search_->started()) {
    // Counted, its answer is waited for; timed, it comes when it comes.
    if (options_.budget == "time" ? !search_->ready() : !waited(1)) return;
    // The next one can wait while there is nothing to be found.
    search_pause_ = take_found(sequence) ? 1 : std::min(2 * search_pause_, kLongestSearchPause);
  }
  if (waited(search_pause_)) start_search(sequence);
}

void RegistrationEstimator::start_search(const SliceSequence& sequence) {
  std::vector<Pose> followed;
  for (const RefinedSlice& slice : incremental_->slices()) followed.push_back(slice.T_brain_slice);
  const std::vector<Pose> guess = guide_ ? guide_->place(sequence) : std::vector<Pose>();
  search_->start(sequence, followed, guess, options_.volume_size_mm, options_.registration, options_.template_match);
}

bool RegistrationEstimator::take_found(const SliceSequence& sequence) {
  const std::optional<FoundPoses> found = search_->take();
  if (!found) return false;
  const auto& ordered = sequence.slices();
  const std::vector<RefinedSlice> followed = incremental_->slices();
  const std::vector<Pose> published = crop_poses(sequence);
  const Pose T_brain_engine = published.front() * followed.front().T_brain_slice.inverse();

  std::vector<Pose> before, after;
  std::vector<std::size_t> since;  // arrived since the search began
  std::size_t next = 0;
  for (std::size_t i = 0; i < ordered.size(); ++i) {
    if (next < found->slices.size() && ordered[i] == found->slices[next]) {
      before.push_back(followed[i].T_brain_slice);
      after.push_back(found->poses[next++].T_brain_slice);
    } else {
      since.push_back(i);
    }
  }
  // Most slices are where they were, up to the frame: they hold it, those that were found elsewhere do not.
  const Pose held = fit_most_planes(after, before, half_field_mm(sequence));
  // Those that have arrived since go along with the slice before them, or have been followed better than that.
  std::vector<RefinedSlice> moved = followed;
  Pose motion = Pose::Identity();
  next = 0;
  for (std::size_t i = 0, k = 0; i < moved.size(); ++i) {
    if (k < since.size() && since[k] == i) {
      moved[i].T_brain_slice = motion * moved[i].T_brain_slice;
      ++k;
    } else {
      moved[i] = found->poses[next++];
      moved[i].T_brain_slice = held * moved[i].T_brain_slice;
      motion = moved[i].T_brain_slice * followed[i].T_brain_slice.inverse();
    }
  }
  std::vector<RefinedSlice> stayed = moved;
  for (const std::size_t i : since) stayed[i] = followed[i];
  // Following has gone on, and may have found by itself what the search did.
  const RegistrationInput input = registration_input(sequence);
  const auto agreement = [&](const std::vector<RefinedSlice>& at) {
    std::vector<Pose> poses;
    for (const RefinedSlice& slice : at) poses.push_back(slice.T_brain_slice);
    return coarse_agreement(input, poses);
  };
  const double followed_agreement = agreement(followed), moved_agreement = agreement(moved),
               stayed_agreement = agreement(stayed);
  if (std::max(moved_agreement, stayed_agreement) < followed_agreement + kBetterAgreement) return false;
  const std::vector<RefinedSlice>& slices = moved_agreement > stayed_agreement ? moved : stayed;
  const std::vector<RefinedSlice>& others = moved_agreement > stayed_agreement ? stayed : moved;
  incremental_->set(slices);
  for (const std::size_t i : since) {
    incremental_->choose(i, {{"search", slices[i].T_brain_slice}, {"prediction", others[i].T_brain_slice}});
    incremental_->find_lost(i);
    incremental_->refine_around(i);
  }
  incremental_->measure_uncertainty();
  for (std::size_t i = 0; i < slices.size(); ++i)
    if (plane_distance(incremental_->slices()[i].T_brain_slice, followed[i].T_brain_slice, half_field_mm(sequence)) >
        kElsewhereMm)
      estimate_.slices[i].start = "search";
  publish_incremental(sequence, T_brain_engine);
  return true;
}

void RegistrationEstimator::take_uncertainty() {
  std::vector<SliceEstimate>& slices = estimate_.slices;
  const bool one_stack = std::all_of(slices.begin(), slices.end(), [&](const SliceEstimate& slice) {
    return slice.info.stack == slices.front().info.stack;
  });
  const double factor = one_stack ? options_.radius_factor_one_stack : options_.radius_factor;
  for (std::size_t i = 0; i < slices.size(); ++i) slices[i].radius_95_mm = factor * incremental_->slices()[i].sigma_mm;
}

void RegistrationEstimator::tell_incremental(const SliceSequence& sequence) {
  std::vector<RefinedSlice> slices = incremental_->slices();
  const std::vector<Pose> poses = crop_poses(sequence);
  for (std::size_t i = 0; i < slices.size(); ++i) {
    slices[i].T_brain_slice = poses[i];
    slices[i].weight = estimate_.slices[i].weight;
    slices[i].reason = estimate_.slices[i].reason;
  }
  incremental_->set(slices);
}

bool RegistrationEstimator::improve(const SliceSequence& sequence) {
  if (!incremental_ || options_.budget != "time" || estimate_.final) return false;
  if (search_ && search_->ready() && take_found(sequence)) {
    ++estimate_.revision;
    idle_left_ = kIdleSweeps * incremental_->windows();
    idle_motion_mm_ = 0.;
    return true;
  }
  if (idle_left_ == 0) {
    if (search_ && !search_->started() && sequence.slices().size() > search_->count()) start_search(sequence);
    return false;
  }
  const std::size_t windows = incremental_->windows();
  idle_motion_mm_ = std::max(idle_motion_mm_, incremental_->sweep());
  // After a whole sweep that moved nothing there is nothing to gain.
  if (--idle_left_ % windows == 0 && std::exchange(idle_motion_mm_, 0.) <= options_.registration.convergence_mm)
    idle_left_ = 0;
  take_incremental(sequence, estimate_.slices.size());
  ++estimate_.revision;
  return idle_left_ > 0;
}

void RegistrationEstimator::take(const SliceSequence& sequence, const Refinement& refinement,
                                 const std::vector<Pose>& before) {
  // Registration sees relative motion only: the slices that were here hold the frame where it was.
  std::vector<Pose> after;
  for (const RefinedSlice& each : refinement.slices) after.push_back(each.T_brain_slice);
  const Pose held = fit_planes(after, before, half_field_mm(sequence));
  for (std::size_t i = 0; i < estimate_.slices.size(); ++i) {
    SliceEstimate& slice = estimate_.slices[i];
    const RefinedSlice& refined = refinement.slices[i];
    slice.T_brain_slice = held * refined.T_brain_slice * sequence.slices()[i]->T_slice_crop.inverse();
    slice.T_scanner_brain = slice.info.T_scanner_slice * slice.T_brain_slice.inverse();
    slice.weight = refined.weight;
    slice.reason = refined.reason;
    slice.status = refined.weight > 0. ? PoseStatus::registered : PoseStatus::outlier;
  }
}

void RegistrationEstimator::move_frame(const Pose& T_new_old) {
  for (SliceEstimate& slice : estimate_.slices) {
    slice.T_brain_slice = T_new_old * slice.T_brain_slice;
    slice.T_scanner_brain = slice.T_scanner_brain * T_new_old.inverse();
  }
  ++estimate_.frame_revision;
  if (!incremental_) return;
  std::vector<RefinedSlice> slices = incremental_->slices();
  for (RefinedSlice& slice : slices) slice.T_brain_slice = T_new_old * slice.T_brain_slice;
  incremental_->set(slices);
  if (source_) source_->move_frame(T_new_old);
}

void RegistrationEstimator::align(const SliceSequence& sequence, const RegistrationInput& input) {
  aligned_count_ = estimate_.slices.size();
  const std::optional<Pose> T_canonical_brain = canonical_frame(sequence, input);
  if (!T_canonical_brain) return;
  const bool small =
      rotation_angle(*T_canonical_brain) < kFrameAngle && T_canonical_brain->translation().norm() < kFrameShiftMm;
  if (!aligned_ || !small) move_frame(*T_canonical_brain);
  aligned_ = true;
}

std::optional<Pose> RegistrationEstimator::canonical_frame(const SliceSequence& sequence,
                                                           const RegistrationInput& input) {
  const std::vector<Pose> poses = crop_poses(sequence);
  std::optional<Pose> voted;
  if (guide_) {
    const NetworkGuide::Frame frame = guide_->find_frame(sequence, poses);
    if (frame.agreement >= kFrameAgreement) voted = frame.T_canonical_brain;
  }
  std::vector<double> weights;
  for (const SliceEstimate& slice : estimate_.slices) weights.push_back(slice.weight);
  const auto match =
      find_canonical_frame(input, poses, weights, templates_, options_.volume_size_mm, options_.template_match);
  if (!match || !match->sure) return voted;
  const bool contradicted = voted && rotation_angle(voted->inverse() * match->T_template_volume) > kFrameDisagreement;
  return contradicted ? *voted : match->T_template_volume;
}

void RegistrationEstimator::update_volume(const SliceSequence& sequence) {
  volume_ = estimate_volume(sequence, grid_, formulation_, options_.cg_iterations, &estimate_.slices);
  estimate_.agreement = agreement_of(sequence, estimate_.slices);
  ++estimate_.revision;
}

void RegistrationEstimator::finalise(const SliceSequence& sequence, const std::atomic<bool>* stop) {
  if (search_) search_->give_up();
  if (estimate_.slices.size() >= kFewestSlices) {
    const RegistrationInput input = registration_input(sequence);
    const std::vector<Pose> current = crop_poses(sequence);
    // From the scanner's poses, and from where the network places the slices, so that the end does not depend on the
    // way; `take` brings it into the frame that is there.
    const Refinement end = register_scan(input, registration_starts(input, guide_.get(), sequence),
                                         options_.volume_size_mm, options_.registration, options_.template_match, stop);
    if (stop && stop->load()) return;
    take(sequence, end, current);
    if (incremental_) {
      tell_incremental(sequence);
      incremental_->measure_uncertainty();
      take_uncertainty();
    }
    align(sequence, input);
  }
  volume_ = estimate_final_volume(sequence, options_, &estimate_.slices);
  estimate_.agreement = agreement_of(sequence, estimate_.slices);
  estimate_.final = true;
  ++estimate_.revision;
}

EstimatorNotes RegistrationEstimator::notes() const {
  if (guide_) return guide_->notes();  // of the same file as the source's
  return source_ ? source_->notes() : EstimatorNotes();
}

void RegistrationEstimator::reset() {
  const std::uint64_t revision = estimate_.revision;
  estimate_ = Estimate();
  estimate_.revision = revision;
  volume_ = Volume();
  incremental_.reset();
  if (search_) search_->give_up();
  search_pause_ = 1;
  if (source_) source_->reset();
  idle_left_ = 0;
  aligned_ = false;
  aligned_count_ = 0;
}

}  // namespace svort
