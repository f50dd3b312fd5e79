#pragma once

#include <array>
#include <cstdint>
#include <map>
#include <memory>
#include <string>
#include <utility>
#include <vector>

#include "svort_ros/geometry/image_grid.h"
#include "svort_ros/live/incremental_estimator.h"
#include "svort_ros/sequence/slice_sequence.h"

namespace svort {

/// Why a slice has a low score.
enum class QualityReason { outlier, low_similarity, signal_void, dark, noise, pose_jump };
const char* to_string(QualityReason reason);

/// What a score is made of. All are 0 for a perfect slice, but weight and similarity.
struct QualityFeatures {
  double weight = 1.;       ///< the estimator's, 0 .. 1
  double similarity = 0.;   ///< -log(1 - ncc), ncc clipped to 0 .. 0.995; NaN while no volume holds the slice
  double void_volume = 0.;  ///< share of the brain that is much darker than the volume there; NaN likewise
  double dark_volume =
      0.;  ///< log of how much darker the slice is than its stack, both against the volume; NaN likewise
  double void_image = 0.;  ///< share of the brain that is much darker than in the neighbouring slices
  double dark_image = 0.;  ///< log of how much darker the slice is than its neighbours
  double noise = 0.;       ///< log of its noise against the scan's median, 0 if below
  double jump = 0.;        ///< log(1 + j / 2 mm), j: distance of the head from where it was before and after

  static constexpr std::size_t kCount = 8;
  std::array<double, kCount> values() const {
    return {weight, similarity, void_volume, dark_volume, void_image, dark_image, noise, jump};
  }
  static const std::array<const char*, kCount>& names();
};

/// Logistic score: 1 / (1 + exp(-(intercept + sum of coefficient * feature))). The defaults were calibrated on
/// simulated damage; docs/quality.md says how, and how well they separate.
struct SliceQualityOptions {
  double accept = 0.5;  ///< a slice below this score should be acquired again
  /// A feature is named as a reason if it lowers the logit by more than this against a typical good slice.
  double reason_logit = 1.;
  double intercept = -0.07;
  double weight = 0.56;
  double similarity = 0.22;
  double void_volume = -19.05;
  double dark_volume = -3.55;
  double void_image = -17.93;
  double dark_image = -2.95;
  double noise = -3.78;
  double jump = -1.11;
  double image_intercept = 0.47;  ///< of the score that knows the images alone
  double image_void = -21.12;
  double image_dark = -5.33;
  double image_noise = -4.;

  template <class Visitor>
  void visit(Visitor&& v) {
    v("accept", accept, "a slice with a lower score should be acquired again, 0 .. 1");
    v("reason_logit", reason_logit, "a feature that lowers the logit by more is named as a reason");
    v("intercept", intercept, "of the logit of the score");
    v("weight", weight, "coefficient of the estimator's weight");
    v("similarity", similarity, "coefficient of -log(1 - ncc)");
    v("void_volume", void_volume, "coefficient of the share of the brain that is darker than the volume");
    v("dark_volume", dark_volume, "coefficient of the log of the whole slice's darkness against the volume");
    v("void_image", void_image, "coefficient of the share of the brain that is darker than in neighbouring slices");
    v("dark_image", dark_image, "coefficient of the log of the whole slice's darkness against neighbouring slices");
    v("noise", noise, "coefficient of the log of the noise against the scan's median");
    v("jump", jump, "coefficient of log(1 + jump / 2 mm)");
    v("image_intercept", image_intercept, "of the logit of the score from the images alone");
    v("image_void", image_void, "coefficient of void_image there");
    v("image_dark", image_dark, "coefficient of dark_image there");
    v("image_noise", image_noise, "coefficient of noise there");
  }
};

/// @throws std::invalid_argument naming the option that is out of range
void validate(const SliceQualityOptions& options);

/// What is known about one slice's quality at one revision.
struct SliceQuality {
  int stack = 0;
  int index = 0;
  std::int64_t stamp_ns = 0;
  QualityFeatures features;
  double score = 0.;        ///< 0 (spoilt) .. 1
  double image_score = 0.;  ///< the same from the images alone: no pose, no volume
  double first_score = 0.;  ///< as it was when first given, for the live decision
  std::vector<QualityReason> reasons;
};

/// Block means of a prepared slice's brain, the resolution at which quality and coverage look at images.
struct SliceBlocks {
  int size = 0;                            ///< blocks along each side of the crop
  double edge_mm = 0.;                     ///< of a block
  Pose T_slice_blocks = Pose::Identity();  ///< crop coordinates (mm, centred) into slice coordinates
  std::vector<float> mean;                 ///< size x size, raw intensity; meaningless where `brain` is 0
  std::vector<std::uint8_t> brain;         ///< 1 if at least half of the block is brain
  double brain_mm2 = 0.;                   ///< area of the mask
  double typical = 0.;                     ///< mean intensity of the brain
  double noise = 0.;                       ///< robust deviation of second differences along rows and columns

  /// Centre of block (column, row) in slice coordinates, mm.
  Eigen::Vector3d centre(int column, int row) const {
    const double middle = 0.5 * (size - 1);
    return T_slice_blocks * Eigen::Vector3d((column - middle) * edge_mm, (row - middle) * edge_mm, 0.);
  }
  /// Number of the block that holds a point of the slice, or -1 outside.
  int at(const Eigen::Vector3d& in_slice) const;
};
SliceBlocks make_blocks(const PreparedSlice& slice);

/// Scores all slices of a scan. Not thread-safe: one owner.
class QualityMonitor {
 public:
  /// @throws std::invalid_argument naming the option that is out of range
  explicit QualityMonitor(const SliceQualityOptions& options);

  /// @param estimate one slice for each of the sequence, in its order
  /// @param volume   in the brain frame of `estimate`, intensity divided by the sequence's scale; may be empty
  /// @param radius_mm of the sphere on which jumps are measured
  const std::vector<SliceQuality>& update(const SliceSequence& sequence, const Estimate& estimate, const Volume& volume,
                                          double radius_mm);
  const std::vector<SliceQuality>& slices() const { return slices_; }
  /// Blocks of slice `i` of the last update.
  const SliceBlocks& blocks(std::size_t i) const { return *blocks_[i]; }
  std::size_t size() const { return blocks_.size(); }
  void set_options(const SliceQualityOptions& options);
  void clear();

 private:
  SliceQualityOptions options_;
  std::map<std::pair<int, int>, std::shared_ptr<const SliceBlocks>> cache_;  ///< by stack and index
  std::map<std::pair<int, int>, double> first_scores_;
  std::vector<std::shared_ptr<const SliceBlocks>> blocks_;
  std::vector<SliceQuality> slices_;
};

/// What a feature that is not known yet counts as: about the median of undamaged slices.
const QualityFeatures& typical_quality();

/// Score of given features.
double quality_score(const QualityFeatures& features, const SliceQualityOptions& options);
double image_quality_score(const QualityFeatures& features, const SliceQualityOptions& options);

}  // namespace svort
