// The inner loops for processors with AVX2, without changing what the rest of the program needs. No fused
// multiply-add: results must not depend on the processor.
#if defined(__x86_64__)

#include <cstring>

#include "tap_kernels.h"

#define SVORT_WIDE_LANES 1

#if defined(__clang__)
#pragma clang attribute push(__attribute__((target("avx2"))), apply_to = function)
#else
#pragma GCC push_options
#pragma GCC target("avx2")
#endif

namespace svort {
namespace {
#include "tap_kernels_impl.h"
}  // namespace

const TapKernels& avx2_tap_kernels() { return kKernels; }

}  // namespace svort

#if defined(__clang__)
#pragma clang attribute pop
#else
#pragma GCC pop_options
#endif

#endif
