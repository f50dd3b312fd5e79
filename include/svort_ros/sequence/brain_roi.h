#pragma once

#include <Eigen/Core>
#include <cstddef>

#include "svort_ros/acquisition/slice.h"

namespace svort {

/// Where the brain is in the scanner, from the masks of the slices so far (nominal poses).
///
/// Slices without a mask only count as long as no slice with one is here: they place the box around the whole images,
/// which is a poor guess of the brain but not an arbitrary one. The order of the slices does not matter.
class BrainRoi {
 public:
  /// Adds the brain pixels of one slice (a pixel is a box of its spacing and the slice's thickness), or all pixels if
  /// the slice has no mask. The slice must be well-formed.
  void add(const Slice& slice);
  void clear();

  bool empty() const { return masked_.empty && unmasked_.empty; }
  /// True once a slice with a mask is in.
  bool from_masks() const { return !masked_.empty; }
  /// Centre of the box around all brain pixels, mm, scanner frame (LPS). Zero while empty.
  Eigen::Vector3d centre() const;
  /// Size of that box along the scanner's axes, mm. Zero while empty.
  Eigen::Vector3d extent() const;

 private:
  struct Box {
    bool empty = true;
    Eigen::Vector3d lower = Eigen::Vector3d::Zero();
    Eigen::Vector3d upper = Eigen::Vector3d::Zero();
  };
  const Box& box() const { return masked_.empty ? unmasked_ : masked_; }

  Box masked_;
  Box unmasked_;
};

}  // namespace svort
