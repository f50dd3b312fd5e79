#pragma once

#include <cstdint>
#include <filesystem>
#include <limits>
#include <string>
#include <vector>

#include "svort_ros/evaluation/evaluation_scan.h"
#include "svort_ros/live/incremental_estimator.h"
#include "svort_ros/live/live_pipeline.h"

namespace svort {

/// How poses are found.
enum class PoseSource {
  nominal,       ///< the scanner's
  stacks,        ///< stack stage of registration
  registration,  ///< both stages, from the scanner's poses
  network,       ///< a network over the whole scan
  live,          ///< slice by slice through the live classes: the pose that was published for each at its arrival
};

/// A row of the table of methods.
struct PoseMethod {
  std::string name;
  PoseSource source = PoseSource::registration;
  std::string weights;       ///< file, for a network; registration and live: that of the live network as a guide
  bool refined = false;      ///< registration afterwards, started from these poses ("SVR")
  bool with_volume = false;  ///< reconstruct volumes from these poses and compare them with the truth
};

/// Whether low agreement (kAgreement) tells poses that are far off. Live, all slices from when it is known.
struct AgreementScore {
  std::size_t far = 0, far_warned = 0;    ///< slices off by more than 10 mm at their arrival; those with a warning
  std::size_t near = 0, near_warned = 0;  ///< by less than 3 mm
};

/// Errors of poses in one canonical frame.
struct FrameScore {
  double ed_mm = std::numeric_limits<double>::quiet_NaN(), gd_rad = std::numeric_limits<double>::quiet_NaN();
  double median_ed_mm = std::numeric_limits<double>::quiet_NaN();
  /// Rotation (rad) that would bring all poses together closest to the truth: a flip of the brain is an angle near pi.
  double frame_rad = std::numeric_limits<double>::quiet_NaN();
  bool sure = false;  ///< what TemplateMatch says; true for a network
};

/// Similarity of a volume and the truth, over the brain, after the gain that fits best.
struct VolumeScore {
  double psnr_db = std::numeric_limits<double>::quiet_NaN(), ssim = std::numeric_limits<double>::quiet_NaN();
};

/// How often poses are within the radius that was published with them.
struct RadiusScore {
  std::size_t slices = 0, within = 0;  ///< registered, with a radius; those whose error is smaller
  double ratio_95 = std::numeric_limits<double>::quiet_NaN();  ///< 0.95 quantile of error over radius: 1 is right
};

/// One scan, one method.
struct AccuracyRow {
  std::string brain, motion, masks;  ///< masks: "usual" or "damaged"
  std::uint64_t number = 0;
  int stacks = 0;
  std::string method;
  std::size_t slices = 0;  ///< kept by the sequence
  double relative_ed_mm = std::numeric_limits<double>::quiet_NaN();
  double relative_median_ed_mm = std::numeric_limits<double>::quiet_NaN();
  double relative_gd_rad = std::numeric_limits<double>::quiet_NaN();
  FrameScore atlas, shipped;  ///< templates: brains of other ages; the one that is shipped. A network: atlas only
  FrameScore guide;           ///< the canonical frame that the live network finds for registered slices
  VolumeScore psf, final;     ///< PSF reconstruction; the final volume
  double seconds = 0.;        ///< for the poses, without the frame and volumes
  double p95_ms = std::numeric_limits<double>::quiet_NaN();  ///< live: arrival to pose, from 80 slices on
  bool converged = true;
  /// Live: causal poses, relative to the other slices as they were at that moment, in the first stack and from the
  /// second on.
  RadiusScore radius_one_stack, radius;
  AgreementScore agreement;
  std::size_t network_starts = 0;  ///< live: slices that were registered from where the network had put them
  std::size_t search_starts = 0;   ///< live: slices that a search found, when the last one had arrived
  /// Live: relative ED of all slices, first stack included, as they had been followed when the last one had arrived.
  double followed_ed_mm = std::numeric_limits<double>::quiet_NaN();
};

/// Everything but the scan.
struct AccuracySetup {
  PipelineOptions pipeline;
  std::vector<BrainTemplate> atlas, shipped;
};

/// Runs one method on one scan and scores it.
/// @throws std::runtime_error naming the file of weights and what is wrong with it
AccuracyRow measure_accuracy(const EvaluationScan& scan, const PoseMethod& method, const AccuracySetup& setup);

}  // namespace svort
