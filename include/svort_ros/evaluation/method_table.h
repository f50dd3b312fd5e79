#pragma once

#include <cstdint>
#include <limits>
#include <memory>
#include <string>
#include <vector>

#include "svort_ros/evaluation/accuracy.h"
#include "svort_ros/network/network_runner.h"

namespace svort {

// The paper's table of methods (sec. 3, Table 1): poses of one method on one scan, before and after registration.

/// A method of the table.
struct TableMethod {
  std::string name;
  PoseSource source = PoseSource::network;  ///< nominal, registration or network
  bool search = false;                      ///< source registration: register_scan(), not refine_poses() alone
  /// Source registration, with search: weights of the live network that guides it and finds the canonical frame. Empty:
  /// no network, and the frame is found with templates.
  std::string guide;
  std::shared_ptr<NetworkRunner> network;  ///< of source network
  int iterations = 0;                      ///< K of the network; 0: as many as it was made for
  std::string weights_sha256;              ///< of the network's parameters; empty: none
};

/// What is measured beside the poses' errors; each costs time.
struct TableExtent {
  bool refined = true;   ///< the same after registration, which starts from the method's poses
  bool volumes = true;   ///< similarity of volumes and slices
  bool prefixes = true;  ///< errors while the scan was going on
};

/// What tells the scores of one table apart.
struct TableKey {
  std::string method, weights;  ///< weights: beginning of their SHA-256
  int iterations = 0;
  std::string protocol, brain, motion;
  std::uint64_t seed = 0, number = 0;
  int stacks = 0;
};

/// Means over the slices of a scan.
struct MethodScore {
  double ed_mm = std::numeric_limits<double>::quiet_NaN(), gd_rad = std::numeric_limits<double>::quiet_NaN();
  double relative_ed_mm = std::numeric_limits<double>::quiet_NaN();
  double relative_gd_rad = std::numeric_limits<double>::quiet_NaN();
  /// Slices of the true volume at these poses, compared with those at the true poses, over the pixels where either
  /// shows brain; the range of the values is that of all true slices of the scan.
  double slice_psnr_db = std::numeric_limits<double>::quiet_NaN();
  double slice_ssim = std::numeric_limits<double>::quiet_NaN();
  bool sure = false;  ///< what TemplateMatch says; true for a network
};

/// One method on one scan.
struct TableScore : TableKey {
  std::size_t slices = 0;    ///< kept by the sequence
  MethodScore own, refined;  ///< ED and GD: in the canonical frame, found with a template for methods that know none
  /// From the method's poses, in the frame that fits them best: PSF reconstruction; conjugate gradients from it, all
  /// slices alike; and with the method's weights.
  VolumeScore psf, unweighted, weighted;
  VolumeScore refined_volume;  ///< the final volume after registration
  double seconds = 0.;         ///< for the method's poses
  double refined_seconds = 0.;
  bool converged = true;  ///< registration
};

/// One slice of it.
struct TableSlice : TableKey {
  int stack = 0, slice = 0;
  double distance_mm = 0.;  ///< of its plane from the brain's centre, in truth
  double ed_mm = std::numeric_limits<double>::quiet_NaN();
  double relative_ed_mm = std::numeric_limits<double>::quiet_NaN();
  double refined_relative_ed_mm = std::numeric_limits<double>::quiet_NaN();
};

/// The scan when that many slices had been seen: errors of those. Registration is causal here, as in live use, and
/// without a template.
struct TablePrefix : TableKey {
  std::size_t seen = 0;
  double ed_mm = std::numeric_limits<double>::quiet_NaN();
  double relative_ed_mm = std::numeric_limits<double>::quiet_NaN();
};

/// What pictures show. Volumes: D x H x W, LPS.
struct TablePictures {
  torch::Tensor truth, psf, unweighted, weighted;
  torch::Tensor attention;  ///< heads x n x n, of the network's last layer; undefined if it has none
  std::vector<int> stacks;  ///< of each of the n slices
};

struct TableResult {
  TableScore score;
  std::vector<TableSlice> slices;
  std::vector<TablePrefix> prefixes;
  TablePictures pictures;
};

/// The key that a method's scores on such a scan have.
TableKey table_key(const TableMethod& method, const std::string& brain, const EvaluationScanOptions& scan);

/// Runs one method on one scan.
///
/// The network sees what the live system would give it at the end of the scan (or of a part of it). Registration starts
/// (refine_poses()) from the method's poses; its rows of its own start from the scanner's. Templates:
/// AccuracySetup::atlas.
/// @throws std::invalid_argument naming the option that does not fit
TableResult measure_method(const EvaluationScan& scan, const TableMethod& method, const AccuracySetup& setup,
                           const TableExtent& extent = {});

}  // namespace svort
