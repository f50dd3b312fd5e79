#pragma once

#include <torch/types.h>

#include <cstdint>
#include <string>
#include <vector>

#include "svort_ros/acquisition/slice.h"
#include "svort_ros/geometry/image_grid.h"
#include "svort_ros/simulation/brain_volume.h"
#include "svort_ros/simulation/fetal_motion.h"
#include "svort_ros/simulation/random_stream.h"

namespace svort {

/// A scanner that acquires what it is told, slice by slice, while the head goes on moving.
struct InteractiveScannerOptions {
  int size_px = 64;          ///< width and height of a slice
  double pixel_mm = 2.;      ///< pixel of the slices, and voxel of the brain they are simulated from
  double thickness_mm = 3.;  ///< slice thickness; slices are gapless
  double tr_s = 1.5;         ///< time between slices
  int interleave = 2;        ///< order of acquisition
  double tilt_deg = 8.;      ///< deviation of a stack from the head's axes when it is planned, per axis
  double offset_mm = 4.;     ///< deviation of its centre from the brain's, per axis
  double noise = 0.02;       ///< Rician noise: deviation of its two channels, of the brightest tissue
  double void_share = 0.03;  ///< slices with a signal void although the head rests
  double void_speed = 25.;   ///< a head this fast makes a void with a probability of 63 %, mm/s
  double longest_s = 1800.;  ///< for which the head's motion is made
};

/// What was planned for one stack.
struct StackPrescription {
  int stack = 0;
  int slices = 0;
  Pose T_scanner_middle = Pose::Identity();  ///< of the stack
  Pose slice(int index, double thickness_mm) const;
};

/// Same seed, motion class and commands: the same slices.
class InteractiveScanner {
 public:
  /// @param brain  intensities of any unit, the canonical frame
  /// @param motion name of a motion class
  /// @throws std::invalid_argument naming what is out of range
  InteractiveScanner(const BrainVolume& brain, const std::string& motion, const InteractiveScannerOptions& options,
                     std::uint64_t seed);

  /// Plans stack `number` on the head as it lies now: transverse, coronal, sagittal in turn.
  StackPrescription plan(int number);

  /// Acquires one slice, and takes a repetition time for it.
  Slice acquire(const Pose& T_scanner_slice, int stack, int index, int slices_in_stack);
  /// Lets time pass.
  void wait(double seconds) { time_s_ += seconds; }

  double time_s() const { return time_s_; }
  const InteractiveScannerOptions& options() const { return options_; }

  /// Truth: where the last slice was in the brain, and whether it had a signal void.
  const Pose& true_T_brain_slice() const { return T_brain_slice_; }
  bool voided() const { return voided_; }
  /// Truth: the brain, 1 at its brightest tissue, in the canonical frame.
  const Volume& truth() const { return truth_; }
  const std::vector<std::uint8_t>& truth_mask() const { return truth_mask_; }

 private:
  Pose T_scanner_brain(double time_s) const;

  InteractiveScannerOptions options_;
  torch::Tensor image_, mask_;
  Volume truth_;
  std::vector<std::uint8_t> truth_mask_;
  BrainExtent extent_;
  HeadTrajectory trajectory_;
  Pose T_scanner_start_ = Pose::Identity();
  RandomStream planning_;
  RandomStream damage_;
  double time_s_ = 0.;
  Pose T_brain_slice_ = Pose::Identity();
  bool voided_ = false;
};

}  // namespace svort
