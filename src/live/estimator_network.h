#pragma once

#include <utility>

#include "svort_ros/live/incremental_estimator.h"
#include "svort_ros/network/checkpoint.h"

namespace svort {

/// The network that the options name, and what its file says about it.
/// @param who needs it, for the message if no file is named
/// @throws std::invalid_argument naming the option
/// @throws std::runtime_error naming the file and what is wrong with it
std::pair<NetworkInstance, Checkpoint> load_estimator_network(const NetworkEstimatorOptions& options, const char* who);

/// @param who runs its network on the CPU alone
/// @throws std::invalid_argument if the options name another device
void require_cpu(const NetworkEstimatorOptions& options, const char* who);

/// @throws std::invalid_argument naming the option
AcquisitionFormulation network_formulation(const NetworkEstimatorOptions& options);

/// @throws std::invalid_argument naming the option if it is not 0 to 100
int network_iterations(const NetworkEstimatorOptions& options);

/// Name, hash, and a warning if the weights have learnt nothing.
EstimatorNotes network_notes(const NetworkInstance& network, const Checkpoint& about);

}  // namespace svort
