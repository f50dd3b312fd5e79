#include "tap_kernels.h"

#include <cstring>

#define SVORT_WIDE_LANES 0

namespace svort {
namespace {
#include "tap_kernels_impl.h"
}  // namespace

const TapKernels& baseline_tap_kernels() { return kKernels; }

const TapKernels& tap_kernels() {
#if defined(__x86_64__)
  static const bool has_avx2 = __builtin_cpu_supports("avx2");
  if (has_avx2) return avx2_tap_kernels();
#endif
  return baseline_tap_kernels();
}

}  // namespace svort
