#pragma once

namespace svort {

/// What is kept of a scan from slice to slice, and for how long.
struct NetworkCacheOptions {
  double stale_mm = 0.5;      ///< a slice whose plane moved by more is encoded in the volume again, mm
  double stale_share = 0.05;  ///< and one whose view of the volume changed by more, as part of its mean intensity
  int refreshed = 8;          ///< older slices that are looked at again per arrival, at most

  template <class Visitor>
  void visit(Visitor&& v) {
    v("stale_mm", stale_mm, "a slice that moved by more is encoded in the volume again, mm");
    v("stale_share", stale_share, "and one whose view of the volume changed by more, as part of its mean intensity");
    v("refreshed", refreshed, "older slices that are looked at again per arrival, at most");
  }
};

/// @throws std::invalid_argument naming the option that is out of range
void validate(const NetworkCacheOptions& options);

}  // namespace svort
