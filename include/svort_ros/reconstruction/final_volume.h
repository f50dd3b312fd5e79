#pragma once

#include <torch/types.h>

#include <array>
#include <vector>

#include "svort_ros/acquisition/slice_acquisition.h"

namespace svort {

struct FinalVolumeOptions {
  double resolution_mm = 0.8;  ///< voxel size; below about half the pixel size it only costs time
  int passes = 4;              ///< intensity matching and volume in turn; 0: the PSF reconstruction alone
  int iterations = 5;          ///< conjugate-gradient steps per pass
  /// Weight of the prior against the slices' mean weight per voxel; raise it for noisy slices or few stacks.
  double edge_strength = 0.1;
  double edge = 0.05;         ///< difference between neighbours that counts as an edge, of the 0.99 quantile
  double scale_spread = 0.3;  ///< expected deviation of the log of a slice's intensity; 0: slices are as they should be
  double bias_spread = 0.3;   ///< the same for each term of its smooth field, 60 mm from the slice's centre
  double outlier_factor = 3.;  ///< pixels off by more than so many deviations of their slice count less and less

  template <class Visitor>
  void visit(Visitor&& v) {
    v("resolution_mm", resolution_mm, "voxel size of the final volume, mm");
    v("passes", passes, "times that intensities are matched and the volume is solved for; 0: PSF reconstruction");
    v("iterations", iterations, "conjugate-gradient steps per pass");
    v("edge_strength", edge_strength, "weight of the edge-preserving prior against the slices'");
    v("edge", edge, "difference between neighbouring voxels that counts as an edge, of the 0.99 quantile");
    v("scale_spread", scale_spread, "expected deviation of the log of a slice's intensity; 0: no matching");
    v("bias_spread", bias_spread, "the same for each term of its smooth bias field, 60 mm from the slice's centre");
    v("outlier_factor", outlier_factor, "pixels off by more than so many deviations of their slice count less");
  }
};

/// @throws std::invalid_argument naming the option that is out of range
void validate(const FinalVolumeOptions& options);

/// The log of a slice's intensity against the volume's, as a quadratic of the place in the slice:
/// c0 + c1 u + c2 v + c3 u^2 + c4 u v + c5 v^2, u and v in units of 60 mm from the slice's centre.
using SliceField = std::array<double, 6>;

struct FinalVolume {
  torch::Tensor volume;            ///< D x H x W
  std::vector<SliceField> fields;  ///< one per slice; mean of c0 over slices, by their weights, is 0
  std::vector<double> noise;       ///< one per slice: robust deviation (1.4826 x median) of its pixels from the volume
};

/// The best volume from slices at known poses: conjugate gradients on the paper's inverse problem with an
/// edge-preserving prior (differences of neighbours d cost about |d| beyond `edge`), each slice divided by an intensity
/// field of its own, fitted to the volume in turn with it, and pixels that fit nowhere weighted down (Cauchy).
///
/// A field that all slices share cannot be told from the brain and stays in the volume. Voxels that no slice reaches
/// are 0. Same bytes for any number of threads.
///
/// @param slices   n x 1 x h x w, float32, CPU
/// @param masks    n x 1 x h x w, bool: the brain; also the operator's slice masks
/// @param weights  n, float32, not negative
/// @param pixel_mm edge of a pixel
/// @throws std::invalid_argument naming the argument or option that does not fit
FinalVolume reconstruct_final_volume(const torch::Tensor& slices, const SliceAcquisition& acquisition,
                                     const torch::Tensor& masks, const torch::Tensor& weights, double pixel_mm,
                                     const FinalVolumeOptions& options = {});

}  // namespace svort
