#pragma once

#include <atomic>
#include <cstdint>
#include <limits>
#include <memory>
#include <string>
#include <vector>

#include "svort_ros/geometry/image_grid.h"
#include "svort_ros/geometry/pose.h"
#include "svort_ros/network/network_cache_options.h"
#include "svort_ros/reconstruction/final_volume.h"
#include "svort_ros/registration/incremental_refinement.h"
#include "svort_ros/registration/pose_refinement.h"
#include "svort_ros/registration/template_registration.h"
#include "svort_ros/sequence/slice_sequence.h"

namespace svort {

/// Where a slice's pose comes from.
enum class PoseStatus {
  nominal,     ///< the scanner's own prescription; the head is assumed not to have moved
  predicted,   ///< the prescription, moved as the head had moved at the slice before; not registered yet
  registered,  ///< registered to the volume, with the head's motion as one trajectory
  outlier,     ///< registered as well, but the slice fits nowhere: its weight is 0
  network,     ///< a network's answer
};
const char* to_string(PoseStatus status);

/// What is known about one slice at one revision.
struct SliceEstimate {
  SliceInfo info;
  Pose T_brain_slice = Pose::Identity();    ///< slice coordinates into the brain frame, mm
  Pose T_scanner_brain = Pose::Identity();  ///< head pose when this slice was acquired, mm
  double weight = 1.;                       ///< estimated quality, 0 .. 1
  /// Correlation of the slice with itself simulated from the volume, over its brain pixels. NaN until a volume was
  /// estimated with the slice in it. The slice is part of that volume, so this is an upper bound.
  double ncc = 0.;
  PoseStatus status = PoseStatus::nominal;
  std::string reason;  ///< why the weight is 0; empty otherwise
  /// What the slice was registered from: "prediction", "stack begin", "scan begin", "motion goes on", "network" or
  /// "network image"; "search" if it was found elsewhere, at its arrival or since. Empty: it was not.
  std::string start;
  /// 95 % of slices lie closer to their true place than this, relative to the others (root mean square over the head),
  /// mm; see docs/live.md for how it is calibrated. NaN while unknown.
  double radius_95_mm = std::numeric_limits<double>::quiet_NaN();
};

/// Poses whose Estimate::agreement is lower are not to be trusted; docs/live.md says what was measured.
constexpr double kAgreement = 0.88;

/// One published state. All poses belong together; the volume may be from an earlier revision.
struct Estimate {
  std::string scan_id;
  std::uint64_t revision = 0;         ///< counts every change of poses or volume, from 1
  std::uint64_t frame_revision = 0;   ///< counts moves of the brain frame itself, from 0: the head did not move then
  std::vector<SliceEstimate> slices;  ///< in acquisition order
  /// How well the slices agree with each other: correlation of runs of about 8 slices, blurred, with the volume of all
  /// others (coarse_agreement()), of the last volume's poses. Below kAgreement the head has often jumped or turned
  /// farther than could be followed: poses may be far off, by much more than their radii say. NaN: not known yet.
  double agreement = std::numeric_limits<double>::quiet_NaN();
  std::size_t encoded = 0;  ///< slices that a network encoded for this revision
  bool final = false;       ///< set by finalise(), until the next slice
};

/// For the method "network", and for the live network beside the method "registration".
struct NetworkEstimatorOptions {
  /// Method "registration": the live network places the slices coarsely, so that a head that jumps is not lost, and
  /// says where the canonical frame is (NetworkGuide).
  bool guide = false;
  bool candidate = false;             ///< method "registration": the live network says where a new slice may be, too
  std::string weights;                ///< file of weights, see svort_checkpoint; its network is the one that runs
  std::string name;                   ///< if not empty, the network that the file must hold
  std::string when = "scan_end";      ///< "every_arrival" runs it causally, over the slices so far, if there is time
  std::string device = "auto";        ///< "cpu", "cuda", or whichever there is
  std::string precision = "float32";  ///< "tf32" and "bfloat16" are faster on new GPUs, and coarser
  int iterations = 0;                 ///< transformation updates; 0: as many as the network was made for
  /// Of the forward model inside the network. "fast" moves the poses of version 2 by up to 0.4 mm
  /// (docs/performance.md).
  std::string formulation = "exact";
  /// Of the volume that the network sees. Versions 1 and 2 of SVoRT were trained at 0.8 mm.
  double volume_resolution_mm = 0.8;
  NetworkCacheOptions cache;  ///< with `candidate`

  template <class Visitor>
  void visit(Visitor&& v) {
    v("guide", guide, "method registration: the live network finds a head that jumps, and the canonical frame");
    v("candidate", candidate, "method registration: the live network says where a new slice may be, too");
    v("weights", weights, "file of weights; its network is the one that runs");
    v("name", name, "if not empty, the network that the file must hold: v1, v2, ..");
    v("when", when, "scan_end, or every_arrival: causally, over the slices so far");
    v("device", device, "auto (a GPU if there is one), cpu or cuda");
    v("precision", precision, "float32, tf32 (GPU only) or bfloat16: faster and coarser in this order");
    v("iterations", iterations, "transformation updates; 0: as many as the network was made for");
    v("formulation", formulation, "forward model inside the network: exact, or fast, which changes its poses a little");
    v("volume_resolution_mm", volume_resolution_mm, "voxel size of the volume that the network sees, mm");
    v.section("cache", cache);
  }
};

struct EstimatorOptions {
  std::string method = "registration";  ///< which implementation; see make_estimator
  /// How "registration" takes in a slice: "incremental", or "full": all slices are registered again, at a cost that
  /// grows with their number.
  std::string update = "incremental";
  /// "iterations": poses depend on the slices and their order alone, live and in replay. "time": they are improved for
  /// as long as nothing arrives, and depend on the time that leaves.
  std::string budget = "iterations";
  /// "registration", "incremental": slices from the begin of one search for a head that has jumped to the next one,
  /// from the second stack on; 0: none. While searches find nothing, the pauses grow to four times that. With the
  /// budget "iterations" an answer is taken in after so many slices, and waited for if need be; with "time", as soon as
  /// it is there.
  int search_every = 8;
  std::string templates;  ///< folder of NIfTI brains in canonical orientation; empty: the frame has the scanner's axes
  std::string formulation = "fast";  ///< of the forward model; "exact" to match the public implementation to rounding
  /// SliceEstimate::radius_95_mm over what the registration's equations expect; calibrated, see docs/live.md.
  double radius_factor = 1.2;
  double radius_factor_one_stack = 2.5;  ///< the same, while there is one stack
  double volume_resolution_mm = 1.0;     ///< voxel size of the volume
  double volume_size_mm = 128.0;         ///< edge of the cube that is reconstructed, centred on the brain frame
  double recentre_mm = 10.0;             ///< the brain frame moves only when its centre is off by more than this
  int cg_iterations = 0;                 ///< conjugate-gradient steps after the PSF reconstruction, while slices arrive
  NetworkEstimatorOptions network;
  RefinementOptions registration;
  IncrementalOptions incremental;
  TemplateOptions template_match;
  FinalVolumeOptions final_volume;  ///< of finalise()

  template <class Visitor>
  void visit(Visitor&& v) {
    v("method", method, "registration (of slices to the volume), network, or nominal (the scanner's poses, no motion)");
    v("update", update, "how registration takes in a slice: incremental, or full (all slices again)");
    v("budget", budget, "iterations: live as in replay; time: improve poses for as long as nothing arrives");
    v("search_every", search_every, "slices from one search for a head that has jumped to the next; 0: none");
    v("templates", templates, "folder of NIfTI brains in canonical orientation (LPS); empty: scanner's axes");
    v("formulation", formulation, "forward model: fast, or exact (every tap of the slice profile, ten times slower)");
    v("radius_factor", radius_factor, "95 % radius of a pose over its expected error; calibrated");
    v("radius_factor_one_stack", radius_factor_one_stack, "the same, while there is one stack");
    v("volume_resolution_mm", volume_resolution_mm, "voxel size of the volume, mm");
    v("volume_size_mm", volume_size_mm, "edge of the reconstructed cube, mm");
    v("recentre_mm", recentre_mm, "the brain frame moves only when the brain's centre is off by more than this, mm");
    v("cg_iterations", cg_iterations, "conjugate-gradient steps per volume while slices arrive; 0: PSF reconstruction");
    v.section("network", network);
    v.section("registration", registration);
    v.section("incremental", incremental);
    v.section("template_match", template_match);
    v.section("final_volume", final_volume);
  }
};

/// What a user must know about an estimator, beside its options.
struct EstimatorNotes {
  std::string network;                ///< empty: none
  std::string weights_sha256;         ///< of its parameters; empty: none
  std::vector<std::string> warnings;  ///< what makes its poses doubtful, or slow; may grow while it runs
};

/// Turns a growing sequence of slices into poses and a volume. One thread calls it; it keeps no reference to the
/// sequence between calls.
class IncrementalEstimator {
 public:
  virtual ~IncrementalEstimator() = default;

  /// Takes in the sequence's newest slice. Call once per kept slice, in arrival order: the poses depend on that order
  /// and the slices alone, not on when update_volume() is called in between. Quick (no volume is computed).
  virtual void add(const SliceSequence& sequence) = 0;

  /// Estimates the volume (and each slice's ncc) from the current poses.
  virtual void update_volume(const SliceSequence& sequence) = 0;

  /// Improves the poses of slices that are already there, for as long as nothing arrives; quick, call it again.
  /// @return false if there is nothing left to improve
  virtual bool improve(const SliceSequence& /*sequence*/) { return false; }

  /// Brings poses and volume to their best state; called when the scan, or a pause in it, leaves the time. It may take
  /// tens of seconds.
  /// @param stop if not null and set meanwhile: gives up soon, with poses and volume as they were and not final
  virtual void finalise(const SliceSequence& sequence, const std::atomic<bool>* stop) = 0;

  /// Forgets everything; revisions go on counting.
  virtual void reset() = 0;

  virtual const Estimate& estimate() const = 0;
  /// Empty until the first update_volume().
  virtual const Volume& volume() const = 0;
  /// "cpu" or "cuda:0".
  virtual std::string device() const = 0;
  virtual EstimatorNotes notes() const { return {}; }
};

/// @param templates brains that EstimatorOptions::templates names; whoever reads files loads them (see load_templates)
/// @throws std::invalid_argument naming the option if a value is out of range or the method is unknown
/// @throws std::runtime_error naming the file of weights and what is wrong with it
std::unique_ptr<IncrementalEstimator> make_estimator(const EstimatorOptions& options,
                                                     std::vector<BrainTemplate> templates = {});

}  // namespace svort
