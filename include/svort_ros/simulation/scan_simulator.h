#pragma once

#include <torch/types.h>

#include <cstdint>
#include <map>
#include <string>
#include <vector>

#include "svort_ros/network/pose_network.h"
#include "svort_ros/simulation/anatomy.h"
#include "svort_ros/simulation/artifacts.h"
#include "svort_ros/simulation/brain_volume.h"
#include "svort_ros/simulation/fetal_motion.h"
#include "svort_ros/simulation/scanner.h"

namespace svort {

struct SimulatorOptions {
  std::string motion = "mixed";      ///< a motion class, or mixed: mild, moderate or severe by chance
  int size_px = 64;                  ///< width and height of a slice
  double resolution_mm = 2.;         ///< pixel size
  std::string formulation = "fast";  ///< of the forward model: fast or exact
  /// As the live sequence prepares slices: cropped to the mask, slices without brain left out. Otherwise the slices are
  /// whole, as the scanner makes them.
  bool prepared = true;
  double min_brain_mm2 = 16.;  ///< prepared slices with less brain are left out
  int anatomies = 8;           ///< brains that are in use at a time; each costs memory
  int scans_per_anatomy = 4;   ///< scans of a brain before it is replaced; a brain costs about as much time as a scan
  ScannerOptions scanner;
  ArtifactOptions artifacts;
  AnatomyOptions anatomy;

  template <class Visitor>
  void visit(Visitor&& v) {
    v("motion", motion, "motion class: none, mild, moderate, severe, or mixed (one of the last three by chance)");
    v("size_px", size_px, "width and height of a slice, pixels");
    v("resolution_mm", resolution_mm, "pixel size, mm");
    v("formulation", formulation, "forward model: fast or exact");
    v("prepared", prepared, "crop slices to the mask and leave out those without brain, as the live sequence does");
    v("min_brain_mm2", min_brain_mm2, "prepared slices with less brain than this are left out, mm^2");
    v("anatomies", anatomies, "brains in use at a time");
    v("scans_per_anatomy", scans_per_anatomy, "scans of a brain before it is replaced");
    v.section("scanner", scanner);
    v.section("artifacts", artifacts);
    v.section("anatomy", anatomy);
  }
};

/// One scan: what a network sees and what it should say. Tensors are on the simulator's device; n is the number of
/// slices, in acquisition order.
struct SimulatedScan {
  std::uint64_t number = 0;
  std::size_t volume_index = 0;  ///< which of the given volumes the brain is made of
  std::string motion;            ///< motion class
  /// transforms: nominal poses. Protocol "scanner": in the scanner's axes around the brain's centre, the middle of the
  /// box around the masks of these slices. Protocol "uniform": each stack in its own frame.
  NetworkInput input;
  torch::Tensor masks;          ///< n x 1 x h x w, bool
  torch::Tensor truth;          ///< n x 3 x 4, trans_first, mm: slice -> canonical brain frame
  torch::Tensor volume;         ///< D x H x W, the brain, in the slices' intensity
  torch::Tensor displaced;      ///< n, bool: the head moved since the stack was planned, see ScannerOptions
  torch::Tensor voided;         ///< n, bool: signal void
  torch::Tensor noisy;          ///< n, bool: much more noise than the others
  std::vector<bool> dropped;    ///< whole slices only, n: never arrives, black here. Prepared ones are left out
  ScanPlan plan;                ///< `acquired` holds the n slices; poses are those of the cropped slices
  double intensity_scale = 1.;  ///< slices and volume were divided by this (protocol of the live sequence)
};

/// Makes scans of brains, in batches, on CPU or GPU. Not thread-safe: one owner.
///
/// Scan k depends on the seed, k and the options alone, not on what was made before. In another batch its images may
/// differ by rounding.
class ScanSimulator {
 public:
  /// @param grid of SimulatedScan::volume; slices are simulated from a volume on this grid, so its voxels should not be
  ///             larger than the pixels
  /// @throws std::invalid_argument naming the volume or the option that does not fit
  ScanSimulator(const std::vector<BrainVolume>& volumes, const NetworkGrid& grid, const SimulatorOptions& options,
                std::uint64_t seed, torch::Device device = torch::kCPU);

  /// Scans first .. first + count - 1, each of at least one slice.
  std::vector<SimulatedScan> simulate(std::uint64_t first, int count);

  const SimulatorOptions& options() const { return options_; }
  const NetworkGrid& grid() const { return grid_; }

 private:
  const Anatomy& anatomy_of(std::uint64_t number);
  std::uint64_t anatomy_number(std::uint64_t scan) const;

  NetworkGrid grid_;
  SimulatorOptions options_;
  std::uint64_t seed_;
  torch::Device device_;
  AnatomySource source_;
  std::map<std::uint64_t, Anatomy> anatomies_;
};

}  // namespace svort
