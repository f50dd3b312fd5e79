#include "svort_ros/live/live_pipeline.h"

#include <utility>

namespace svort {

LivePipeline::LivePipeline(const PipelineOptions& options, std::vector<BrainTemplate> templates)
    : options_(options),
      sequence_(options.sequence),
      estimator_(make_estimator(options.estimator, std::move(templates))) {}

void LivePipeline::set_scan_end_callback(std::function<void(const LivePipeline&)> callback) {
  on_scan_end_ = std::move(callback);
}

Arrival LivePipeline::add(const Slice& slice) {
  const bool other_scan = slice.info.scan_id != sequence_.scan_id();
  if (other_scan && sequence_.check(slice).starts_scan) {
    finalise();
    if (on_scan_end_) on_scan_end_(*this);
    // The sequence forgets the old scan itself, in add(); it remembers that the scan has ended.
    estimator_->reset();
    journal_.clear();
    volume_is_stale_ = false;
  }
  Arrival arrival = sequence_.add(slice);
  if (is_kept(arrival.status)) {
    estimator_->add(sequence_);
    volume_is_stale_ = true;
  }
  return arrival;
}

bool LivePipeline::update_volume() {
  if (!volume_is_stale_) return false;
  estimator_->update_volume(sequence_);
  volume_is_stale_ = false;
  return true;
}

bool LivePipeline::improve() {
  if (sequence_.slices().empty() || !estimator_->improve(sequence_)) return false;
  volume_is_stale_ = true;
  return true;
}

bool LivePipeline::finalise(const std::atomic<bool>* stop) {
  if (sequence_.slices().empty() || estimate().final) return false;
  estimator_->finalise(sequence_, stop);
  if (!estimate().final) return false;
  volume_is_stale_ = false;
  return true;
}

void LivePipeline::reset() {
  sequence_.reset();
  estimator_->reset();
  journal_.clear();
  volume_is_stale_ = false;
}

const SliceEstimate* LivePipeline::newest() const {
  const auto newest = sequence_.newest_arrival();
  if (!newest) return nullptr;
  const auto& ordered = sequence_.slices();
  for (std::size_t i = ordered.size(); i-- > 0;)  // almost always the last one
    if (ordered[i] == newest) return &estimate().slices[i];
  return nullptr;
}

}  // namespace svort
