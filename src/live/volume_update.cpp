#include "svort_ros/live/volume_update.h"

#include <torch/types.h>

#include <cmath>
#include <limits>
#include <sstream>
#include <stdexcept>
#include <string>

#include "svort_ros/live/sequence_tensors.h"
#include "svort_ros/live/slice_batch.h"
#include "svort_ros/reconstruction/volume_estimation.h"
#include "svort_ros/registration/scan_registration.h"

namespace svort {
namespace {

void require(bool condition, const char* option, double value, const char* range) {
  if (condition) return;
  std::ostringstream message;
  message << "estimator." << option << " is " << value << "; it must be " << range;
  throw std::invalid_argument(message.str());
}

/// Pearson correlation over the pixels of one slice's mask that the volume covers.
double masked_correlation(const float* a, const float* b, const bool* mask, const float* coverage, std::size_t count) {
  double n = 0., sum_a = 0., sum_b = 0., sum_aa = 0., sum_bb = 0., sum_ab = 0.;
  for (std::size_t i = 0; i < count; ++i) {
    if (!mask[i] || coverage[i] <= 0.F) continue;
    const double x = a[i];
    const double y = b[i];
    n += 1.;
    sum_a += x;
    sum_b += y;
    sum_aa += x * x;
    sum_bb += y * y;
    sum_ab += x * y;
  }
  const double variance = (n * sum_aa - sum_a * sum_a) * (n * sum_bb - sum_b * sum_b);
  if (n < 2. || variance <= 0.) return std::numeric_limits<double>::quiet_NaN();
  return (n * sum_ab - sum_a * sum_b) / std::sqrt(variance);
}

SliceAcquisition acquisition_of(const SliceBatch& batch, const ImageGrid& grid, AcquisitionFormulation formulation) {
  return SliceAcquisition(batch.geometry, static_cast<int>(batch.pixels.size(2)),
                          static_cast<int>(batch.pixels.size(3)), {grid.size.z(), grid.size.y(), grid.size.x()},
                          formulation, batch.masks);
}

/// Each slice's correlation with itself simulated from the volume.
void set_correlations(const SliceBatch& batch, const SliceAcquisition& acquisition, const torch::Tensor& volume,
                      std::vector<SliceEstimate>* slices) {
  torch::Tensor coverage;
  const torch::Tensor simulated = acquisition.forward(volume, &coverage);
  const auto plane = static_cast<std::size_t>(batch.pixels.size(2) * batch.pixels.size(3));
  for (std::size_t i = 0; i < slices->size(); ++i)
    (*slices)[i].ncc = masked_correlation(
        batch.pixels.data_ptr<float>() + i * plane, simulated.data_ptr<float>() + i * plane,
        batch.masks.slices.data_ptr<bool>() + i * plane, coverage.data_ptr<float>() + i * plane, plane);
}

Volume volume_of(const torch::Tensor& values, const ImageGrid& grid) {
  Volume result;
  result.grid = grid;
  result.values.assign(values.data_ptr<float>(), values.data_ptr<float>() + values.numel());
  return result;
}

}  // namespace

void validate(const EstimatorOptions& options) {
  require(options.volume_resolution_mm >= 0.2 && options.volume_resolution_mm <= 10., "volume_resolution_mm",
          options.volume_resolution_mm, "from 0.2 to 10 mm");
  require(options.volume_size_mm >= 4. * options.volume_resolution_mm && options.volume_size_mm <= 400.,
          "volume_size_mm", options.volume_size_mm, "at least 4 voxels and at most 400 mm");
  require(options.recentre_mm >= 0. && std::isfinite(options.recentre_mm), "recentre_mm", options.recentre_mm,
          "zero or positive");
  require(options.cg_iterations >= 0, "cg_iterations", options.cg_iterations, "zero or positive");
  validate(options.final_volume);
  require(options.volume_size_mm >= 4. * options.final_volume.resolution_mm, "volume_size_mm", options.volume_size_mm,
          "at least 4 voxels of the final volume");
  try {
    acquisition_formulation(options.formulation);
  } catch (const std::invalid_argument& error) {
    throw std::invalid_argument(std::string("estimator.formulation: ") + error.what());
  }
}

ImageGrid volume_grid(const EstimatorOptions& options) {
  ImageGrid grid;
  grid.size.setConstant(static_cast<int>(std::lround(options.volume_size_mm / options.volume_resolution_mm)));
  grid.spacing.setConstant(options.volume_resolution_mm);
  return grid;
}

double agreement_of(const SliceSequence& sequence, const std::vector<SliceEstimate>& slices) {
  const torch::NoGradGuard no_grad;
  std::vector<Pose> poses;
  for (std::size_t i = 0; i < slices.size(); ++i)
    poses.push_back(slices[i].T_brain_slice * sequence.slices()[i]->T_slice_crop);
  return coarse_agreement(registration_input(sequence), poses);
}

Volume estimate_volume(const SliceSequence& sequence, const ImageGrid& grid, AcquisitionFormulation formulation,
                       int cg_iterations, std::vector<SliceEstimate>* slices) {
  const torch::NoGradGuard no_grad;
  const SliceBatch batch = make_slice_batch(sequence, *slices, grid);
  const SliceAcquisition acquisition = acquisition_of(batch, grid, formulation);
  torch::Tensor volume = reconstruct_psf(batch.pixels, acquisition, batch.weights);
  if (cg_iterations > 0) {
    ConjugateGradientOptions options;
    options.iterations = cg_iterations;
    volume = solve_weighted_inverse(batch.pixels, acquisition, batch.weights, volume, options);
  }

  set_correlations(batch, acquisition, volume, slices);
  return volume_of(volume, grid);
}

Volume estimate_final_volume(const SliceSequence& sequence, const EstimatorOptions& options,
                             std::vector<SliceEstimate>* slices) {
  const torch::NoGradGuard no_grad;
  EstimatorOptions final = options;
  final.volume_resolution_mm = options.final_volume.resolution_mm;
  const ImageGrid grid = volume_grid(final);
  const SliceBatch batch = make_slice_batch(sequence, *slices, grid);
  const SliceAcquisition acquisition = acquisition_of(batch, grid, acquisition_formulation(options.formulation));
  const torch::Tensor volume = reconstruct_final_volume(batch.pixels, acquisition, batch.masks.slices, batch.weights,
                                                        sequence.options().resolution_mm, options.final_volume)
                                   .volume;
  set_correlations(batch, acquisition, volume, slices);
  return volume_of(volume, grid);
}

}  // namespace svort
