#include "svort_ros/live/network_input.h"

#include <algorithm>
#include <cmath>
#include <iterator>
#include <limits>
#include <map>
#include <stdexcept>

#include "svort_ros/geometry/rigid_transform.h"

namespace svort {
namespace {

constexpr double kQuantile = 0.99;  // of a stack's positive pixels becomes 1, as in the public implementation

/// What the slices of one stack share.
struct StackFrame {
  int number = 0;  ///< in the order in which the stacks began
  int first = std::numeric_limits<int>::max(), last = std::numeric_limits<int>::min();  ///< slice indices
  Eigen::Matrix3d axes = Eigen::Matrix3d::Identity();  ///< of its first slice, in the scanner
  Eigen::Vector3d origin = Eigen::Vector3d::Zero();    ///< in those axes, mm
  std::size_t count = 0, largest = 0;                  ///< slices; brain pixels of the largest
  std::vector<float> positive;                         ///< pixels
  float scale = 1.F;
};

Eigen::Vector3d crop_centre(const PreparedSlice& slice) {
  return (slice.info.T_scanner_slice * slice.T_slice_crop).translation();
}

/// @param intensities whether the stacks' own scales are needed
std::map<int, StackFrame> stack_frames(const SliceSequence& sequence, bool intensities) {
  std::map<int, StackFrame> frames;
  for (const auto& slice : sequence.slices()) {
    const auto [entry, is_new] = frames.try_emplace(slice->info.stack);
    StackFrame& frame = entry->second;
    if (is_new) {
      frame.number = static_cast<int>(frames.size()) - 1;
      frame.axes = slice->info.T_scanner_slice.linear();
    }
    frame.first = std::min(frame.first, slice->info.index);
    frame.last = std::max(frame.last, slice->info.index);
    const Eigen::Vector3d centre = frame.axes.transpose() * crop_centre(*slice);
    if (is_new || slice->brain_pixels > frame.largest) {
      frame.origin.head<2>() = centre.head<2>();
      frame.largest = slice->brain_pixels;
    }
    ++frame.count;
    frame.origin.z() += (centre.z() - frame.origin.z()) / static_cast<double>(frame.count);
    if (!intensities) continue;
    std::copy_if(slice->pixels.begin(), slice->pixels.end(), std::back_inserter(frame.positive),
                 [](float value) { return value > 0.F; });
  }
  for (auto& [stack, frame] : frames) {
    if (frame.positive.empty()) continue;
    const auto rank = static_cast<std::ptrdiff_t>(kQuantile * static_cast<double>(frame.positive.size() - 1));
    std::nth_element(frame.positive.begin(), frame.positive.begin() + rank, frame.positive.end());
    frame.scale = frame.positive[static_cast<std::size_t>(rank)];
    frame.positive.clear();
  }
  return frames;
}

/// out(x, y) = in(x - shift_x, y - shift_y) / scale, 0 beyond the edge.
void copy_shifted(const PreparedSlice& slice, int shift_x, int shift_y, float scale, float* out) {
  const int size = slice.size;
  std::fill(out, out + size * size, 0.F);
  for (int y = std::max(0, shift_y); y < std::min(size, size + shift_y); ++y) {
    for (int x = std::max(0, shift_x); x < std::min(size, size + shift_x); ++x) {
      out[y * size + x] = slice.pixels[static_cast<std::size_t>((y - shift_y) * size + x - shift_x)] / scale;
    }
  }
}

/// @param images whether to fill in `slices`
SequenceInput prepare(const SliceSequence& sequence, bool common_frame, bool images) {
  const auto& slices = sequence.slices();
  if (slices.empty()) throw std::invalid_argument("network_input: the sequence is empty");
  const auto n = static_cast<std::int64_t>(slices.size());
  const std::int64_t size = slices.front()->size;
  const double resolution = slices.front()->resolution;

  SequenceInput result;
  NetworkInput& input = result.input;
  if (images) input.slices = torch::empty({n, 1, size, size});
  input.transforms = torch::empty({n, 3, 4});
  input.positions = torch::empty({n, 2});
  input.slice_counts = torch::empty({n}, torch::kInt64);
  input.times = torch::empty({n});
  input.common_frame = common_frame;
  input.slice_resolution_mm = resolution;
  input.thickness_mm = 0.;

  const std::map<int, StackFrame> frames = stack_frames(sequence, !common_frame);
  Pose T_scanner_centre = Pose::Identity();
  T_scanner_centre.translation() =
      sequence.brain_roi().empty() ? crop_centre(*slices.front()) : sequence.brain_roi().centre();
  for (std::int64_t i = 0; i < n; ++i) {
    const PreparedSlice& slice = *slices[static_cast<std::size_t>(i)];
    const StackFrame& frame = frames.at(slice.info.stack);
    const Pose T_scanner_crop = slice.info.T_scanner_slice * slice.T_slice_crop;
    Pose T_frame_window = T_scanner_centre.inverse() * T_scanner_crop;
    Pose T_slice_window = slice.T_slice_crop;
    int shift_x = 0, shift_y = 0;
    int index = slice.info.index - slice.info.slices_in_stack / 2;
    auto scale = static_cast<float>(sequence.intensity_scale());
    if (!common_frame) {
      const Eigen::Vector3d offset = frame.axes.transpose() * T_scanner_crop.translation() - frame.origin;
      shift_x = static_cast<int>(std::lround(offset.x() / resolution));
      shift_y = static_cast<int>(std::lround(offset.y() / resolution));
      const Eigen::Vector3d shift(shift_x * resolution, shift_y * resolution, 0.);
      T_frame_window.linear() = frame.axes.transpose() * T_scanner_crop.linear();
      T_frame_window.translation() = offset - T_frame_window.linear() * shift;
      T_slice_window = slice.T_slice_crop * Eigen::Translation3d(-shift);
      index = slice.info.index - frame.first - (frame.last - frame.first + 1) / 2;
      scale = frame.scale;
    }
    if (images) copy_shifted(slice, shift_x, shift_y, scale, input.slices[i].data_ptr<float>());
    input.transforms[i].copy_(tensor_from_pose(T_frame_window).squeeze(0));
    input.positions[i][0] = static_cast<float>(index);
    input.positions[i][1] = static_cast<float>(frame.number);
    input.slice_counts[i] = slice.info.slices_in_stack;
    input.times[i] =
        static_cast<float>(static_cast<double>(slice.info.stamp_ns - slices.front()->info.stamp_ns) * 1e-9);
    // One thickness for all: the public implementation takes the mean, too.
    input.thickness_mm += slice.info.thickness / static_cast<double>(n);
    result.T_slice_window.push_back(T_slice_window);
  }
  return result;
}

}  // namespace

SequenceInput network_input(const SliceSequence& sequence, bool common_frame) {
  return prepare(sequence, common_frame, true);
}

NetworkInput network_geometry(const SliceSequence& sequence) { return prepare(sequence, true, false).input; }

}  // namespace svort
