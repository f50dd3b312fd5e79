#pragma once

#include <dynamic_reconfigure/Config.h>
#include <dynamic_reconfigure/ConfigDescription.h>
#include <dynamic_reconfigure/Reconfigure.h>
#include <ros/node_handle.h>

#include <functional>
#include <string>

#include "svort_ros/decision/decision_engine.h"

namespace svort_ros {

// The thresholds of decisions for dynamic_reconfigure's clients (dynparam, rqt_reconfigure): its services and topics,
// made from the option structs themselves, so that a default exists only once. Names are "section__key", e.g.
// reacquisition__budget_s.

dynamic_reconfigure::Config to_config(const svort::DecisionOptions& options);
/// Options that the message does not name keep their values. @throws std::invalid_argument naming an unknown option, or
/// one of another type
void apply_config(const dynamic_reconfigure::Config& config, svort::DecisionOptions* options);
dynamic_reconfigure::ConfigDescription describe(const svort::DecisionOptions& defaults);

/// Serves ~set_parameters, ~parameter_descriptions and ~parameter_updates below a node handle.
class ReconfigureServer {
 public:
  /// @param change called from a ROS thread with the request; applies it and answers with the options in use after it
  ReconfigureServer(const ros::NodeHandle& nh, const svort::DecisionOptions& options,
                    std::function<svort::DecisionOptions(const dynamic_reconfigure::Config&)> change);

 private:
  ros::NodeHandle nh_;
  ros::Publisher descriptions_;
  ros::Publisher updates_;
  ros::ServiceServer service_;
};

}  // namespace svort_ros
