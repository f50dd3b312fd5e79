#include "svort_ros/sequence/slice_sequence.h"

#include <algorithm>
#include <cmath>
#include <iomanip>
#include <limits>
#include <optional>
#include <sstream>
#include <stdexcept>

#include "slice_resampling.h"

namespace svort {
namespace {

/// Scanners repeat spacing and thickness of a stack digit by digit; this only allows for float32 on the way.
constexpr double kLengthTolerance_mm = 1e-3;
constexpr double kRadToDeg = 57.29577951308232;

template <class... Parts>
std::string text(const Parts&... parts) {
  std::ostringstream stream;
  stream << std::setprecision(6);
  (stream << ... << parts);
  return stream.str();
}

std::string seconds(std::int64_t ns) {
  std::ostringstream stream;
  stream << std::fixed << std::setprecision(3) << 1e-9 * static_cast<double>(ns) << " s";
  return stream.str();
}

void require(bool ok, const char* option, double value, const char* limit) {
  if (!ok) throw std::invalid_argument(text("sequence.", option, " is ", value, ", must be ", limit));
}

/// What is wrong with the geometry that the slice itself states; empty if nothing.
std::string geometry_fault(const SliceInfo& info) {
  if (info.stack < 0) return text("stack number ", info.stack, " is negative");
  if (info.index < 0) return text("slice index ", info.index, " is negative");
  if (info.slices_in_stack < 1)
    return text("the stack's prescribed slice count is ", info.slices_in_stack, ", must be at least 1");
  const auto positive = [](double value) { return std::isfinite(value) && value > 0.; };
  if (!positive(info.pixel_spacing.x()) || !positive(info.pixel_spacing.y()))
    return text("pixel spacing ", info.pixel_spacing.x(), " x ", info.pixel_spacing.y(),
                " mm, must be finite and positive");
  if (!positive(info.thickness)) return text("thickness ", info.thickness, " mm, must be finite and positive");
  const auto& matrix = info.T_scanner_slice.matrix();
  if (!matrix.allFinite()) return "the nominal pose holds NaN or infinity";
  if (!is_rigid(info.T_scanner_slice)) {
    const Eigen::Matrix3d r = info.T_scanner_slice.linear();
    return text("the nominal pose is not rigid: |R^T R - I| is ",
                (r.transpose() * r - Eigen::Matrix3d::Identity()).norm(), ", determinant ", r.determinant(),
                " (must be 0 and 1 within 1e-4)");
  }
  return "";
}

/// What is wrong with image and mask as arrays; empty if nothing.
std::string image_fault(const Slice& slice) {
  const SliceInfo& info = slice.info;
  if (info.columns < 1 || info.rows < 1)
    return text("the image has ", info.columns, " columns and ", info.rows, " rows, must be at least 1 each");
  const auto expected = static_cast<std::size_t>(info.columns) * static_cast<std::size_t>(info.rows);
  if (slice.pixels.size() != expected)
    return text("the image holds ", slice.pixels.size(), " pixels, ", info.columns, " columns x ", info.rows,
                " rows need ", expected);
  if (!slice.mask.empty() && slice.mask.size() != expected)
    return text("the mask holds ", slice.mask.size(), " pixels, the image ", info.columns, " x ", info.rows, " = ",
                expected);
  const auto bad =
      std::find_if(slice.pixels.begin(), slice.pixels.end(), [](float value) { return !std::isfinite(value); });
  if (bad != slice.pixels.end()) {
    const auto offset = static_cast<std::size_t>(bad - slice.pixels.begin());
    const auto columns = static_cast<std::size_t>(info.columns);
    return text("pixel at column ", offset % columns, ", row ", offset / columns, " is ", *bad, ", must be finite");
  }
  return "";
}

/// How the slice differs from the first kept slice of its stack; empty if it does not.
std::string stack_fault(const SliceInfo& info, const SliceInfo& first, const SliceSequenceOptions& options) {
  const std::string reference = text("slice ", first.index, " of the stack has ");
  if (info.slices_in_stack != first.slices_in_stack)
    return text("prescribed slice count ", info.slices_in_stack, ", ", reference, first.slices_in_stack);
  if (info.columns != first.columns || info.rows != first.rows)
    return text("size ", info.columns, " x ", info.rows, " pixels, ", reference, first.columns, " x ", first.rows);
  if ((info.pixel_spacing - first.pixel_spacing).cwiseAbs().maxCoeff() > kLengthTolerance_mm)
    return text("pixel spacing ", info.pixel_spacing.x(), " x ", info.pixel_spacing.y(), " mm, ", reference,
                first.pixel_spacing.x(), " x ", first.pixel_spacing.y(), " mm (tolerance ", kLengthTolerance_mm,
                " mm)");
  if (std::abs(info.thickness - first.thickness) > kLengthTolerance_mm)
    return text("thickness ", info.thickness, " mm, ", reference, first.thickness, " mm (tolerance ",
                kLengthTolerance_mm, " mm)");
  const Pose T_first_slice = first.T_scanner_slice.inverse() * info.T_scanner_slice;
  const double angle = rotation_angle(T_first_slice) * kRadToDeg;
  if (angle > options.stack_angle_tolerance_deg)
    return text("orientation differs by ", angle, " degrees from slice ", first.index, " of the stack (tolerance ",
                options.stack_angle_tolerance_deg, " degrees)");
  const double offset = T_first_slice.translation().head<2>().norm();
  if (offset > options.stack_offset_tolerance_mm)
    return text("centre lies ", offset, " mm in plane beside the normal line through slice ", first.index,
                " of the stack (tolerance ", options.stack_offset_tolerance_mm, " mm)");
  return "";
}

/// Box around the brain pixels, in pixel indices, both ends included.
struct PixelBox {
  int left = std::numeric_limits<int>::max();
  int right = -1;
  int top = std::numeric_limits<int>::max();
  int bottom = -1;
  std::size_t pixels = 0;
};

PixelBox brain_box(const Slice& slice) {
  PixelBox box;
  std::size_t offset = 0;
  for (int row = 0; row < slice.info.rows; ++row) {
    for (int column = 0; column < slice.info.columns; ++column, ++offset) {
      if (!slice.mask[offset]) continue;
      box.left = std::min(box.left, column);
      box.right = std::max(box.right, column);
      box.top = std::min(box.top, row);
      box.bottom = row;
      ++box.pixels;
    }
  }
  return box;
}

/// Moves `shift` by less than half a pixel so that crop and image pixels coincide, if both have the same size: pixels
/// are then copied, not interpolated.
double snap_to_pixels(double shift, double spacing, double resolution, int columns, int size) {
  if (std::abs(spacing / resolution - 1.) > 1e-6) return shift;
  const double offset = 0.5 * (columns - size);  // index of the image pixel under crop pixel 0, at shift 0
  return (std::round(shift / spacing + offset) - offset) * spacing;
}

/// Brain pixels whose centre lies outside the field around `shift` (mm).
std::size_t pixels_cut(const Slice& slice, const Eigen::Vector2d& shift, double field_mm) {
  const SliceInfo& info = slice.info;
  std::size_t cut = 0;
  std::size_t offset = 0;
  for (int row = 0; row < info.rows; ++row) {
    const double y = (row - 0.5 * (info.rows - 1)) * info.pixel_spacing.y() - shift.y();
    for (int column = 0; column < info.columns; ++column, ++offset) {
      if (!slice.mask[offset]) continue;
      const double x = (column - 0.5 * (info.columns - 1)) * info.pixel_spacing.x() - shift.x();
      if (std::max(std::abs(x), std::abs(y)) > 0.5 * field_mm) ++cut;
    }
  }
  return cut;
}

/// Earlier by acquisition time; ties keep the order of arrival (upper_bound).
bool acquired_before(std::int64_t stamp_ns, const std::shared_ptr<const PreparedSlice>& slice) {
  return stamp_ns < slice->info.stamp_ns;
}

}  // namespace

const char* to_string(ArrivalStatus status) {
  switch (status) {
    case ArrivalStatus::accepted:
      return "accepted";
    case ArrivalStatus::out_of_order:
      return "out_of_order";
    case ArrivalStatus::late:
      return "late";
    case ArrivalStatus::duplicate:
      return "duplicate";
    case ArrivalStatus::empty_mask:
      return "empty_mask";
    case ArrivalStatus::bad_image:
      return "bad_image";
    case ArrivalStatus::bad_geometry:
      return "bad_geometry";
    case ArrivalStatus::inconsistent_stack:
      return "inconsistent_stack";
    case ArrivalStatus::excess_slice:
      return "excess_slice";
    case ArrivalStatus::ended_scan:
      return "ended_scan";
  }
  throw std::invalid_argument(text("arrival status ", static_cast<int>(status), " has no name"));
}

bool is_kept(ArrivalStatus status) {
  return status == ArrivalStatus::accepted || status == ArrivalStatus::out_of_order || status == ArrivalStatus::late;
}

SliceSequence::SliceSequence(const SliceSequenceOptions& options) : options_(options), intensity_(options.intensity) {
  const auto finite_from_zero = [](double value) { return std::isfinite(value) && value >= 0.; };
  require(options.size_px >= 1 && options.size_px <= 4096, "size_px", options.size_px, "in 1 .. 4096");
  require(std::isfinite(options.resolution_mm) && options.resolution_mm > 0., "resolution_mm", options.resolution_mm,
          "finite and positive");
  require(finite_from_zero(options.margin_mm), "margin_mm", options.margin_mm, "finite and at least 0");
  require(options.min_brain_pixels >= 1, "min_brain_pixels", options.min_brain_pixels, "at least 1");
  require(finite_from_zero(options.stack_angle_tolerance_deg), "stack_angle_tolerance_deg",
          options.stack_angle_tolerance_deg, "finite and at least 0");
  require(finite_from_zero(options.stack_offset_tolerance_mm), "stack_offset_tolerance_mm",
          options.stack_offset_tolerance_mm, "finite and at least 0");
}

Arrival SliceSequence::inspect(const Slice& slice, PreparedSlice& prepared) const {
  const SliceInfo& info = slice.info;
  const std::string name = describe(info);
  const auto rejected = [&name](ArrivalStatus status, const std::string& fault) {
    Arrival arrival;
    arrival.status = status;
    arrival.reason = name + ": " + fault;
    return arrival;
  };

  if (ended_scans_.count(info.scan_id))
    return rejected(ArrivalStatus::ended_scan, "the scan was ended by scan " + scan_id_);
  if (const std::string fault = geometry_fault(info); !fault.empty())
    return rejected(ArrivalStatus::bad_geometry, fault);
  if (info.index >= info.slices_in_stack)
    return rejected(ArrivalStatus::excess_slice, text("index ", info.index, ", but only ", info.slices_in_stack,
                                                      " slices (0 .. ", info.slices_in_stack - 1, ") are prescribed"));
  if (const std::string fault = image_fault(slice); !fault.empty()) return rejected(ArrivalStatus::bad_image, fault);

  // A slice of a new scan is judged against an empty sequence.
  const bool has_scan = !slices_.empty();
  const bool same_scan = has_scan && info.scan_id == scan_id_;
  if (same_scan) {
    const auto kept = std::find_if(slices_.begin(), slices_.end(), [&info](const auto& other) {
      return other->info.stack == info.stack && other->info.index == info.index;
    });
    if (kept != slices_.end())
      return rejected(ArrivalStatus::duplicate,
                      text("already here, acquired at ", seconds((*kept)->info.stamp_ns), " (this one at ",
                           seconds(info.stamp_ns), "); a repeat must come as a new stack number"));
    const auto first = stacks_.find(info.stack);
    if (first != stacks_.end())
      if (const std::string fault = stack_fault(info, first->second, options_); !fault.empty())
        return rejected(ArrivalStatus::inconsistent_stack, fault);
  }

  Arrival arrival;
  arrival.starts_scan = has_scan && !same_scan;

  const double field = options_.size_px * options_.resolution_mm;
  const bool has_mask = !slice.mask.empty();
  Eigen::Vector2d shift = Eigen::Vector2d::Zero();
  if (has_mask) {
    const PixelBox box = brain_box(slice);
    if (box.pixels == 0) return rejected(ArrivalStatus::empty_mask, "the mask has no brain pixel");
    shift = Eigen::Vector2d(0.5 * (box.left + box.right - (info.columns - 1)),
                            0.5 * (box.top + box.bottom - (info.rows - 1)))
                .cwiseProduct(info.pixel_spacing);
    const Eigen::Vector2d brain =
        Eigen::Vector2d(box.right - box.left + 1, box.bottom - box.top + 1).cwiseProduct(info.pixel_spacing);
    if (brain.maxCoeff() + 2. * options_.margin_mm > field)
      arrival.warnings.push_back(text(name, ": the brain is ", brain.x(), " x ", brain.y(), " mm, with its margin of ",
                                      options_.margin_mm, " mm larger than the field of ", field, " x ", field, " mm; ",
                                      pixels_cut(slice, shift, field), " of ", box.pixels, " brain pixels are cut"));
  } else {
    const bool located = same_scan && roi_.from_masks();
    if (located) shift = (info.T_scanner_slice.inverse() * roi_.centre()).head<2>();
    arrival.warnings.push_back(text(name, ": no mask; the whole image counts as brain within ", field, " x ", field,
                                    " mm around the ", located ? "brain's centre so far" : "image's centre"));
  }
  for (int axis = 0; axis < 2; ++axis)
    shift[axis] = snap_to_pixels(shift[axis], info.pixel_spacing[axis], options_.resolution_mm,
                                 axis == 0 ? info.columns : info.rows, options_.size_px);

  // The image is resampled unmasked and masked afterwards: masking first would mix darkness into the brain's border.
  const PlaneGrid source{info.columns, info.rows, info.pixel_spacing};
  const PlaneGrid target{options_.size_px, options_.size_px, {options_.resolution_mm, options_.resolution_mm}};
  prepared.info = info;
  prepared.size = options_.size_px;
  prepared.resolution = options_.resolution_mm;
  prepared.T_slice_crop = Pose::Identity();
  prepared.T_slice_crop.translation().head<2>() = shift;
  prepared.pixels = resample_plane(slice.pixels, source, target, shift, &prepared.mask);
  if (has_mask) {
    std::vector<float> binary(slice.mask.size());
    std::transform(slice.mask.begin(), slice.mask.end(), binary.begin(), [](std::uint8_t m) { return m ? 1.F : 0.F; });
    const std::vector<float> brain = resample_plane(binary, source, target, shift);
    for (std::size_t i = 0; i < brain.size(); ++i) prepared.mask[i] = brain[i] >= 0.5F ? 1 : 0;
  }
  prepared.brain_pixels = 0;
  std::size_t bright = 0;
  for (std::size_t i = 0; i < prepared.mask.size(); ++i) {
    if (!prepared.mask[i]) prepared.pixels[i] = 0.F;
    prepared.brain_pixels += prepared.mask[i];
    if (prepared.pixels[i] > 0.F) ++bright;
  }
  const auto limit = static_cast<std::size_t>(options_.min_brain_pixels);
  if (prepared.brain_pixels < limit)
    return rejected(ArrivalStatus::empty_mask, text(prepared.brain_pixels, " brain pixels of ", options_.resolution_mm,
                                                    " mm after resampling, ", "at least ", limit, " are needed"));
  if (bright < limit)
    return rejected(ArrivalStatus::empty_mask, text(bright, " brain pixels of ", options_.resolution_mm,
                                                    " mm are positive, at least ", limit, " are needed"));

  if (same_scan) {
    const auto overtaken_by = [&](bool same_stack) {
      return std::find_if(slices_.begin(), slices_.end(), [&](const auto& other) {
        return (other->info.stack == info.stack) == same_stack && other->info.stamp_ns > info.stamp_ns;
      });
    };
    auto later = overtaken_by(true);
    if (later != slices_.end()) {
      arrival.status = ArrivalStatus::out_of_order;
    } else if (later = overtaken_by(false); later != slices_.end()) {
      arrival.status = ArrivalStatus::late;
    }
    if (later != slices_.end()) {
      const SliceInfo& other = (*later)->info;
      arrival.reason =
          text(name, ": acquired at ", seconds(info.stamp_ns), ", ", seconds(other.stamp_ns - info.stamp_ns),
               " before ", describe(other), ", which is already here; put in its place");
    }
  }
  return arrival;
}

Arrival SliceSequence::check(const Slice& slice) const {
  PreparedSlice prepared;
  return inspect(slice, prepared);
}

Arrival SliceSequence::add(const Slice& slice) {
  auto prepared = std::make_shared<PreparedSlice>();
  const Arrival arrival = inspect(slice, *prepared);
  if (arrival.starts_scan) {
    auto ended = std::move(ended_scans_);
    ended.insert(scan_id_);
    reset();
    ended_scans_ = std::move(ended);
  }
  ++counts_[arrival.status];
  prepared->arrival = arrival_count_++;
  if (!is_kept(arrival.status)) return arrival;

  scan_id_ = slice.info.scan_id;
  stacks_.emplace(slice.info.stack, slice.info);
  roi_.add(slice);
  std::vector<float> brain_values;
  brain_values.reserve(prepared->brain_pixels);
  for (std::size_t i = 0; i < prepared->mask.size(); ++i)
    if (prepared->mask[i]) brain_values.push_back(prepared->pixels[i]);
  intensity_.add(brain_values);

  newest_ = prepared;
  slices_.insert(std::upper_bound(slices_.begin(), slices_.end(), slice.info.stamp_ns, acquired_before), newest_);
  return arrival;
}

void SliceSequence::reset() {
  scan_id_.clear();
  ended_scans_.clear();
  stacks_.clear();
  slices_.clear();
  newest_.reset();
  counts_.clear();
  arrival_count_ = 0;
  roi_.clear();
  intensity_.clear();
}

}  // namespace svort
