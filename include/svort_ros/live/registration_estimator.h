#pragma once

#include <cstddef>
#include <memory>
#include <optional>
#include <string>
#include <vector>

#include "svort_ros/acquisition/slice_acquisition.h"
#include "svort_ros/live/candidate_source.h"
#include "svort_ros/live/incremental_estimator.h"
#include "svort_ros/live/network_guide.h"

namespace svort {

class ScanSearch;

/// Slices are registered to the volume that they form, the head's motion as one trajectory in acquisition order (see
/// refine_poses), and the whole to a template, if there is one. No trained weights are needed. With those of the live
/// network (NetworkGuide) a head that jumps is found where following loses it, and the canonical frame without a
/// template.
///
/// add() takes the new slice's pose from the head's motion at its neighbour in time and registers it, the newest slices
/// and some of the older ones (IncrementalRefinement), or all slices (update "full"); finalise() registers all of them
/// from the scanner's poses, as a batch run does (register_scan). Poses depend on the slices and their order alone.
///
/// Following loses a head that jumps far. From the second stack on, search_scan() looks again and again for slices that
/// lie elsewhere, in a thread of its own (EstimatorOptions::search_every).
///
/// The brain frame begins with the scanner's axes at the brain's centre. A sure match with a template turns it into the
/// canonical frame, or else the guide's votes do; that, and later corrections of it, are frame revisions, not motion.
/// Between them the frame is held by the poses of the slices that are already there.
class RegistrationEstimator : public IncrementalEstimator {
 public:
  /// @param templates brains in canonical orientation; may be empty
  /// @param source    more candidates for each new slice; may be null
  /// @param guide     the live network; may be null
  /// @throws std::invalid_argument naming the option that is out of range
  RegistrationEstimator(const EstimatorOptions& options, std::vector<BrainTemplate> templates,
                        std::unique_ptr<CandidateSource> source = nullptr,
                        std::unique_ptr<NetworkGuide> guide = nullptr);
  ~RegistrationEstimator() override;

  void add(const SliceSequence& sequence) override;
  void update_volume(const SliceSequence& sequence) override;
  bool improve(const SliceSequence& sequence) override;
  void finalise(const SliceSequence& sequence, const std::atomic<bool>* stop) override;
  void reset() override;
  const Estimate& estimate() const override { return estimate_; }
  const Volume& volume() const override { return volume_; }
  std::string device() const override { return "cpu"; }
  EstimatorNotes notes() const override;

 private:
  std::vector<Pose> crop_poses(const SliceSequence& sequence) const;
  void take(const SliceSequence& sequence, const Refinement& refinement, const std::vector<Pose>& before);
  void add_incrementally(const SliceSequence& sequence, std::size_t position);
  void take_incremental(const SliceSequence& sequence, std::size_t newest);
  void publish_incremental(const SliceSequence& sequence, const Pose& T_brain_engine);
  void search(const SliceSequence& sequence);
  void start_search(const SliceSequence& sequence);
  bool take_found(const SliceSequence& sequence);
  void take_uncertainty();
  void tell_incremental(const SliceSequence& sequence);
  void align(const SliceSequence& sequence, const RegistrationInput& input);
  std::optional<Pose> canonical_frame(const SliceSequence& sequence, const RegistrationInput& input);
  void move_frame(const Pose& T_new_old);

  EstimatorOptions options_;
  AcquisitionFormulation formulation_;
  ImageGrid grid_;
  std::vector<BrainTemplate> templates_;
  std::unique_ptr<CandidateSource> source_;
  std::unique_ptr<NetworkGuide> guide_;
  std::unique_ptr<IncrementalRefinement> incremental_;  ///< null with update "full"
  std::unique_ptr<ScanSearch> search_;
  int search_pause_ = 1;        ///< EstimatorOptions::search_every times this lie between two searches
  std::size_t idle_left_ = 0;   ///< windows that improve() may still register again before the next slice
  double idle_motion_mm_ = 0.;  ///< largest mean motion of a window in this sweep of improve()
  Estimate estimate_;
  Volume volume_;
  bool aligned_ = false;           ///< the frame is the canonical one
  std::size_t aligned_count_ = 0;  ///< slices when that was last tried
};

}  // namespace svort
