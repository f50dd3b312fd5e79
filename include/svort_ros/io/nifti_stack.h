#pragma once

#include <cstdint>
#include <filesystem>
#include <string>
#include <vector>

#include "svort_ros/acquisition/slice.h"

namespace svort {

/// How stacks in files were acquired; NIfTI does not say.
struct StackTimingOptions {
  int interleave = 2;        ///< every interleave-th slice, then the next pass; 1 is sequential
  double tr_s = 1.2;         ///< time between slices, s
  double thickness_mm = 0.;  ///< slice thickness; 0 takes the spacing between slices
  double start_s = 1.;       ///< acquisition time of the first slice, s since the epoch

  template <class Visitor>
  void visit(Visitor&& v) {
    v("interleave", interleave, "acquisition order within a stack: every interleave-th slice, then the next pass");
    v("tr_s", tr_s, "repetition time: time between slices, s");
    v("thickness_mm", thickness_mm, "slice thickness, mm; 0 takes the spacing between slices");
    v("start_s", start_s, "acquisition time of the first slice, s since the epoch");
  }
};

/// All slices of stacks in NIfTI files, in acquisition order: stack after stack, interleaved within each.
/// The third axis is the slice axis. Slice i of the scan is acquired at start_s + i * tr_s.
///
/// @param masks one per stack, or empty
/// @throws std::runtime_error naming the file: unreadable, mask of another size or place (1e-3 mm), mask without brain,
///         a count of masks that is neither zero nor the count of stacks
/// @throws std::invalid_argument naming the option that is out of range
std::vector<Slice> read_stacks(const std::vector<std::filesystem::path>& stacks,
                               const std::vector<std::filesystem::path>& masks, const std::string& scan_id,
                               const StackTimingOptions& options);

}  // namespace svort
