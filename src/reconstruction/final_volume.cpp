#include "svort_ros/reconstruction/final_volume.h"

#include <torch/types.h>

#include <Eigen/Cholesky>
#include <Eigen/Core>
#include <algorithm>
#include <cmath>
#include <sstream>
#include <stdexcept>
#include <string>

#include "../acquisition/parallel.h"
#include "conjugate_gradient.h"
#include "edge_prior.h"
#include "svort_ros/reconstruction/volume_estimation.h"

namespace svort {
namespace {

constexpr double kFieldUnit_mm = 60.;
constexpr float kLeastShare = 1e-3F;  // of the largest weight of a voxel: below, nothing is known of it

using Vector6d = Eigen::Matrix<double, 6, 1>;
using Matrix6d = Eigen::Matrix<double, 6, 6>;

Vector6d monomials(double u, double v) {
  Vector6d terms;
  terms << 1., u, v, u * u, u * v, v * v;
  return terms;
}

/// The slices and what is known of them, for one scan.
class IntensityMatcher {
 public:
  IntensityMatcher(const torch::Tensor& slices, const torch::Tensor& masks, const torch::Tensor& weights,
                   double pixel_mm, const FinalVolumeOptions& options)
      : slices_(slices.contiguous()), masks_(masks.contiguous()), weights_(weights.contiguous()), options_(options) {
    count_ = static_cast<std::size_t>(slices.size(0));
    height_ = slices.size(2);
    width_ = slices.size(3);
    unit_ = pixel_mm / kFieldUnit_mm;
    fields.assign(count_, SliceField{});
    noise.assign(count_, 0.);
    corrected = slices_ * masks_;
    precision = (weights_.view({-1, 1, 1, 1}) * masks_).contiguous();
  }

  /// Fits the fields to the slices simulated from the volume, then noise and weights of the pixels.
  /// @param coverage PSF weight of each pixel inside the volume
  void match(const torch::Tensor& simulated, const torch::Tensor& coverage, double bright) {
    parallel_tasks(static_cast<std::int64_t>(count_), [&](std::int64_t task) {
      const auto slice = static_cast<std::size_t>(task);
      if (options_.scale_spread > 0.) fit(slice, simulated, coverage, bright);
    });
    // What all slices share belongs to the volume.
    double sum = 0., total = 0.;
    for (std::size_t i = 0; i < count_; ++i) {
      const double weight = static_cast<double>(weights_.data_ptr<float>()[i]);
      sum += weight * fields[i][0];
      total += weight;
    }
    if (total > 0.)
      for (SliceField& field : fields) field[0] -= sum / total;
    parallel_tasks(static_cast<std::int64_t>(count_),
                   [&](std::int64_t task) { apply(static_cast<std::size_t>(task), simulated, coverage, bright); });
  }

  std::vector<SliceField> fields;
  std::vector<double> noise;
  torch::Tensor corrected;  ///< slices divided by their fields
  torch::Tensor precision;  ///< weight of each pixel of `corrected`

 private:
  template <class Body>
  void for_pixels(std::size_t slice, const torch::Tensor& coverage, const Body& body) const {
    const auto first = static_cast<std::int64_t>(slice) * height_ * width_;
    const bool* mask = masks_.data_ptr<bool>() + first;
    const float* covered = coverage.data_ptr<float>() + first;
    for (std::int64_t y = 0; y < height_; ++y)
      for (std::int64_t x = 0; x < width_; ++x) {
        const std::int64_t i = y * width_ + x;
        if (!mask[i] || covered[i] < 0.5F) continue;
        body(first + i, unit_ * (static_cast<double>(x) - 0.5 * static_cast<double>(width_ - 1)),
             unit_ * (static_cast<double>(y) - 0.5 * static_cast<double>(height_ - 1)));
      }
  }

  static double value(const SliceField& field, const Vector6d& terms) {
    return Eigen::Map<const Vector6d>(field.data()).dot(terms);
  }

  /// Robust deviation of the slice from what the volume makes of it.
  double deviation(std::size_t slice, const torch::Tensor& simulated, const torch::Tensor& coverage,
                   double bright) const {
    std::vector<float> residuals;
    const float *pixel = slices_.data_ptr<float>(), *expected = simulated.data_ptr<float>();
    for_pixels(slice, coverage, [&](std::int64_t i, double u, double v) {
      const auto gain = static_cast<float>(std::exp(value(fields[slice], monomials(u, v))));
      residuals.push_back(std::abs(pixel[i] - gain * expected[i]));
    });
    if (residuals.empty()) return bright;
    const auto middle = static_cast<std::ptrdiff_t>(residuals.size() / 2);
    std::nth_element(residuals.begin(), residuals.begin() + middle, residuals.end());
    return std::max(1.4826 * static_cast<double>(residuals[static_cast<std::size_t>(middle)]), 1e-3 * bright);
  }

  void fit(std::size_t slice, const torch::Tensor& simulated, const torch::Tensor& coverage, double bright) {
    const float *pixel = slices_.data_ptr<float>(), *expected = simulated.data_ptr<float>();
    SliceField& field = fields[slice];
    Eigen::Map<Vector6d> coefficients(field.data());
    Vector6d prior;
    prior.setConstant(options_.bias_spread > 0. ? 1. / (options_.bias_spread * options_.bias_spread) : 1e12);
    prior(0) = 1. / (options_.scale_spread * options_.scale_spread);
    constexpr int kSteps = 3;
    for (int step = 0; step < kSteps; ++step) {
      const double sigma = deviation(slice, simulated, coverage, bright);
      // Neighbouring pixels err together (motion, blur), so that far fewer are independent: about one in 25.
      const double information = 1. / (25. * sigma * sigma);
      const double limit = options_.outlier_factor * sigma;
      Matrix6d hessian = prior.asDiagonal();
      Vector6d gradient = prior.cwiseProduct(coefficients);
      for_pixels(slice, coverage, [&](std::int64_t i, double u, double v) {
        const Vector6d terms = monomials(u, v);
        const double predicted = std::exp(value(field, terms)) * static_cast<double>(expected[i]);
        const double difference = predicted - static_cast<double>(pixel[i]);
        const double weight = information / (1. + difference * difference / (limit * limit));
        hessian.selfadjointView<Eigen::Lower>().rankUpdate(terms, weight * predicted * predicted);
        gradient += weight * predicted * difference * terms;
      });
      const Matrix6d symmetric = hessian.selfadjointView<Eigen::Lower>();
      Vector6d change = symmetric.ldlt().solve(-gradient);
      const double largest = change.cwiseAbs().maxCoeff();
      if (!(largest < 1e3)) break;
      if (largest > 0.5) change *= 0.5 / largest;
      coefficients += change;
    }
  }

  void apply(std::size_t slice, const torch::Tensor& simulated, const torch::Tensor& coverage, double bright) {
    noise[slice] = deviation(slice, simulated, coverage, bright);
    const double limit = options_.outlier_factor * noise[slice];
    const float weight = weights_.data_ptr<float>()[slice];
    const float *pixel = slices_.data_ptr<float>(), *expected = simulated.data_ptr<float>();
    float *value_out = corrected.data_ptr<float>(), *precision_out = precision.data_ptr<float>();
    for_pixels(slice, coverage, [&](std::int64_t i, double u, double v) {
      const double gain = std::exp(value(fields[slice], monomials(u, v)));
      const double ratio = (static_cast<double>(pixel[i]) - gain * static_cast<double>(expected[i])) / limit;
      value_out[i] = static_cast<float>(static_cast<double>(pixel[i]) / gain);
      // Noise is divided by the gain as well.
      precision_out[i] = weight * static_cast<float>(gain * gain / (1. + ratio * ratio));
    });
  }

  torch::Tensor slices_, masks_, weights_;
  FinalVolumeOptions options_;
  std::size_t count_ = 0;
  std::int64_t height_ = 0, width_ = 0;
  double unit_ = 1.;
};

double bright_level(const torch::Tensor& slices, const torch::Tensor& masks) {
  const torch::Tensor brain = slices.masked_select(masks);
  if (brain.numel() == 0) return 1.;
  const torch::Tensor sorted = std::get<0>(brain.sort());
  return std::max(1e-6, sorted[(sorted.numel() - 1) * 99 / 100].item<double>());
}

}  // namespace

void validate(const FinalVolumeOptions& options) {
  const auto require = [](bool condition, const char* name, double value, const char* range) {
    if (condition) return;
    std::ostringstream message;
    message << "final_volume." << name << " is " << value << "; it must be " << range;
    throw std::invalid_argument(message.str());
  };
  require(options.resolution_mm >= 0.2 && options.resolution_mm <= 10., "resolution_mm", options.resolution_mm,
          "from 0.2 to 10 mm");
  require(options.passes >= 0 && options.passes <= 100, "passes", options.passes, "from 0 to 100");
  require(options.iterations >= 1 && options.iterations <= 1000, "iterations", options.iterations, "from 1 to 1000");
  require(options.edge_strength >= 0. && std::isfinite(options.edge_strength), "edge_strength", options.edge_strength,
          "zero or positive");
  require(options.edge > 0. && std::isfinite(options.edge), "edge", options.edge, "positive");
  require(options.scale_spread >= 0. && options.scale_spread <= 10., "scale_spread", options.scale_spread,
          "from 0 to 10");
  require(options.bias_spread >= 0. && options.bias_spread <= 10., "bias_spread", options.bias_spread, "from 0 to 10");
  require(options.outlier_factor > 0. && std::isfinite(options.outlier_factor), "outlier_factor",
          options.outlier_factor, "positive");
}

FinalVolume reconstruct_final_volume(const torch::Tensor& slices, const SliceAcquisition& acquisition,
                                     const torch::Tensor& masks, const torch::Tensor& weights, double pixel_mm,
                                     const FinalVolumeOptions& options) {
  validate(options);
  if (!masks.defined() || masks.sizes() != slices.sizes() || masks.scalar_type() != torch::kBool)
    throw std::invalid_argument("reconstruct_final_volume: masks must be bool, of the slices' shape");
  if (!weights.defined()) throw std::invalid_argument("reconstruct_final_volume: weights must be given");
  if (!(pixel_mm > 0.)) throw std::invalid_argument("reconstruct_final_volume: pixel_mm must be positive");
  const torch::NoGradGuard no_grad;
  FinalVolume result;
  result.volume = reconstruct_psf(slices * masks, acquisition, weights);  // checks slices and weights
  IntensityMatcher matcher(slices, masks, weights, pixel_mm, options);
  const double bright = bright_level(slices, masks);
  for (int pass = 0; pass < options.passes; ++pass) {
    torch::Tensor coverage;
    const torch::Tensor simulated = acquisition.forward(result.volume, &coverage);
    matcher.match(simulated, coverage, bright);

    // (A^T P A + lambda L) x = A^T P y, L the graph Laplacian with edges weighted down.
    const torch::Tensor total = acquisition.adjoint(matcher.precision, /*equalize=*/false);
    const float least = std::max(1e-12F, kLeastShare * total.max().item<float>());
    const torch::Tensor known = total > least;
    const double mean = total.masked_select(known).mean().item<double>();
    const EdgeWeights prior(result.volume, known, options.edge * bright);
    const auto strength = static_cast<float>(options.edge_strength * (std::isfinite(mean) ? mean : 0.));
    const LinearOperator apply = [&](const torch::Tensor& x) {
      torch::Tensor y = acquisition.adjoint(acquisition.forward(x) * matcher.precision, /*equalize=*/false);
      prior.add_laplacian(x, strength, &y);
      return y;
    };
    const torch::Tensor b = acquisition.adjoint(matcher.corrected * matcher.precision, /*equalize=*/false);
    ConjugateGradientOptions steps;
    steps.iterations = options.iterations;
    result.volume = (conjugate_gradient(apply, b, result.volume * known, steps, nullptr) * known).clamp_min_(0);
  }
  result.fields = matcher.fields;
  result.noise = matcher.noise;
  return result;
}

}  // namespace svort
