#include "svort_ros/live/incremental_estimator.h"

#include <stdexcept>

#include "svort_ros/live/nominal_estimator.h"

namespace svort {

const char* to_string(PoseStatus status) {
  switch (status) {
    case PoseStatus::nominal:
      return "nominal";
  }
  throw std::logic_error("unknown PoseStatus");
}

std::unique_ptr<IncrementalEstimator> make_estimator(const EstimatorOptions& options) {
  if (options.method == "nominal") return std::make_unique<NominalEstimator>(options);
  throw std::invalid_argument("estimator.method is '" + options.method + "'; known: nominal");
}

}  // namespace svort
