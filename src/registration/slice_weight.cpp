#include "slice_weight.h"

#include <cmath>
#include <sstream>

namespace svort {

void weigh_slice(double outlier_ncc, RefinedSlice* slice) {
  slice->reason.clear();
  if (!std::isfinite(slice->ncc)) {
    slice->weight = 0.;
    slice->reason = "too few pixels, or none that differ";
  } else if (slice->ncc < outlier_ncc) {
    slice->weight = 0.;
    std::ostringstream reason;
    reason.precision(2);
    reason << std::fixed << "correlation " << slice->ncc << " with the volume, below " << outlier_ncc;
    slice->reason = reason.str();
  } else {
    slice->weight = std::pow(slice->ncc, 4.);
  }
}

}  // namespace svort
