#pragma once

#include <cstdint>
#include <filesystem>
#include <string>
#include <vector>

#include "svort_ros/decision/decision_engine.h"
#include "svort_ros/live/live_pipeline.h"
#include "svort_ros/simulation/brain_volume.h"
#include "svort_ros/simulation/interactive_scanner.h"

namespace svort {

/// What a simulated operator does about spoilt slices.
enum class RepeatStrategy {
  none,          ///< three stacks, nothing is repeated
  whole_stacks,  ///< after the three, every stack with too many bad slices once more; judged from the images alone
  end_of_stack,  ///< at the end of each stack, its bad slices at their prescribed places; judged from the images alone
  requests,      ///< the planner's requests, as soon as they are made
};
const char* to_string(RepeatStrategy strategy);

struct ClosedLoopOptions {
  InteractiveScannerOptions scanner;
  PipelineOptions pipeline;
  DecisionOptions decision;
  double repeat_stack_share = 0.1;  ///< whole_stacks: bad slices that make a stack bad
  /// Quick settings: slices of 40 x 40 pixels of 3 mm, 4.5 mm thick; volume and registration at 3 mm.
  ClosedLoopOptions();
};

/// One simulated scan from the first slice to the final volume.
struct ClosedLoopResult {
  std::string motion;
  std::uint64_t seed = 0;
  RepeatStrategy strategy = RepeatStrategy::none;
  double scan_s = 0.;         ///< time that the scanner was at work
  int slices = 0;             ///< acquired
  int repeats = 0;            ///< of these, repeated or requested
  double volume_error = 0.;   ///< rms difference from the true brain, after pose and gain, as a share of its rms
  double pose_error_mm = 0.;  ///< mean distance of the anchor points, after one rigid transform
  double complete = 0.;       ///< share of the brain seen well, as estimated
};

/// @throws std::invalid_argument naming what is out of range
ClosedLoopResult run_closed_loop(const BrainVolume& brain, const std::string& motion, std::uint64_t seed,
                                 RepeatStrategy strategy, const ClosedLoopOptions& options);

/// A line per result, with a header.
std::string to_csv(const std::vector<ClosedLoopResult>& results);
/// Mean and standard deviation over the seeds, by motion class and strategy, as Markdown.
std::string to_markdown(const std::vector<ClosedLoopResult>& results);

}  // namespace svort
