#pragma once

#include <map>

#include "svort_ros/live/live_pipeline.h"

namespace svort {

/// Correlation of slices with volumes, by stack.
struct StackCorrelation {
  double with_all = 0.;     ///< mean ncc of the stack's slices with the volume of all slices: an upper bound
  double with_others = 0.;  ///< the same with the PSF reconstruction of the other stacks alone; NaN with one stack
  std::size_t slices = 0;
};

/// How well the poses of a scan fit together, without any truth: a slice is predicted from the stacks it is not in.
/// @param scan after finalise()
/// @return by stack; means over slices whose correlation is defined
std::map<int, StackCorrelation> stack_correlations(const LivePipeline& scan);

}  // namespace svort
