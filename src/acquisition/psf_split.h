#pragma once

#include <array>
#include <cstdint>
#include <vector>

#include "tap_sampler.h"

namespace svort {

/// Several Gaussian PSFs as one isotropic blur of the volume, common to all, and the taps that remain of each.
///
/// Gaussians convolve by adding their variances, and an isotropic one looks the same from every direction: the part of
/// the PSF that is common to all axes can be applied to the volume before the slice's orientation is known.
struct PsfSplit {
  std::vector<float> blur;      ///< half a symmetric kernel along each axis, from the centre; {1} if there is no blur
  std::vector<PsfTaps> remain;  ///< one list per PSF

  std::int32_t radius() const { return static_cast<std::int32_t>(blur.size()) - 1; }
};

/// @param psfs  m arrays of `size` (z, y, x), one after the other
/// @throws std::invalid_argument, beginning with `function`, if a PSF is not such a Gaussian
PsfSplit split_psfs(const char* function, const float* psfs, std::int64_t count,
                    const std::array<std::int64_t, 3>& size);

/// Blurs along all three axes, with zeros around the volume: symmetric, so it is its own adjoint.
/// `in` and `out` may be the same array.
void blur_volume(const std::vector<float>& half_kernel, const VolumeShape& shape, const float* in, float* out);

}  // namespace svort
