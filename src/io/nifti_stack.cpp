#include "svort_ros/io/nifti_stack.h"

#include <algorithm>
#include <cmath>
#include <sstream>
#include <stdexcept>

#include "svort_ros/geometry/patient_frames.h"
#include "svort_ros/io/nifti.h"

namespace svort {
namespace {

void require(bool ok, const char* option, double value, const char* limit) {
  if (ok) return;
  std::ostringstream message;
  message << option << " is " << value << ", must be " << limit;
  throw std::invalid_argument(message.str());
}

[[noreturn]] void fail(const std::filesystem::path& path, const std::string& what) {
  throw std::runtime_error(path.string() + ": " + what);
}

/// Largest distance between the corners of the two grids, mm.
double grid_distance(const NiftiImage& a, const NiftiImage& b) {
  double distance = 0.;
  for (int corner = 0; corner < 8; ++corner) {
    const Eigen::Vector3d index(corner & 1 ? a.size.x() - 1 : 0, corner & 2 ? a.size.y() - 1 : 0,
                                corner & 4 ? a.size.z() - 1 : 0);
    distance = std::max(distance, (a.affine_lps * index - b.affine_lps * index).norm());
  }
  return distance;
}

NiftiImage read_mask(const std::filesystem::path& path, const NiftiImage& stack,
                     const std::filesystem::path& stack_path) {
  NiftiImage mask = read_nifti(path);
  std::ostringstream message;
  if (mask.size != stack.size) {
    message << "the mask has " << mask.size.transpose() << " voxels, its stack " << stack_path.string() << " has "
            << stack.size.transpose();
    fail(path, message.str());
  }
  // Masks are often written by other tools than the stack, with the affine rounded to float32.
  constexpr double kTolerance_mm = 1e-3;
  const double distance = grid_distance(mask, stack);
  if (distance > kTolerance_mm) {
    message << "the mask lies up to " << distance << " mm away from its stack " << stack_path.string() << " (tolerance "
            << kTolerance_mm << " mm)";
    fail(path, message.str());
  }
  bool any = false;
  for (const float value : mask.values) {
    if (!std::isfinite(value)) fail(path, "the mask holds NaN or infinity");
    any = any || value > 0.F;
  }
  if (!any) fail(path, "the mask has no brain voxel");
  return mask;
}

}  // namespace

std::vector<Slice> read_stacks(const std::vector<std::filesystem::path>& stacks,
                               const std::vector<std::filesystem::path>& masks, const std::string& scan_id,
                               const StackTimingOptions& options) {
  require(options.interleave >= 1, "interleave", options.interleave, "at least 1");
  require(std::isfinite(options.tr_s) && options.tr_s > 0., "tr_s", options.tr_s, "finite and positive");
  require(std::isfinite(options.thickness_mm) && options.thickness_mm >= 0., "thickness_mm", options.thickness_mm,
          "finite and at least 0");
  require(std::isfinite(options.start_s) && options.start_s >= 0. && options.start_s < 4e9, "start_s", options.start_s,
          "in 0 .. 4e9");
  if (!masks.empty() && masks.size() != stacks.size())
    fail(masks.front(), "there are " + std::to_string(masks.size()) + " masks for " + std::to_string(stacks.size()) +
                            " stacks, must be none or one each");

  std::vector<Slice> slices;
  const std::int64_t start_ns = std::llround(options.start_s * 1e9);
  for (std::size_t s = 0; s < stacks.size(); ++s) {
    const NiftiImage stack = read_nifti(stacks[s]);
    NiftiImage mask;
    if (!masks.empty()) mask = read_mask(masks[s], stack, stacks[s]);

    const int columns = stack.size.x();
    const int rows = stack.size.y();
    const auto slice_size = static_cast<std::ptrdiff_t>(columns) * rows;
    for (const int index : interleaved_order(stack.size.z(), options.interleave)) {
      Slice slice;
      slice.info.scan_id = scan_id;
      slice.info.stack = static_cast<int>(s);
      slice.info.index = index;
      slice.info.slices_in_stack = stack.size.z();
      slice.info.stamp_ns = start_ns + std::llround(static_cast<double>(slices.size()) * options.tr_s * 1e9);
      try {
        const SliceGeometry geometry = slice_geometry_from_affine(stack.affine_lps, columns, rows, index);
        slice.info.T_scanner_slice = geometry.T_scanner_slice;
        slice.info.pixel_spacing = geometry.pixel_spacing;
      } catch (const std::invalid_argument& error) {
        fail(stacks[s], error.what());
      }
      slice.info.thickness = options.thickness_mm > 0. ? options.thickness_mm : stack.spacing.z();
      slice.info.columns = columns;
      slice.info.rows = rows;
      const auto begin = stack.values.begin() + index * slice_size;
      slice.pixels.assign(begin, begin + slice_size);
      if (!masks.empty()) {
        slice.mask.resize(slice.pixels.size());
        const auto mask_begin = mask.values.begin() + index * slice_size;
        std::transform(mask_begin, mask_begin + slice_size, slice.mask.begin(),
                       [](float value) -> std::uint8_t { return value > 0.F ? 1 : 0; });
      }
      slices.push_back(std::move(slice));
    }
  }
  return slices;
}

}  // namespace svort
