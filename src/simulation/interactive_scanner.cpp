#include "svort_ros/simulation/interactive_scanner.h"

#include <torch/types.h>

#include <Eigen/Geometry>
#include <algorithm>
#include <cmath>
#include <stdexcept>

#include "purposes.h"
#include "svort_ros/acquisition/geometry_of_poses.h"
#include "svort_ros/acquisition/slice_acquisition.h"
#include "svort_ros/simulation/anatomy.h"

namespace svort {
namespace {

constexpr double kDegree = M_PI / 180.;
constexpr double kBrightest = 1000.;                          // value of the brightest tissue in the slices
constexpr double kVoidWholeShare = 0.4, kVoidDepthMin = 0.4;  // as ArtifactOptions has them
constexpr double kVoidSizeMin_mm = 6., kVoidSizeMax_mm = 25., kVoidReach_mm = 30.;

void require(bool ok, const char* what) {
  if (!ok) throw std::invalid_argument(std::string("interactive scanner: ") + what);
}

Eigen::Matrix3d plane_axes(int plane) {
  Eigen::Matrix3d axes;
  switch (plane) {
    case 0:  // transverse: columns to the left, rows to posterior
      axes.setIdentity();
      break;
    case 1:  // coronal: columns to the left, rows to inferior
      axes << 1, 0, 0, 0, 0, 1, 0, -1, 0;
      break;
    default:  // sagittal: columns to posterior, rows to inferior
      axes << 0, 0, -1, 1, 0, 0, 0, -1, 0;
  }
  return axes;
}

}  // namespace

Pose StackPrescription::slice(int index, double thickness_mm) const {
  Pose shift = Pose::Identity();
  shift.translation().z() = (index - 0.5 * (slices - 1)) * thickness_mm;
  return T_scanner_middle * shift;
}

InteractiveScanner::InteractiveScanner(const BrainVolume& brain, const std::string& motion,
                                       const InteractiveScannerOptions& options, std::uint64_t seed)
    : options_(options),
      trajectory_(motion_class(motion), options.longest_s, RandomStream(seed, 0, purpose::kMotion)),
      planning_(seed, 0, purpose::kScanner),
      damage_(seed, 0, purpose::kArtifacts) {
  require(options.size_px >= 8 && options.size_px <= 512, "size_px must be from 8 to 512");
  require(options.pixel_mm > 0., "pixel_mm must be positive");
  require(options.thickness_mm > 0., "thickness_mm must be positive");
  require(options.tr_s > 0., "tr_s must be positive");
  require(options.interleave >= 1, "interleave must be at least 1");
  NetworkGrid grid;
  grid.resolution_mm = options.pixel_mm;
  grid.volume_shape.fill(options.size_px);
  const Anatomy anatomy = AnatomySource({brain}, grid, no_anatomy_variation(), torch::kCPU).make(seed, 0);
  image_ = anatomy.image;
  mask_ = anatomy.mask;
  extent_ = anatomy.extent;
  truth_.grid.size.setConstant(options.size_px);
  truth_.grid.spacing.setConstant(options.pixel_mm);
  truth_.values.assign(image_.data_ptr<float>(), image_.data_ptr<float>() + image_.numel());
  truth_mask_.assign(mask_.data_ptr<bool>(), mask_.data_ptr<bool>() + mask_.numel());
  T_scanner_start_.linear() = planning_.rotation();
}

Pose InteractiveScanner::T_scanner_brain(double time_s) const {
  Pose T_head_brain = Pose::Identity();
  T_head_brain.translation() = -extent_.centre;
  return T_scanner_start_ * trajectory_.at(time_s) * T_head_brain;
}

StackPrescription InteractiveScanner::plan(int number) {
  const Pose head = T_scanner_brain(time_s_);
  const Eigen::Vector3d tilt = planning_.normal3(options_.tilt_deg * kDegree);
  StackPrescription stack;
  stack.stack = number;
  stack.T_scanner_middle.linear() = head.linear() * plane_axes(number % 3);
  if (tilt.norm() > 0.)
    stack.T_scanner_middle.linear() =
        stack.T_scanner_middle.linear() * Eigen::AngleAxisd(tilt.norm(), tilt.normalized()).toRotationMatrix();
  stack.T_scanner_middle.translation() = head * extent_.centre + planning_.normal3(options_.offset_mm);
  const Eigen::Vector3d normal = head.linear().transpose() * stack.T_scanner_middle.linear().col(2);
  const double reach = extent_.half_size.cwiseProduct(normal).norm();
  stack.slices = static_cast<int>(std::ceil(2. * reach / options_.thickness_mm)) + 3;  // some air at both ends
  return stack;
}

Slice InteractiveScanner::acquire(const Pose& T_scanner_slice, int stack, int index, int slices_in_stack) {
  const torch::NoGradGuard no_grad;
  const int size = options_.size_px;
  T_brain_slice_ = T_scanner_brain(time_s_).inverse() * T_scanner_slice;
  AcquisitionMasks masks;
  masks.volume = mask_;
  const SliceAcquisition acquisition(
      geometry_of_poses({T_brain_slice_}, {options_.thickness_mm}, options_.pixel_mm, options_.pixel_mm), size, size,
      {size, size, size}, AcquisitionFormulation::exact, masks);
  torch::Tensor share;
  const torch::Tensor image = acquisition.forward(image_, &share).contiguous();
  share = share.contiguous();

  // The same draws for every slice, whatever becomes of them.
  const double by_motion = 1. - std::exp(-trajectory_.speed(time_s_) / options_.void_speed);
  const bool moving = damage_.chance(by_motion), resting = damage_.chance(options_.void_share);
  const bool whole = damage_.chance(kVoidWholeShare);
  const double depth = damage_.uniform(kVoidDepthMin, 1.);
  const double first = damage_.uniform(kVoidSizeMin_mm, kVoidSizeMax_mm),
               second = damage_.uniform(kVoidSizeMin_mm, kVoidSizeMax_mm);
  const Eigen::Vector2d place = damage_.direction().head<2>() * kVoidReach_mm;
  voided_ = moving || resting;
  const Eigen::Vector3d centre = T_brain_slice_.inverse() * extent_.centre;

  Slice slice;
  slice.info.scan_id = "closed-loop";
  slice.info.stack = stack;
  slice.info.index = index;
  slice.info.slices_in_stack = slices_in_stack;
  slice.info.stamp_ns = 1000000000 + static_cast<std::int64_t>(std::llround(time_s_ * 1e9));
  slice.info.T_scanner_slice = T_scanner_slice;
  slice.info.pixel_spacing.setConstant(options_.pixel_mm);
  slice.info.thickness = options_.thickness_mm;
  slice.info.columns = slice.info.rows = size;
  const float* pixels = image.data_ptr<float>();
  const float* inside = share.data_ptr<float>();
  RandomStream noise(damage_.bits());
  for (int row = 0; row < size; ++row)
    for (int column = 0; column < size; ++column) {
      const auto at = static_cast<std::size_t>(row * size + column);
      double value = static_cast<double>(pixels[at]);
      if (voided_ && whole) value *= 1. - depth;
      if (voided_ && !whole) {
        const Eigen::Vector2d p((column - 0.5 * (size - 1)) * options_.pixel_mm,
                                (row - 0.5 * (size - 1)) * options_.pixel_mm);
        const Eigen::Vector2d from = (p - centre.head<2>() - place).cwiseQuotient(Eigen::Vector2d(first, second));
        value *= 1. - depth * std::exp(-0.5 * from.squaredNorm());
      }
      value = std::hypot(value + noise.normal(options_.noise), noise.normal(options_.noise));
      slice.pixels.push_back(static_cast<float>(value * kBrightest));
      slice.mask.push_back(inside[at] > 0.5F ? 1 : 0);
    }
  time_s_ += options_.tr_s;
  return slice;
}

}  // namespace svort
