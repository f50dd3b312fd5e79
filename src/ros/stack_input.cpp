#include "svort_ros/ros/stack_input.h"

#include <filesystem>

#include "svort_ros/ros/conversions.h"

namespace svort_ros {

void add_stack_options(CLI::App& app, StackInput& input) {
  const char* group = "NIfTI stacks";
  app.add_option("--stacks", input.stacks,
                 "NIfTI files of the stacks, in the order of acquisition; the third axis "
                 "is the slice axis")
      ->group(group);
  app.add_option("--masks", input.masks, "NIfTI files of the brain masks, one per stack")->group(group);
  app.add_option("--scan-id", input.scan_id, "identifies the examination")->capture_default_str()->group(group);
  app.add_option("--interleave", input.timing.interleave, "every so many-th slice, then the next pass")
      ->capture_default_str()
      ->group(group);
  app.add_option("--tr", input.timing.tr_s, "repetition time: time between slices, s")
      ->capture_default_str()
      ->group(group);
  app.add_option("--thickness", input.timing.thickness_mm, "slice thickness, mm; 0 takes the spacing between slices")
      ->capture_default_str()
      ->group(group);
  app.add_option("--start", input.timing.start_s, "acquisition time of the first slice, s since the epoch")
      ->capture_default_str()
      ->group(group);
}

std::vector<Slice> read_messages(const StackInput& input) {
  const std::vector<std::filesystem::path> stacks(input.stacks.begin(), input.stacks.end());
  const std::vector<std::filesystem::path> masks(input.masks.begin(), input.masks.end());
  std::vector<Slice> messages;
  for (const svort::Slice& slice : svort::read_stacks(stacks, masks, input.scan_id, input.timing))
    messages.push_back(to_msg(slice, input.scanner_frame));
  return messages;
}

}  // namespace svort_ros
