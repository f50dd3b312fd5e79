#pragma once

#include <Eigen/Core>
#include <cstddef>

#include "svort_ros/acquisition/slice.h"

namespace svort {

/// Where the brain is in the scanner, from the masks of the slices so far (nominal poses).
class BrainRoi {
 public:
  /// Adds the brain pixels of one slice. Deterministic: depends on the slices and their order alone.
  void add(const Slice& slice);
  void clear();

  bool empty() const { return weight_ <= 0.; }
  /// Centre of the box around all brain pixels, mm, scanner frame (LPS). Zero while empty.
  Eigen::Vector3d centre() const;
  /// Size of that box along the scanner's axes, mm.
  Eigen::Vector3d extent() const;

 private:
  double weight_ = 0.;
  Eigen::Vector3d lower_ = Eigen::Vector3d::Zero();
  Eigen::Vector3d upper_ = Eigen::Vector3d::Zero();
};

}  // namespace svort
