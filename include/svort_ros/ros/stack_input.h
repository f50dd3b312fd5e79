#pragma once

#include <CLI/CLI.hpp>
#include <string>
#include <vector>

#include "svort_ros/Slice.h"
#include "svort_ros/io/nifti_stack.h"

namespace svort_ros {

/// A scan in NIfTI files.
struct StackInput {
  std::vector<std::string> stacks;        ///< .nii or .nii.gz, in the order of acquisition
  std::vector<std::string> masks;         ///< brain masks, one per stack, or none
  std::string scan_id = "scan";           ///< NIfTI does not say
  std::string scanner_frame = "scanner";  ///< header.frame_id of the messages
  svort::StackTimingOptions timing;

  template <class Visitor>
  void visit(Visitor&& v) {
    v("stacks", stacks, "NIfTI files of the stacks, in the order of acquisition");
    v("masks", masks, "NIfTI files of the brain masks, one per stack, or none");
    v("scan_id", scan_id, "identifies the examination");
    v("scanner_frame", scanner_frame, "tf name of the scanner's patient coordinate system");
    timing.visit(v);
  }
};

/// --stacks --masks --scan-id --interleave --tr --thickness --start
void add_stack_options(CLI::App& app, StackInput& input);

/// The slices as messages, in the order of acquisition. Every program gets them from here, so that live and offline
/// results agree to the last bit. @throws see svort::read_stacks
std::vector<Slice> read_messages(const StackInput& input);

}  // namespace svort_ros
