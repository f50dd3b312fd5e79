#include "svort_ros/evaluation/left_out.h"

#include <cmath>
#include <limits>
#include <vector>

#include "svort_ros/live/volume_update.h"

namespace svort {
namespace {

double mean_of_stack(const std::vector<SliceEstimate>& slices, int stack) {
  double sum = 0.;
  int count = 0;
  for (const SliceEstimate& slice : slices) {
    if (slice.info.stack != stack || !std::isfinite(slice.ncc)) continue;
    sum += slice.ncc;
    ++count;
  }
  return count > 0 ? sum / count : std::numeric_limits<double>::quiet_NaN();
}

}  // namespace

std::map<int, StackCorrelation> stack_correlations(const LivePipeline& scan) {
  std::map<int, StackCorrelation> stacks;
  const std::vector<SliceEstimate>& slices = scan.estimate().slices;
  for (const SliceEstimate& slice : slices) ++stacks[slice.info.stack].slices;
  const EstimatorOptions& options = scan.options().estimator;
  for (auto& [stack, correlation] : stacks) {
    correlation.with_all = mean_of_stack(slices, stack);
    correlation.with_others = std::numeric_limits<double>::quiet_NaN();
    if (stacks.size() < 2) continue;
    // Slices of weight 0 are compared with the volume, and give nothing to it.
    std::vector<SliceEstimate> others = slices;
    for (SliceEstimate& slice : others)
      if (slice.info.stack == stack) slice.weight = 0.;
    estimate_volume(scan.sequence(), volume_grid(options), acquisition_formulation(options.formulation), 0, &others);
    correlation.with_others = mean_of_stack(others, stack);
  }
  return stacks;
}

}  // namespace svort
