#include "svort_ros/ros/arrivals.h"

#include <algorithm>
#include <cstdio>

namespace svort_ros {
namespace {

template <class... Values>
std::string print(const char* format, Values... values) {
  const int length = std::snprintf(nullptr, 0, format, values...);
  std::string text(static_cast<std::size_t>(length) + 1, '\0');
  std::snprintf(text.data(), text.size(), format, values...);
  text.pop_back();
  return text;
}

const svort::SliceEstimate* find_slice(const svort::Estimate& estimate, const svort::SliceInfo& info) {
  // The slices asked for are the newest ones, which are at the end.
  const auto found =
      std::find_if(estimate.slices.rbegin(), estimate.slices.rend(), [&](const svort::SliceEstimate& slice) {
        return slice.info.stack == info.stack && slice.info.index == info.index;
      });
  return found == estimate.slices.rend() ? nullptr : &*found;
}

}  // namespace

double milliseconds_since(Clock::time_point start) {
  return std::chrono::duration<double, std::milli>(Clock::now() - start).count();
}

svort::JournalEntry make_journal_entry(const svort::LivePipeline& pipeline, const svort::SliceInfo& info,
                                       const svort::Arrival& arrival) {
  svort::JournalEntry entry;
  entry.info = info;
  entry.status = arrival.status;
  entry.reason = arrival.reason;
  entry.sequence_length = pipeline.sequence().slices().size();
  entry.device = pipeline.device();
  if (svort::is_kept(arrival.status)) {
    entry.revision = pipeline.estimate().revision;
    entry.encoded = pipeline.estimate().encoded;
    entry.T_brain_slice = pipeline.newest()->T_brain_slice;
    entry.start = pipeline.newest()->start;
    entry.radius_95_mm = pipeline.newest()->radius_95_mm;
  }
  return entry;
}

HeadDisplacement head_displacement(const svort::SliceEstimate& first, const svort::SliceEstimate& slice) {
  constexpr double kDegreesPerRadian = 57.29577951308232;
  const svort::Pose motion = first.T_scanner_brain.inverse() * slice.T_scanner_brain;
  return {motion.translation().norm(), svort::rotation_angle(motion) * kDegreesPerRadian};
}

void ScanProgress::add(const svort::SliceInfo& info, svort::ArrivalStatus status) {
  // What a broken message prescribes cannot be trusted.
  if (!svort::is_kept(status) && status != svort::ArrivalStatus::empty_mask) return;
  ++done_;
  const auto known =
      std::find_if(stacks_.begin(), stacks_.end(), [&](const auto& stack) { return stack.first == info.stack; });
  if (known == stacks_.end()) stacks_.emplace_back(info.stack, info.slices_in_stack);
}

std::size_t ScanProgress::prescribed() const {
  std::size_t sum = 0;
  for (const auto& stack : stacks_) sum += static_cast<std::size_t>(std::max(0, stack.second));
  return sum;
}

std::string progress_head(const ScanProgress& progress, const svort::SliceInfo& info, svort::ArrivalStatus status) {
  return print("[%3zu/%3zu] stack %d slice %2d  %-8s", progress.done(), progress.prescribed(), info.stack, info.index,
               svort::to_string(status));
}

std::string rejection_line(const std::string& head, const svort::JournalEntry& entry) {
  const std::string place = svort::describe(entry.info) + ": ";  // the head says it already
  const bool repeated = entry.reason.compare(0, place.size(), place) == 0;
  return head + "  " + (repeated ? entry.reason.substr(place.size()) : entry.reason);
}

std::string progress_line(const std::string& head, const svort::JournalEntry& entry, const svort::SliceEstimate& first,
                          const svort::SliceEstimate& slice) {
  const HeadDisplacement displacement = head_displacement(first, slice);
  return print("%s  pose %5.1f ms  volume %4.0f ms  head %.1f mm %.1f deg  %s", head.c_str(), entry.latency_ms,
               entry.volume_latency_ms, displacement.distance_mm, displacement.angle_deg,
               svort::to_string(slice.status));
}

std::vector<AwaitingVolume::Published> AwaitingVolume::volume_published(svort::LivePipeline& pipeline) {
  std::vector<Published> published;
  for (const Item& item : items_) {
    const double latency_ms = milliseconds_since(item.arrived);
    pipeline.journal().set_volume_latency(item.entry, latency_ms);
    const svort::JournalEntry& entry = pipeline.journal().entries().at(item.entry);
    if (const svort::SliceEstimate* slice = find_slice(pipeline.estimate(), entry.info))
      published.push_back(
          {item, latency_ms, progress_line(item.head, entry, pipeline.estimate().slices.front(), *slice)});
  }
  items_.clear();
  return published;
}

}  // namespace svort_ros
