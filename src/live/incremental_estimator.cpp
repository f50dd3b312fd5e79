#include "svort_ros/live/incremental_estimator.h"

#include <stdexcept>
#include <utility>

#include "svort_ros/live/network_candidates.h"
#include "svort_ros/live/network_estimator.h"
#include "svort_ros/live/nominal_estimator.h"
#include "svort_ros/live/registration_estimator.h"

namespace svort {

const char* to_string(PoseStatus status) {
  switch (status) {
    case PoseStatus::nominal:
      return "nominal";
    case PoseStatus::network:
      return "network";
    case PoseStatus::predicted:
      return "predicted";
    case PoseStatus::registered:
      return "registered";
    case PoseStatus::outlier:
      return "outlier";
  }
  throw std::logic_error("unknown PoseStatus");
}

std::unique_ptr<IncrementalEstimator> make_estimator(const EstimatorOptions& options,
                                                     std::vector<BrainTemplate> templates) {
  if (options.method == "registration") {
    return std::make_unique<RegistrationEstimator>(
        options, std::move(templates),
        options.network.candidate ? std::make_unique<NetworkCandidates>(options.network) : nullptr,
        options.network.guide ? std::make_unique<NetworkGuide>(options.network) : nullptr);
  }
  if (options.method == "nominal") return std::make_unique<NominalEstimator>(options);
  if (options.method == "network") return std::make_unique<NetworkEstimator>(options);
  throw std::invalid_argument("estimator.method is '" + options.method + "'; known: registration, network, nominal");
}

}  // namespace svort
