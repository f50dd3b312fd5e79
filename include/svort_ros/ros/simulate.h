#pragma once

#include <cstdint>
#include <filesystem>
#include <string>
#include <vector>

#include "svort_ros/simulation/scan_simulator.h"

namespace svort_ros {

/// What svort_simulate is to do.
struct SimulateOptions {
  std::vector<std::string> volumes;        ///< NIfTI files; empty: the built-in phantom
  std::vector<std::string> masks;          ///< one per volume, or none
  std::vector<std::string> parcellations;  ///< one per volume, or none
  svort::PhantomOptions phantom;
  svort::SimulatorOptions simulator;
  std::uint64_t seed = 1;
  std::uint64_t scan = 0;             ///< number of the scan: same seed, another scan
  std::string scan_id = "simulated";  ///< in bag and tables
  std::string output;                 ///< folder
  /// A whole-slice scan of three stacks by a steady scanner, of the brain as it is.
  SimulateOptions();
};

/// Simulates one scan and writes it: stack_<i>.nii.gz and mask_<i>.nii.gz, scan.bag, truth.csv, volume.nii.gz (the true
/// brain), scan.json, scan.png. @return the command line of svort_replay for the stacks, without its --output
/// @throws std::runtime_error, std::invalid_argument naming the file or the option
std::vector<std::string> simulate(const SimulateOptions& options);

/// The brains that the options name. @throws std::runtime_error naming the file
std::vector<svort::BrainVolume> brain_volumes(const SimulateOptions& options);

/// The program. @return 0, or 2 with a message on standard error if something is wrong with input or options
int run_svort_simulate(int argc, char** argv);

}  // namespace svort_ros
