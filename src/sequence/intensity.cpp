#include "svort_ros/sequence/intensity.h"

#include <algorithm>
#include <cmath>
#include <sstream>
#include <stdexcept>

namespace svort {
namespace {

// One sample stands for this many pixels, so a slice weighs by its brain area: 1024 samples for a full 128 x 128 field.
constexpr std::size_t kPixelsPerSample = 16;

void require(bool ok, const char* option, double value, const char* limit) {
  if (ok) return;
  std::ostringstream message;
  message << "sequence.intensity." << option << " is " << value << ", must be " << limit;
  throw std::invalid_argument(message.str());
}

}  // namespace

IntensityScale::IntensityScale(const IntensityOptions& options) : options_(options) {
  require(options.quantile > 0. && options.quantile <= 1., "quantile", options.quantile, "in (0, 1]");
  require(std::isfinite(options.hold_fraction) && options.hold_fraction >= 0., "hold_fraction", options.hold_fraction,
          "at least 0");
}

bool IntensityScale::add(const std::vector<float>& brain_values) {
  std::vector<float> values;
  values.reserve(brain_values.size());
  std::copy_if(brain_values.begin(), brain_values.end(), std::back_inserter(values), [](float v) { return v > 0.F; });
  if (values.empty()) return false;

  // Evenly spaced order statistics say more about the distribution than evenly spaced pixels do.
  std::sort(values.begin(), values.end());
  const std::size_t count = std::max<std::size_t>(1, values.size() / kPixelsPerSample);
  for (std::size_t i = 0; i < count; ++i) samples_.push_back(values[(2 * i + 1) * values.size() / (2 * count)]);

  const auto rank =
      static_cast<std::size_t>(std::ceil(options_.quantile * static_cast<double>(samples_.size()))) - std::size_t{1};
  std::vector<float> order = samples_;
  std::nth_element(order.begin(), order.begin() + static_cast<std::ptrdiff_t>(rank), order.end());
  const double running = order[rank];

  const bool first = samples_.size() == count;
  if (!first && std::abs(running - scale_) <= options_.hold_fraction * scale_) return false;
  const bool changed = running != scale_;
  scale_ = running;
  return changed;
}

void IntensityScale::clear() {
  samples_.clear();
  scale_ = 1.;
}

}  // namespace svort
