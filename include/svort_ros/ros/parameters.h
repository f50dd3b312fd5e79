#pragma once

#include <ros/node_handle.h>

#include <string>

#include "svort_ros/live/live_pipeline.h"

namespace svort_ros {

/// What only the node needs, beside svort::PipelineOptions.
struct NodeOptions {
  std::string scanner_frame = "scanner";     ///< tf name of the scanner's patient coordinate system
  std::string brain_frame = "fetal_brain";   ///< tf name of the brain's own frame
  std::string output_directory;              ///< where ~save and the end of a scan write; empty: ~save fails with a message
  int queue_size = 1000;                     ///< slices that may wait in the subscriber before ROS would drop one
  int threads = 0;                           ///< for the estimator; 0 takes all cores
  double repetition_time_s = 1.2;            ///< diagnostics compare the latency with it, s
  double no_slice_warning_s = 3.0;           ///< warn when nobody publishes slices for so long, s
  double surface_threshold = 0.3;            ///< isosurface, fraction of the volume's 0.99 quantile
  double cloud_threshold = 0.3;              ///< smallest intensity in the cloud, fraction of the 0.99 quantile

  template <class Visitor>
  void visit(Visitor&& v) {
    v("scanner_frame", scanner_frame, "tf name of the scanner's patient coordinate system");
    v("brain_frame", brain_frame, "tf name of the brain's own frame");
    v("output_directory", output_directory, "folder for results; empty: nothing is written");
    v("queue_size", queue_size, "slices that may wait in the subscriber");
    v("threads", threads, "threads of the estimator; 0 takes all cores");
    v("repetition_time_s", repetition_time_s, "diagnostics compare the latency with it, s");
    v("no_slice_warning_s", no_slice_warning_s, "warn when nobody publishes slices for so long, s");
    v("surface_threshold", surface_threshold, "isosurface, fraction of the volume's 0.99 quantile");
    v("cloud_threshold", cloud_threshold, "smallest intensity in the cloud, fraction of the 0.99 quantile");
  }
};

struct ServerOptions {
  NodeOptions node;
  svort::PipelineOptions pipeline;

  template <class Visitor>
  void visit(Visitor&& v) {
    v.section("node", node);
    pipeline.visit(v);
  }
};

/// Reads every option from the private parameters: ~node/queue_size, ~sequence/margin_mm, ...
/// @throws std::runtime_error naming the parameter: unknown key under one of the sections, wrong type
ServerOptions load_parameters(const ros::NodeHandle& private_nh);

}  // namespace svort_ros
