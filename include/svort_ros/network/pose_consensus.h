#pragma once

#include <torch/types.h>

#include "svort_ros/geometry/anchor_points.h"

namespace svort {

/// What every slice of a scan says about its own place. All tensors float32, CPU, n votes: one per slice, or several,
/// then all slices once, all slices once again, and so on.
struct PoseVotes {
  torch::Tensor nominal;     ///< n x 3 x 4, trans_first, mm: the prescription, in a frame common to a group
  torch::Tensor direct;      ///< n x 9, mm: anchor points in the brain frame
  torch::Tensor mirrored;    ///< n x 9, mm: the same up to a reflection of x; undefined if there is no such head
  torch::Tensor scale;       ///< n, mm: expected error of each vote; undefined means all alike
  torch::Tensor stack;       ///< n, int64: which stack each slice belongs to
  AnchorFrame frame;         ///< that the anchor points belong to
  bool common_frame = true;  ///< the nominal poses of all stacks share one frame; false: only those of one stack do
};

struct ConsensusOptions {
  double robust_mm = 20.;    ///< votes further off than this lose influence; lower it for a well trained network
  int candidates = 48;       ///< slices (spread over the group) whose votes are tried as starting points
  int refined = 6;           ///< best candidates that are refined
  int iterations = 12;       ///< reweighted least-squares steps of each
  double stack_prior = -1.;  ///< negative: one motion per group; else each stack may deviate, in slices
  int views = 5;             ///< directions from which the prescription is shown to the network that votes
  /// What a mm of head motion from slice to slice costs; half the squared error of a slice's vote costs 1 when it is as
  /// large as expected. Higher values hold the head still, and miss jumps.
  double motion_cost = 0.05;

  template <class Visitor>
  void visit(Visitor&& v) {
    v("robust_mm", robust_mm, "votes further off than this lose influence, mm");
    v("candidates", candidates, "slices whose votes are tried as starting points");
    v("refined", refined, "best starting points that are refined");
    v("iterations", iterations, "reweighted least-squares steps of each");
    v("stack_prior", stack_prior,
      "negative: one head pose per scan; else the weight that holds a stack to it, in slices");
    v("views", views, "directions from which the prescription is shown to the network that votes");
    v("motion_cost", motion_cost, "what a mm of head motion from slice to slice costs against the votes");
  }
};

/// The rigid motions from nominal frame to brain frame that agree with most votes.
///
/// A brain is nearly symmetric, so a slice alone often cannot tell itself from its mirror image; the mirror images of
/// all slices, however, do not fit the prescribed geometry together. So each mirrored vote counts with whichever of
/// its two readings is nearer. Starting points are the motions that single votes imply; the best are refined by
/// iteratively reweighted Procrustes fits. Deterministic.
///
/// If the stacks share a frame there is one motion for all; with stack_prior >= 0 each stack then gets its own, held to
/// the common one by that many slices' worth of weight. Stacks without a common frame are solved one by one.
///
/// @return n x 3 x 4, trans_first, mm, float32: for each slice the motion that follows its nominal pose
/// @throws std::invalid_argument naming the tensor or option that does not fit
torch::Tensor pose_consensus(const PoseVotes& votes, const ConsensusOptions& options);

/// The head's motion, slice by slice, that agrees with the votes: pose_consensus() for a head that moves.
///
/// Votes of single slices are off by a centimetre; but the head mostly rests, and its jumps are seen by all slices
/// after them. So what is minimised is the votes' squared errors, robust as in pose_consensus() and relative to their
/// scales, plus motion_cost times the sum of all motions from one slice to the next (rotations at 40 mm): total
/// variation, which lets the head rest and jump rather than drift. Reweighted least squares over all slices together;
/// both robust losses tighten from step to step, so that a jump of centimetres is found from a head at rest.
/// Deterministic.
///
/// @param votes  V x n of them, slices in acquisition order
/// @param start  n x 3 x 4, from pose_consensus()
/// @return n x 3 x 4, trans_first, mm, float32: for each slice the motion that follows its nominal pose
/// @throws std::invalid_argument naming the tensor or option that does not fit
torch::Tensor trajectory_consensus(const PoseVotes& votes, const torch::Tensor& start, const ConsensusOptions& options);

/// Share of the votes that are within robust_mm of where the slices lie after these motions; of `direct` and, in either
/// of its readings, `mirrored`. A frame that few votes agree with may be any.
/// @param motions n x 3 x 4, for all votes or for one of each slice's
double vote_agreement(const PoseVotes& votes, const torch::Tensor& motions, const ConsensusOptions& options);

}  // namespace svort
