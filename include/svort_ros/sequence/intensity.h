#pragma once

#include <cstddef>
#include <cstdint>
#include <vector>

namespace svort {

struct IntensityOptions {
  /// Quantile of the brain's intensities that is mapped to 1. Lower it if bright vessels or fat leak into the masks.
  double quantile = 0.99;
  /// The scale in use is kept until the running estimate differs from it by this fraction, so that early slices do
  /// not change scale for no reason. 0 follows every slice.
  double hold_fraction = 0.1;

  template <class Visitor>
  void visit(Visitor&& v) {
    v("quantile", quantile, "quantile of the brain's intensities that is mapped to 1, in (0, 1]");
    v("hold_fraction", hold_fraction, "relative change of the running scale that is tolerated before rescaling");
  }
};

/// Running intensity scale of a scan, from the brain pixels of all slices so far.
///
/// The running estimate does not depend on the order of the slices; the scale in use follows it to within
/// `hold_fraction`.
class IntensityScale {
 public:
  /// @throws std::invalid_argument naming the option that is out of range
  explicit IntensityScale(const IntensityOptions& options = {});

  /// Adds one slice's brain pixels (finite; those that are not positive do not count: they are background or clipped).
  /// @return true if the scale in use changed.
  bool add(const std::vector<float>& brain_values);
  void clear();

  /// Divide raw intensities by this; 1 until the first slice with a positive pixel.
  double scale() const { return scale_; }

 private:
  IntensityOptions options_;
  std::vector<float> samples_;  ///< a bounded, evenly spaced sample of every slice's brain pixels
  double scale_ = 1.;
};

}  // namespace svort
