#pragma once

#include <cstddef>
#include <cstdint>
#include <map>
#include <memory>
#include <set>
#include <string>
#include <vector>

#include "svort_ros/acquisition/slice.h"
#include "svort_ros/sequence/brain_roi.h"
#include "svort_ros/sequence/intensity.h"

namespace svort {

/// Answer to one arriving slice. The first three keep the slice, the others leave the sequence as it was.
///
/// A slice with several faults gets the first of: ended_scan, bad_geometry, excess_slice, bad_image, duplicate,
/// inconsistent_stack, empty_mask.
enum class ArrivalStatus {
  accepted,            ///< newest in acquisition order
  out_of_order,        ///< kept: acquired before a slice of the same stack that is already here
  late,                ///< kept: acquired before a slice of another stack that is already here
  duplicate,           ///< rejected: this stack and index are already here; a repeat must come as a new stack number
  empty_mask,          ///< rejected: the mask, or the image without one, shows no brain
  bad_image,           ///< rejected: wrong length or size of image or mask, NaN or infinity
  bad_geometry,        ///< rejected: pose not rigid, spacing or thickness not positive, negative stack or index
  inconsistent_stack,  ///< rejected: differs from the geometry of the stack's first kept slice
  excess_slice,        ///< rejected: index beyond the number of slices prescribed for the stack
  ended_scan,          ///< rejected: belongs to a scan that a newer scan has ended
};

/// Name used in messages and files, e.g. "out_of_order".
const char* to_string(ArrivalStatus status);
/// True if the slice is in the sequence now.
bool is_kept(ArrivalStatus status);

struct Arrival {
  ArrivalStatus status = ArrivalStatus::accepted;
  std::string reason;                 ///< names the slice, the value and the limit; empty if there is nothing to say
  std::vector<std::string> warnings;  ///< kept slice, but e.g. a brain larger than the field, or no mask
  bool starts_scan = false;           ///< a changed scan id: the previous sequence was ended and is gone from here
};

/// A kept slice, cropped to the brain and resampled to the network's grid.
struct PreparedSlice {
  SliceInfo info;                        ///< as it arrived
  std::uint64_t arrival = 0;             ///< number of the arrival within the scan, from 0; rejected ones count
  int size = 0;                          ///< the crop is size x size pixels
  double resolution = 1.;                ///< its pixel size, mm
  Pose T_slice_crop = Pose::Identity();  ///< crop coordinates into slice coordinates: an in-plane shift, mm
  std::vector<float> pixels;             ///< size x size, raw intensity (divide by intensity_scale), 0 off the mask
  std::vector<std::uint8_t> mask;        ///< size x size, 1 where the brain is
  std::size_t brain_pixels = 0;          ///< number of ones in `mask`
};

struct SliceSequenceOptions {
  int size_px = 128;                       ///< width and height of the prepared slice; must match the network
  double resolution_mm = 1.0;              ///< pixel size of the prepared slice
  double margin_mm = 3.0;                  ///< kept around the mask when its size is compared with the field
  int min_brain_pixels = 16;               ///< fewer (after resampling) count as an empty mask
  double stack_angle_tolerance_deg = 1.0;  ///< allowed angle between slices of one stack
  double stack_offset_tolerance_mm = 0.5;  ///< allowed in-plane offset between slices of one stack
  IntensityOptions intensity;

  template <class Visitor>
  void visit(Visitor&& v) {
    v("size_px", size_px, "width and height of the prepared slice, pixels; must match the network");
    v("resolution_mm", resolution_mm, "pixel size of the prepared slice, mm");
    v("margin_mm", margin_mm, "kept around the mask when its size is compared with the field, mm");
    v("min_brain_pixels", min_brain_pixels, "a slice with fewer brain pixels after resampling counts as empty");
    v("stack_angle_tolerance_deg", stack_angle_tolerance_deg, "allowed angle between slices of one stack, degrees");
    v("stack_offset_tolerance_mm", stack_offset_tolerance_mm, "allowed in-plane offset within a stack, mm");
    v.section("intensity", intensity);
  }
};

/// The growing sequence of slices of one scan, in acquisition order. Not thread-safe: one owner.
///
/// The crop is centred on the box around the slice's brain pixels (shifted by less than half a pixel if that spares
/// interpolation). A slice without a mask is kept whole, in a window around the brain's centre as known from the masks
/// so far, else around the image's centre, and says so in a warning; it does not tell where the brain is (BrainRoi)
/// once slices with masks do. Apart from that window, slices() does not depend on the order of arrival.
class SliceSequence {
 public:
  /// @throws std::invalid_argument naming the option that is out of range
  explicit SliceSequence(const SliceSequenceOptions& options = {});

  /// What add() would answer, without changing anything (warnings included, starts_scan too).
  Arrival check(const Slice& slice) const;

  /// Validates the slice and keeps it, or says why not. A slice with a new scan id clears the sequence first
  /// (starts_scan): a caller who wants the old one must look at check() before.
  Arrival add(const Slice& slice);

  /// Kept slices by acquisition time, ties by arrival. A pointer stays valid and unchanged after later calls.
  const std::vector<std::shared_ptr<const PreparedSlice>>& slices() const { return slices_; }
  /// The slice kept by the last add() that kept one; null before.
  std::shared_ptr<const PreparedSlice> newest_arrival() const { return newest_; }

  const std::string& scan_id() const { return scan_id_; }
  /// Number of arrivals since this scan began, by status, rejected ones included (whatever scan they name).
  const std::map<ArrivalStatus, std::size_t>& arrivals() const { return counts_; }
  double intensity_scale() const { return intensity_.scale(); }
  const BrainRoi& brain_roi() const { return roi_; }
  const SliceSequenceOptions& options() const { return options_; }

  /// Forgets everything, ended scans too.
  void reset();

 private:
  /// The one place that decides. Fills `prepared` if the slice would be kept.
  Arrival inspect(const Slice& slice, PreparedSlice& prepared) const;

  SliceSequenceOptions options_;
  std::string scan_id_;
  std::set<std::string> ended_scans_;
  std::map<int, SliceInfo> stacks_;  ///< first kept slice of each stack
  std::vector<std::shared_ptr<const PreparedSlice>> slices_;
  std::shared_ptr<const PreparedSlice> newest_;
  std::map<ArrivalStatus, std::size_t> counts_;
  std::uint64_t arrival_count_ = 0;
  BrainRoi roi_;
  IntensityScale intensity_;
};

}  // namespace svort
