#pragma once

#include "svort_ros/registration/pose_refinement.h"

namespace svort {

/// Weight of a slice in the reconstruction from its ncc (ncc^4), or 0 and the reason.
void weigh_slice(double outlier_ncc, RefinedSlice* slice);

}  // namespace svort
