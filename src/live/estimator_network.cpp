#include "estimator_network.h"

#include <stdexcept>
#include <string>

namespace svort {

std::pair<NetworkInstance, Checkpoint> load_estimator_network(const NetworkEstimatorOptions& options, const char* who) {
  if (options.weights.empty())
    throw std::invalid_argument(std::string("estimator.network.weights is empty; ") + who + " needs a file of weights");
  Checkpoint about;
  NetworkInstance network = load_network(options.weights, &about);
  if (!options.name.empty() && options.name != network.name)
    throw std::invalid_argument("estimator.network.name is '" + options.name + "', but " + options.weights +
                                " holds network '" + network.name + "'");
  return {std::move(network), std::move(about)};
}

void require_cpu(const NetworkEstimatorOptions& options, const char* who) {
  if (options.device == "cuda")
    throw std::invalid_argument(std::string("estimator.network.device is 'cuda', but with ") + who +
                                " the network runs on the CPU; auto or cpu will run");
  if (options.device != "auto" && options.device != "cpu")
    throw std::invalid_argument("estimator.network.device is '" + options.device + "'; known: auto, cpu, cuda");
}

AcquisitionFormulation network_formulation(const NetworkEstimatorOptions& options) {
  try {
    return acquisition_formulation(options.formulation);
  } catch (const std::invalid_argument& error) {
    throw std::invalid_argument(std::string("estimator.network.formulation: ") + error.what());
  }
}

int network_iterations(const NetworkEstimatorOptions& options) {
  if (options.iterations < 0 || options.iterations > 100)
    throw std::invalid_argument("estimator.network.iterations is " + std::to_string(options.iterations) +
                                "; it must be 0 to 100");
  return options.iterations;
}

EstimatorNotes network_notes(const NetworkInstance& network, const Checkpoint& about) {
  EstimatorNotes notes;
  notes.network = network.name;
  notes.weights_sha256 = about.sha256;
  if (is_untrained(about.provenance))
    notes.warnings.push_back("the weights of network " + network.name +
                             " are UNTRAINED: its poses mean nothing, they only show that the programs run");
  return notes;
}

}  // namespace svort
