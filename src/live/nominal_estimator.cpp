#include "svort_ros/live/nominal_estimator.h"

#include <algorithm>
#include <cmath>
#include <limits>
#include <sstream>
#include <stdexcept>

#include "svort_ros/acquisition/slice_acquisition.h"
#include "svort_ros/live/slice_batch.h"
#include "svort_ros/reconstruction/volume_estimation.h"

namespace svort {
namespace {

void require(bool condition, const char* option, double value, const char* range) {
  if (condition) return;
  std::ostringstream message;
  message << "estimator." << option << " is " << value << "; it must be " << range;
  throw std::invalid_argument(message.str());
}

ImageGrid cube(double size_mm, double resolution_mm) {
  ImageGrid grid;
  grid.size.setConstant(static_cast<int>(std::lround(size_mm / resolution_mm)));
  grid.spacing.setConstant(resolution_mm);
  return grid;
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

AcquisitionFormulation formulation_of(const EstimatorOptions& options) {
  try {
    return acquisition_formulation(options.formulation);
  } catch (const std::invalid_argument& error) {
    throw std::invalid_argument(std::string("estimator.formulation: ") + error.what());
  }
}

}  // namespace

NominalEstimator::NominalEstimator(const EstimatorOptions& options)
    : options_(options), formulation_(formulation_of(options)) {
  require(options.volume_resolution_mm >= 0.2 && options.volume_resolution_mm <= 10., "volume_resolution_mm",
          options.volume_resolution_mm, "from 0.2 to 10 mm");
  require(options.volume_size_mm >= 4. * options.volume_resolution_mm && options.volume_size_mm <= 400.,
          "volume_size_mm", options.volume_size_mm, "at least 4 voxels and at most 400 mm");
  require(options.recentre_mm >= 0. && std::isfinite(options.recentre_mm), "recentre_mm", options.recentre_mm,
          "zero or positive");
  require(options.cg_iterations >= 0, "cg_iterations", options.cg_iterations, "zero or positive");
  require(options.final_cg_iterations >= 0, "final_cg_iterations", options.final_cg_iterations, "zero or positive");
  grid_ = cube(options.volume_size_mm, options.volume_resolution_mm);
}

void NominalEstimator::add(const SliceSequence& sequence) {
  const auto newest = sequence.newest_arrival();
  if (!newest) throw std::logic_error("NominalEstimator::add: the sequence holds no slice");

  SliceEstimate slice;
  slice.info = newest->info;
  slice.ncc = std::numeric_limits<double>::quiet_NaN();
  const auto& ordered = sequence.slices();
  const auto position = std::find(ordered.begin(), ordered.end(), newest) - ordered.begin();
  estimate_.slices.insert(estimate_.slices.begin() + position, slice);

  const Eigen::Vector3d centre =
      sequence.brain_roi().empty() ? newest->info.T_scanner_slice.translation() : sequence.brain_roi().centre();
  const bool first = estimate_.slices.size() == 1;
  if (first || (centre - T_scanner_brain_.translation()).norm() > options_.recentre_mm) {
    T_scanner_brain_.setIdentity();
    T_scanner_brain_.translation() = centre;
    if (!first) ++estimate_.frame_revision;
    for (SliceEstimate& each : estimate_.slices) {
      each.T_scanner_brain = T_scanner_brain_;
      each.T_brain_slice = T_scanner_brain_.inverse() * each.info.T_scanner_slice;
    }
  } else {
    SliceEstimate& added = estimate_.slices[static_cast<std::size_t>(position)];
    added.T_scanner_brain = T_scanner_brain_;
    added.T_brain_slice = T_scanner_brain_.inverse() * added.info.T_scanner_slice;
  }
  estimate_.scan_id = sequence.scan_id();
  estimate_.final = false;
  ++estimate_.revision;
}

void NominalEstimator::update_volume(const SliceSequence& sequence) {
  estimate_volume(sequence, options_.cg_iterations);
  ++estimate_.revision;
}

void NominalEstimator::finalise(const SliceSequence& sequence) {
  estimate_volume(sequence, options_.final_cg_iterations);
  estimate_.final = true;
  ++estimate_.revision;
}

void NominalEstimator::reset() {
  const std::uint64_t revision = estimate_.revision;
  estimate_ = Estimate();
  estimate_.revision = revision;
  volume_ = Volume();
}

void NominalEstimator::estimate_volume(const SliceSequence& sequence, int cg_iterations) {
  const torch::NoGradGuard no_grad;
  const SliceBatch batch = make_slice_batch(sequence, estimate_.slices, grid_);
  const auto height = static_cast<int>(batch.pixels.size(2));
  const auto width = static_cast<int>(batch.pixels.size(3));
  const SliceAcquisition acquisition(batch.geometry, height, width, {grid_.size.z(), grid_.size.y(), grid_.size.x()},
                                     formulation_, batch.masks);
  torch::Tensor volume = reconstruct_psf(batch.pixels, acquisition);
  if (cg_iterations > 0) {
    ConjugateGradientOptions options;
    options.iterations = cg_iterations;
    volume = solve_weighted_inverse(batch.pixels, acquisition, batch.weights, volume, options);
  }

  torch::Tensor coverage;
  const torch::Tensor simulated = acquisition.forward(volume, &coverage);
  const auto plane = static_cast<std::size_t>(height) * static_cast<std::size_t>(width);
  for (std::size_t i = 0; i < estimate_.slices.size(); ++i)
    estimate_.slices[i].ncc = masked_correlation(
        batch.pixels.data_ptr<float>() + i * plane, simulated.data_ptr<float>() + i * plane,
        batch.masks.slices.data_ptr<bool>() + i * plane, coverage.data_ptr<float>() + i * plane, plane);

  volume_.grid = grid_;
  volume_.values.assign(volume.data_ptr<float>(), volume.data_ptr<float>() + volume.numel());
}

}  // namespace svort
