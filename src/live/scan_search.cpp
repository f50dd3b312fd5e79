#include "scan_search.h"

#include <torch/types.h>

#include <chrono>
#include <utility>

#include "svort_ros/live/sequence_tensors.h"
#include "svort_ros/live/threads.h"
#include "svort_ros/registration/scan_registration.h"

namespace svort {

ScanSearch::~ScanSearch() { give_up(); }

void ScanSearch::start(const SliceSequence& sequence, const std::vector<Pose>& followed, const std::vector<Pose>& guess,
                       double size_mm, const RefinementOptions& options, const TemplateOptions& match) {
  give_up();
  if (unwanted_.valid()) unwanted_.wait();
  slices_ = sequence.slices();
  count_ = slices_.size();
  stop_ = std::make_shared<std::atomic<bool>>(false);
  const auto search = [input = registration_input(sequence), followed, guess, size_mm, options, match, stop = stop_,
                       threads = thread_count()] {
    const torch::NoGradGuard no_grad;
    const OneCoreScope one_core(threads);
    return search_scan(input, followed, guess, size_mm, options, match, stop.get());
  };
  answer_ = std::async(std::launch::async, search);
}

bool ScanSearch::ready() const {
  return answer_.valid() && answer_.wait_for(std::chrono::seconds(0)) == std::future_status::ready;
}

std::optional<FoundPoses> ScanSearch::take() {
  std::optional<Refinement> refinement = answer_.get();
  if (!refinement) return std::nullopt;
  return FoundPoses{std::move(slices_), std::move(refinement->slices)};
}

void ScanSearch::give_up() {
  count_ = 0;
  if (!answer_.valid()) return;
  stop_->store(true);
  // At most one is on its way out: assigning waits for the one before.
  unwanted_ = std::move(answer_);
}

}  // namespace svort
