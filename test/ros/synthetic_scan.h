#pragma once

// A small scan of an analytic phantom, and a folder of its own for every test.

#include <unistd.h>

#include <Eigen/Geometry>
#include <cmath>
#include <cstdint>
#include <filesystem>
#include <fstream>
#include <iterator>
#include <stdexcept>
#include <string>
#include <vector>

#include "svort_ros/acquisition/slice.h"
#include "svort_ros/io/nifti.h"

namespace svort_test {

constexpr double kStartS = 1000.;
constexpr double kRepetitionTimeS = 1.2;

/// An ellipsoid with two dark ellipsoids in it, not symmetric; p in mm from its centre. 0 outside.
inline float phantom_intensity(const Eigen::Vector3d& p) {
  const auto inside = [&p](const Eigen::Vector3d& centre, const Eigen::Vector3d& radii) {
    return (p - centre).cwiseQuotient(radii).squaredNorm() < 1.;
  };
  if (!inside({0., 0., 0.}, {36., 30., 27.})) return 0.F;
  if (inside({14., 4., 3.}, {9., 13., 8.})) return 260.F;
  if (inside({-12., -5., 0.}, {7., 10., 9.})) return 350.F;
  return static_cast<float>(800. + 4. * p.x() - 2. * p.z());
}

struct SyntheticScanOptions {
  std::string scan_id = "phantom";
  int stacks = 3;  ///< up to 3: transverse, coronal, sagittal
  int slices = 8;
  int pixels = 48;
  double pixel_mm = 2.;
  double thickness_mm = 6.;
  Eigen::Vector3d centre = {12., -25., 40.};  ///< of the phantom in the scanner, mm
  double tilt_rad = 0.2;                      ///< the stacks are a little oblique
};

/// Centre and orientation of a stack's middle; columns are the slice axes x, y, z.
inline Eigen::Matrix3d stack_axes(int stack, double tilt_rad) {
  Eigen::Matrix3d axes;
  if (stack == 0) axes << 1, 0, 0, 0, 1, 0, 0, 0, 1;
  if (stack == 1) axes << 1, 0, 0, 0, 0, 1, 0, -1, 0;
  if (stack == 2) axes << 0, 0, 1, 1, 0, 0, 0, 1, 0;
  return Eigen::AngleAxisd(tilt_rad, Eigen::Vector3d(1., 2., 3.).normalized()).toRotationMatrix() * axes;
}

/// All slices in acquisition order (interleave 2), at kStartS + i * kRepetitionTimeS.
inline std::vector<svort::Slice> synthetic_scan(const SyntheticScanOptions& options = {}) {
  std::vector<svort::Slice> scan;
  for (int stack = 0; stack < options.stacks; ++stack) {
    const Eigen::Matrix3d axes = stack_axes(stack, options.tilt_rad);
    for (const int index : svort::interleaved_order(options.slices, 2)) {
      svort::Slice slice;
      svort::SliceInfo& info = slice.info;
      info.scan_id = options.scan_id;
      info.stack = stack;
      info.index = index;
      info.slices_in_stack = options.slices;
      info.stamp_ns = std::llround(1e9 * (kStartS + kRepetitionTimeS * static_cast<double>(scan.size())));
      info.pixel_spacing = {options.pixel_mm, options.pixel_mm};
      info.thickness = options.thickness_mm;
      info.columns = info.rows = options.pixels;
      info.T_scanner_slice.linear() = axes;
      info.T_scanner_slice.translation() =
          options.centre + axes.col(2) * options.thickness_mm * (index - 0.5 * (options.slices - 1));
      for (int row = 0; row < options.pixels; ++row)
        for (int column = 0; column < options.pixels; ++column) {
          const double middle = 0.5 * (options.pixels - 1);
          const Eigen::Vector3d p = info.T_scanner_slice * Eigen::Vector3d((column - middle) * options.pixel_mm,
                                                                           (row - middle) * options.pixel_mm, 0.);
          const float value = phantom_intensity(p - options.centre);
          slice.pixels.push_back(value + 20.F);  // some signal around the brain
          slice.mask.push_back(value > 0.F ? 1 : 0);
        }
      scan.push_back(slice);
    }
  }
  return scan;
}

/// The values of one stack of the phantom as a NIfTI file.
inline void write_stack(const std::filesystem::path& path, const std::vector<svort::Slice>& scan, int stack,
                        bool mask) {
  svort::Volume volume;
  svort::Pose first = svort::Pose::Identity();
  svort::Pose last = svort::Pose::Identity();
  int count = 0;
  for (const svort::Slice& slice : scan) {
    if (slice.info.stack != stack) continue;
    if (slice.info.index == 0) first = slice.info.T_scanner_slice;
    if (slice.info.index == slice.info.slices_in_stack - 1) last = slice.info.T_scanner_slice;
    volume.grid.size = {slice.info.columns, slice.info.rows, slice.info.slices_in_stack};
    volume.grid.spacing = {slice.info.pixel_spacing.x(), slice.info.pixel_spacing.y(), slice.info.thickness};
    volume.values.resize(volume.grid.voxel_count());
    for (std::size_t i = 0; i < slice.pixels.size(); ++i)
      volume.values[volume.grid.offset(0, 0, slice.info.index) + i] =
          mask ? static_cast<float>(slice.mask[i]) : slice.pixels[i];
    ++count;
  }
  if (count == 0 || count != volume.grid.size.z()) throw std::logic_error("write_stack: no whole stack");
  volume.grid.T_frame_grid = first;
  volume.grid.T_frame_grid.translation() = 0.5 * (first.translation() + last.translation());
  svort::write_nifti(path, volume);
}

/// A new folder, removed with all that is in it.
class TemporaryFolder {
 public:
  TemporaryFolder() {
    std::string name = (std::filesystem::temp_directory_path() / "svort_test_XXXXXX").string();
    if (!mkdtemp(name.data())) throw std::runtime_error("no temporary folder: " + name);
    path_ = name;
  }
  ~TemporaryFolder() {
    std::error_code ignored;
    std::filesystem::remove_all(path_, ignored);
  }
  TemporaryFolder(const TemporaryFolder&) = delete;
  TemporaryFolder& operator=(const TemporaryFolder&) = delete;
  const std::filesystem::path& path() const { return path_; }

 private:
  std::filesystem::path path_;
};

inline std::string read_bytes(const std::filesystem::path& path) {
  std::ifstream file(path, std::ios::binary);
  if (!file) throw std::runtime_error(path.string() + " cannot be read");
  return {std::istreambuf_iterator<char>(file), std::istreambuf_iterator<char>()};
}

}  // namespace svort_test
