#pragma once

#include <torch/types.h>

#include <array>
#include <optional>
#include <vector>

namespace svort {

/// Gaussian point spread function of a slice, sampled on a grid of voxels in the slice's own frame.
///
/// FWHM is 1.2 x `resolution_ratio` in plane and 1 x through plane (paper, sec. 2; rule of the public implementation).
/// Taps below 1e-3 of the peak are zero, the array is cropped to the taps that remain, and the sum is 1.
///
/// @param resolution_ratio slice pixel (x, y) and thickness (z) in voxels
/// @param r_max            half width before cropping, in voxels; default: enough for the widest axis
/// @return float32, (2 rz + 1) x (2 ry + 1) x (2 rx + 1), indexed [z][y][x]
/// @throws std::invalid_argument unless every ratio is finite and positive
torch::Tensor gaussian_psf(const std::array<double, 3>& resolution_ratio, std::optional<int> r_max = std::nullopt);

/// Several PSFs (stacks of different thickness) as one array: padded with zeros around their centres to a common size.
///
/// @param psfs at least one, each z x y x x of odd sizes
/// @return psfs.size() x z x y x x
/// @throws std::invalid_argument if there is none, or one is not three-dimensional or has an even size
torch::Tensor stack_psfs(const std::vector<torch::Tensor>& psfs);

}  // namespace svort
