#pragma once

#include <torch/types.h>

#include <optional>

namespace svort {

/// Options of the similarities; an image is of any dimension (a slice, a volume).
struct SimilarityOptions {
  /// Range of the values; by default the reference's maximum less its minimum.
  std::optional<double> data_range;
  /// Voxels that count, bool, the images' size; undefined: all.
  torch::Tensor mask;
};

/// Mean squared difference. @throws std::invalid_argument if sizes differ, or nothing is left to compare
double mean_squared_error(const torch::Tensor& test, const torch::Tensor& reference,
                          const SimilarityOptions& options = {});

/// 10 log10(range^2 / MSE), dB; infinite for equal images. @throws as mean_squared_error()
double peak_signal_to_noise(const torch::Tensor& test, const torch::Tensor& reference,
                            const SimilarityOptions& options = {});

/// Window of the structural similarity.
enum class SsimWindow {
  uniform,   ///< 7 wide, sample covariance
  gaussian,  ///< deviation 1.5, 11 wide, population covariance (Wang et al. 2004)
};

/// Structural similarity with scikit-image's conventions: K1 = 0.01, K2 = 0.03, images continued by reflection.
struct Ssim {
  double mean = 0.;   ///< over the voxels whose window lies inside the image (and that are in the mask)
  torch::Tensor map;  ///< the images' size, float64
};
/// @throws std::invalid_argument if sizes differ, an axis is shorter than the window, or nothing is left to compare
Ssim structural_similarity(const torch::Tensor& test, const torch::Tensor& reference, SsimWindow window,
                           const SimilarityOptions& options = {});

}  // namespace svort
