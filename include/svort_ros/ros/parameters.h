#pragma once

#include <ros/node_handle.h>
#include <xmlrpcpp/XmlRpcValue.h>

#include <set>
#include <stdexcept>
#include <string>
#include <vector>

#include "svort_ros/decision/decision_engine.h"
#include "svort_ros/live/live_pipeline.h"

namespace svort_ros {

/// What only the node needs, beside svort::PipelineOptions.
struct NodeOptions {
  std::string scanner_frame = "scanner";    ///< tf name of the scanner's patient coordinate system
  std::string brain_frame = "fetal_brain";  ///< tf name of the brain's own frame
  std::string output_directory;             ///< where scans are written; empty: ~save fails with a message
  int queue_size = 1000;                    ///< slices that may wait in the subscriber before ROS would drop one
  int threads = 0;                          ///< for the estimator; 0 takes all cores
  int volume_every = 8;                     ///< a volume at the latest after so many slices, even if more are waiting
  double repetition_time_s = 1.2;           ///< diagnostics compare the latency with it, s
  double no_slice_warning_s = 3.0;          ///< warn when nobody publishes slices for so long, s
  double surface_threshold = 0.3;           ///< isosurface, fraction of the volume's reference intensity
  double surface_resolution_mm = 2.0;       ///< the surface is taken from voxels of about this size, mm
  double cloud_threshold = 0.3;             ///< smallest intensity in the cloud, fraction of the reference intensity

  template <class Visitor>
  void visit(Visitor&& v) {
    v("scanner_frame", scanner_frame, "tf name of the scanner's patient coordinate system");
    v("brain_frame", brain_frame, "tf name of the brain's own frame");
    v("output_directory", output_directory, "folder for results; empty: nothing is written");
    v("queue_size", queue_size, "slices that may wait in the subscriber");
    v("threads", threads, "threads of the estimator; 0 takes all cores");
    v("volume_every", volume_every, "a volume at the latest after so many slices, even if more are waiting");
    v("repetition_time_s", repetition_time_s, "diagnostics compare the latency with it, s");
    v("no_slice_warning_s", no_slice_warning_s, "warn when nobody publishes slices for so long, s");
    v("surface_threshold", surface_threshold, "isosurface, fraction of the 0.99 quantile of the positive voxels");
    v("surface_resolution_mm", surface_resolution_mm, "the surface is taken from voxels of about this size, mm");
    v("cloud_threshold", cloud_threshold, "smallest intensity in the cloud, fraction of the same quantile");
  }
};

struct ServerOptions {
  NodeOptions node;
  svort::PipelineOptions pipeline;
  svort::DecisionOptions decision;

  template <class Visitor>
  void visit(Visitor&& v) {
    v.section("node", node);
    pipeline.visit(v);
    v.section("decision", decision);
  }
};

/// @throws std::invalid_argument naming the option, its value and the limit
void validate(const NodeOptions& options);

/// Visitor that reads options from a tree of ROS parameters; members without a parameter keep their values.
/// Errors are std::runtime_error and name the parameter.
class ParameterReader {
 public:
  /// @param tree   a struct, or invalid if there are no parameters
  /// @param prefix resolved name of the tree, ending in '/', for messages
  ParameterReader(XmlRpc::XmlRpcValue tree, std::string prefix);

  void operator()(const std::string& key, bool& value, const char* help);
  void operator()(const std::string& key, int& value, const char* help);
  void operator()(const std::string& key, double& value, const char* help);  ///< takes integers too
  void operator()(const std::string& key, std::string& value, const char* help);
  void operator()(const std::string& key, std::vector<std::string>& value, const char* help);
  template <class Options>
  void section(const std::string& key, Options& options) {
    XmlRpc::XmlRpcValue* node = find(key);
    ParameterReader reader(node ? *node : XmlRpc::XmlRpcValue(), prefix_ + key + "/");
    options.visit(reader);
    reader.reject_unknown();
  }
  bool has(const std::string& key) const { return tree_.hasMember(key); }
  void reject_unknown() const;

 private:
  XmlRpc::XmlRpcValue* find(const std::string& key);
  [[noreturn]] void wrong_type(const std::string& key, const char* expected) const;

  XmlRpc::XmlRpcValue tree_;
  std::string prefix_;
  std::set<std::string> known_;
};

/// All parameters of a node handle's namespace, for a ParameterReader.
ParameterReader read_parameters(const ros::NodeHandle& nh);

/// Reads every option from the private parameters: ~node/queue_size, ~sequence/margin_mm, ...
/// @throws std::runtime_error naming the parameter: unknown key under one of the sections, wrong type
/// @throws std::invalid_argument naming the option, its value and the limit
ServerOptions load_parameters(const ros::NodeHandle& private_nh);

}  // namespace svort_ros
