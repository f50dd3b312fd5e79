#include "svort_ros/evaluation/evaluation_scan.h"

#include <torch/types.h>

#include <stdexcept>

#include "svort_ros/simulation/scan_simulator.h"
#include "svort_ros/simulation/scan_slices.h"

namespace svort {

EvaluationScan simulate_evaluation_scan(const BrainVolume& brain, const EvaluationScanOptions& options) {
  constexpr int kStacks = 3;
  if (options.stacks < 1 || options.stacks > kStacks)
    throw std::invalid_argument("evaluation: stacks is " + std::to_string(options.stacks) + "; it must be 1 to 3");
  SimulatorOptions simulator;
  simulator.motion = options.motion;
  simulator.size_px = 128;
  simulator.resolution_mm = 1.;
  simulator.prepared = false;
  simulator.anatomies = simulator.scans_per_anatomy = 1;
  simulator.anatomy = no_anatomy_variation();
  simulator.scanner.protocol = options.protocol;
  simulator.scanner.stacks_min = simulator.scanner.stacks_max = kStacks;
  if (options.damaged_masks) {
    simulator.artifacts.mask_lost_share = 0.15;
    simulator.artifacts.mask_cut_share = 0.25;
    simulator.artifacts.mask_eroded_share = 0.2;
  }
  EvaluationScan scan;
  NetworkGrid grid;
  grid.resolution_mm = scan.voxel_mm;
  grid.volume_shape.fill(160);
  ScanSimulator source({brain}, grid, simulator, options.seed);
  const SimulatedScan simulated = source.simulate(options.number, 1)[0];
  scan.brain = brain.name;
  scan.options = options;
  scan.volume = simulated.volume;
  ScanSlicesOptions as_scanned;
  as_scanned.scan_id = brain.name + "_" + options.motion + "_" + std::to_string(options.number);
  const std::vector<Slice> slices = scan_slices(simulated, as_scanned);
  for (std::size_t i = 0; i < slices.size(); ++i) {
    if (simulated.dropped[i] || slices[i].info.stack >= options.stacks) continue;
    scan.slices.push_back(slices[i]);
    scan.truth.push_back(simulated.plan.acquired[i].T_brain_slice());
  }
  return scan;
}

}  // namespace svort
