#pragma once

#include <vector>

#include "svort_ros/geometry/pose.h"
#include "svort_ros/network/pose_network.h"
#include "svort_ros/sequence/slice_sequence.h"

namespace svort {

/// A sequence as a network takes it, and the way back.
struct SequenceInput {
  NetworkInput input;
  std::vector<Pose> T_slice_window;  ///< the network's image coordinates into slice coordinates: an in-plane shift, mm
};

/// With a common frame, the nominal poses are given relative to the brain's centre in the scanner, intensities are
/// divided by the sequence's scale, and slices are counted as prescribed: what the live network is trained on.
///
/// Without one, every stack is as the public implementation prepares it: its own axes, its origin at the mean of its
/// slices along the normal and at the brain's centre in its largest slice; one in-plane window for the whole stack;
/// intensities divided by the stack's 0.99 quantile; slices counted from the first to the last that is here. What
/// rounding the window to pixels leaves over (less than half a pixel) is in the transform.
///
/// @throws std::invalid_argument if the sequence is empty
SequenceInput network_input(const SliceSequence& sequence, bool common_frame);

/// What network_input() with a common frame says beside the images: `slices` stays undefined.
/// @throws std::invalid_argument if the sequence is empty
NetworkInput network_geometry(const SliceSequence& sequence);

}  // namespace svort
