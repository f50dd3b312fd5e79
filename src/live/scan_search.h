#pragma once

#include <atomic>
#include <cstddef>
#include <future>
#include <memory>
#include <optional>
#include <vector>

#include "svort_ros/geometry/pose.h"
#include "svort_ros/registration/pose_refinement.h"
#include "svort_ros/registration/registration_input.h"
#include "svort_ros/registration/template_registration.h"
#include "svort_ros/sequence/slice_sequence.h"

namespace svort {

/// What a search has found.
struct FoundPoses {
  std::vector<std::shared_ptr<const PreparedSlice>> slices;  ///< those that there were when it began
  std::vector<RefinedSlice> poses;                           ///< of their crops, in a frame of their own
};

/// search_scan() in a thread of its own, while slices go on arriving. It takes one core, so that they find another.
///
/// What it finds depends on what it was given alone, not on how long it takes. One owner calls it.
class ScanSearch {
 public:
  /// Gives up what is running, and waits for that.
  ~ScanSearch();

  /// Begins, with the slices as they are now. Whatever ran before is given up.
  /// @param followed one pose per slice of the sequence, of its crop
  /// @param guess    the same, from elsewhere, tried first; or empty
  void start(const SliceSequence& sequence, const std::vector<Pose>& followed, const std::vector<Pose>& guess,
             double size_mm, const RefinementOptions& options, const TemplateOptions& match);

  /// It was started, and take() was not called since.
  bool started() const { return answer_.valid(); }
  /// take() would not have to wait.
  bool ready() const;
  /// Slices of the sequence when it was last started; 0 before.
  std::size_t count() const { return count_; }

  /// Waits for the answer. @return nothing if there are no clearly better poses
  std::optional<FoundPoses> take();

  /// Its answer is not wanted any more.
  void give_up();

 private:
  std::vector<std::shared_ptr<const PreparedSlice>> slices_;
  std::size_t count_ = 0;
  std::shared_ptr<std::atomic<bool>> stop_;
  std::future<std::optional<Refinement>> answer_;
  std::future<std::optional<Refinement>> unwanted_;  ///< given up, but perhaps still running
};

}  // namespace svort
