#include "svort_ros/acquisition/slice_acquisition.h"

#include <torch/types.h>

#include <algorithm>
#include <limits>
#include <vector>

#include "acquisition_plan.h"
#include "autograd_operator.h"
#include "psf_split.h"
#include "tap_kernels.h"

namespace svort {
namespace {

// Weights below this in float64 sums are what rounding left of slices that were taken away.
constexpr double kRoundingOfSums = 1e-12;

// Whether a result is to be part of a graph.
bool records(const AcquisitionPlan& plan, const torch::Tensor& input) {
  return torch::GradMode::is_enabled() && (input.requires_grad() || plan.transforms.requires_grad());
}

// Weight of a pixel in the scatter: 1 / (PSF share inside), or 0 to leave it out.
float scale_of(const SlicePixels& of_slice, std::size_t pixel) {
  const float share = of_slice.share_of(pixel);
  return share >= kSmallestShare ? 1.F / share : 0.F;
}

// What forward() samples: the volume within its mask, blurred.
torch::Tensor gathered_volume(const AcquisitionPlan& plan, const torch::Tensor& volume) {
  torch::Tensor source = volume.detach().contiguous();
  // Not a product: a value outside the mask has no influence even if it is not a number.
  if (plan.volume_mask.defined()) source = source.masked_fill(~plan.volume_mask, 0.);
  if (!plan.blurs()) return source;
  torch::Tensor blurred = torch::empty_like(source);
  blur_volume(plan.blur, plan.shape, source.data_ptr<float>(), blurred.data_ptr<float>());
  return blurred;
}

// Turns what the scatter summed up into a volume. The mask only says where values may land.
void finish_volume(const AcquisitionPlan& plan, torch::Tensor* volume) {
  blur_volume(plan.blur, plan.shape, volume->data_ptr<float>(), volume->data_ptr<float>());
  if (plan.volume_mask.defined()) volume->masked_fill_(~plan.volume_mask, 0.);
}

// Adds factor x (PSF weight x pixel, PSF weight) to pairs.
template <class Real, class Kernel>
void scatter_sums(const AcquisitionPlan& plan, const float* slices, double factor, Kernel kernel, Real* sums) {
  plan.for_each_batch_exclusively(
      [&](std::size_t slice, const TapList& list, std::size_t first, const PixelBatch& batch) {
        alignas(32) float value[kLanes] = {}, scales[kLanes] = {};
        bool adds = false;
        for (std::size_t lane = 0; lane < batch.count; ++lane) {
          const float share = scale_of(plan.pixels[slice], first + lane);
          if (share == 0.F) continue;
          scales[lane] = static_cast<float>(factor * static_cast<double>(share));
          value[lane] = slices[plan.offset(static_cast<std::int64_t>(slice), first + lane)];
          adds = true;
        }
        if (adds) kernel(list, batch, value, scales, sums);
      });
}

template <class Real>
torch::Tensor divide_sums(const AcquisitionPlan& plan, const Real* sums, double smallest) {
  torch::Tensor volume = plan.new_volume(), weights = plan.new_volume();
  float* value = volume.data_ptr<float>();
  float* weight = weights.data_ptr<float>();
  parallel_chunks(plan.shape.voxel_count(), [&](std::int64_t begin, std::int64_t end) {
    for (std::int64_t i = begin; i < end; ++i) {
      if (!(static_cast<double>(sums[2 * i + 1]) > smallest)) continue;
      value[i] = static_cast<float>(sums[2 * i]);
      weight[i] = static_cast<float>(sums[2 * i + 1]);
    }
  });
  blur_volume(plan.blur, plan.shape, value, value);
  blur_volume(plan.blur, plan.shape, weight, weight);
  const bool* in_mask = plan.volume_mask.defined() ? plan.volume_mask.data_ptr<bool>() : nullptr;
  parallel_chunks(plan.shape.voxel_count(), [&](std::int64_t begin, std::int64_t end) {
    for (std::int64_t i = begin; i < end; ++i) {
      const bool counts = weight[i] > plan.least_weight && (in_mask == nullptr || in_mask[i]);
      value[i] = counts ? value[i] / weight[i] : 0.F;
    }
  });
  return volume;
}

void check_sums(const AcquisitionPlan& plan, const torch::Tensor& sums) {
  check_acquisition_tensor(sums, "sums", torch::kFloat64, plan.device,
                           {plan.shape.depth, plan.shape.height, plan.shape.width, 2});
}

}  // namespace

SliceAcquisition::SliceAcquisition(const AcquisitionGeometry& geometry, int height, int width,
                                   const std::array<std::int64_t, 3>& volume_shape, AcquisitionFormulation formulation,
                                   const AcquisitionMasks& masks)
    : plan_(std::make_shared<AcquisitionPlan>(geometry, height, width, volume_shape, formulation, masks)) {}

torch::Tensor SliceAcquisition::forward(const torch::Tensor& volume, torch::Tensor* weight) const {
  const AcquisitionPlan& plan = *plan_;
  plan.check_volume(volume);
  if (!plan.vectorised() || records(plan, volume)) {
    if (weight != nullptr) *weight = plan.general().weight.clone();
    return general_forward(plan_, volume);
  }
  const torch::NoGradGuard no_grad;
  const torch::Tensor source = gathered_volume(plan, volume);
  torch::Tensor slices = plan.new_slices();
  plan.gather(source.data_ptr<float>(), slices.data_ptr<float>(),
              [](const SlicePixels& of_slice, std::size_t pixel, float sum) {
                const float inside = of_slice.weight[pixel];
                return inside > 0.F ? sum / inside : 0.F;
              });
  if (weight != nullptr) *weight = plan.pixel_weights(/*masked=*/true);
  return slices;
}

torch::Tensor SliceAcquisition::adjoint(const torch::Tensor& slices, bool equalize) const {
  const AcquisitionPlan& plan = *plan_;
  plan.check_slices(slices);
  if (!plan.vectorised() || records(plan, slices)) return general_adjoint(plan_, slices, equalize);
  const torch::NoGradGuard no_grad;
  const torch::Tensor source = slices.detach().contiguous();
  if (equalize) {
    std::vector<float> sums(static_cast<std::size_t>(2 * plan.shape.voxel_count()), 0.F);
    scatter_sums(plan, source.data_ptr<float>(), 1., tap_kernels().scatter_pairs, sums.data());
    return divide_sums(plan, sums.data(), 0.);
  }
  torch::Tensor volume = plan.new_volume();
  plan.scatter(source.data_ptr<float>(), volume.data_ptr<float>(),
               [](const SlicePixels& of_slice, std::size_t pixel, float value) {
                 const float scale = scale_of(of_slice, pixel);
                 return scale == 0.F ? 0.F : value * scale;  // a pixel that is left out may hold anything
               });
  finish_volume(plan, &volume);
  return volume;
}

torch::Tensor SliceAcquisition::normal(const torch::Tensor& volume, const torch::Tensor& weights) const {
  const AcquisitionPlan& plan = *plan_;
  plan.check_volume(volume);
  if (weights.defined()) check_acquisition_tensor(weights, "weights", plan.type, plan.device, {plan.slice_count()});
  if (!plan.vectorised() || records(plan, volume) || (weights.defined() && records(plan, weights))) {
    const torch::Tensor slices = general_forward(plan_, volume);
    return general_adjoint(plan_, weights.defined() ? slices * weights.view({-1, 1, 1, 1}) : slices,
                           /*equalize=*/false);
  }
  const torch::NoGradGuard no_grad;
  const torch::Tensor source = gathered_volume(plan, volume);
  const torch::Tensor slice_weights = weights.defined() ? weights.detach().contiguous() : torch::Tensor();
  const float* w = weights.defined() ? slice_weights.data_ptr<float>() : nullptr;
  torch::Tensor result = plan.new_volume();
  const float* from = source.data_ptr<float>();
  float* to = result.data_ptr<float>();
  const TapKernels& kernels = tap_kernels();
  plan.for_each_batch_exclusively(
      [&](std::size_t slice, const TapList& list, std::size_t first, const PixelBatch& batch) {
        const float of_slice = w != nullptr ? w[slice] : 1.F;
        if (of_slice == 0.F) return;
        alignas(32) float value[kLanes];
        kernels.gather(list, batch, from, value);
        for (std::size_t lane = 0; lane < batch.count; ++lane) {
          const float inside = plan.pixels[slice].weight[first + lane];
          const float scale = inside > 0.F ? scale_of(plan.pixels[slice], first + lane) : 0.F;
          value[lane] = scale == 0.F ? 0.F : (value[lane] / inside * of_slice) * scale;
        }
        kernels.scatter(list, batch, value, to);
      });
  finish_volume(plan, &result);
  return result;
}

torch::Tensor SliceAcquisition::empty_sums() const {
  const AcquisitionPlan& plan = *plan_;
  return torch::zeros({plan.shape.depth, plan.shape.height, plan.shape.width, 2},
                      plan.options().dtype(torch::kFloat64));
}

void SliceAcquisition::add_to_sums(const torch::Tensor& slices, double factor, torch::Tensor* sums) const {
  const torch::NoGradGuard no_grad;
  const AcquisitionPlan& plan = *plan_;
  plan.check_slices(slices);
  check_sums(plan, *sums);
  if (!sums->is_contiguous()) reject_acquisition("sums must be contiguous");
  const torch::Tensor source = slices.detach().contiguous();
  if (plan.vectorised()) {
    scatter_sums(plan, source.data_ptr<float>(), factor, tap_kernels().scatter_double_pairs, sums->data_ptr<double>());
    return;
  }
  const torch::Tensor scale = scatter_scale(plan_), values = source.masked_fill(scale == 0, 0.) * scale;
  const SliceOperator& linear = *plan.general().linear;
  // Values have no limit that all calls share; what is left of them when weights are 0 does not count.
  const torch::Tensor largest_value = values.numel() > 0 ? values.abs().max() : torch::zeros({}, plan.options());
  const torch::Tensor largest_scale = torch::full({}, 1. / static_cast<double>(kSmallestShare), plan.options());
  sums->select(3, 0).add_(linear.scatter_terms(values, largest_value), factor);
  sums->select(3, 1).add_(linear.scatter_terms(scale.contiguous(), largest_scale), factor);
}

torch::Tensor SliceAcquisition::equalized_volume(const torch::Tensor& sums) const {
  const torch::NoGradGuard no_grad;
  const AcquisitionPlan& plan = *plan_;
  check_sums(plan, sums);
  const torch::Tensor source = sums.detach().contiguous();
  if (plan.vectorised()) return divide_sums(plan, source.data_ptr<double>(), kRoundingOfSums);
  const torch::Tensor counts = source.select(3, 1) > kRoundingOfSums;
  const SliceOperator& linear = *plan.general().linear;
  const auto blurred = [&](std::int64_t part) {
    return linear.blur(source.select(3, part).masked_fill(~counts, 0.).to(plan.type).contiguous());
  };
  return divide_by_weights(plan, blurred(0), blurred(1));
}

std::int64_t SliceAcquisition::slice_count() const { return plan_->slice_count(); }
std::int64_t SliceAcquisition::height() const { return plan_->height; }
std::int64_t SliceAcquisition::width() const { return plan_->width; }
std::array<std::int64_t, 3> SliceAcquisition::volume_shape() const { return plan_->volume_shape(); }
AcquisitionFormulation SliceAcquisition::formulation() const { return plan_->formulation; }
torch::TensorOptions SliceAcquisition::options() const { return plan_->options(); }
bool SliceAcquisition::requires_grad() const { return plan_->transforms.requires_grad(); }

torch::Tensor acquire_slices(const torch::Tensor& volume, const AcquisitionGeometry& geometry, int height, int width,
                             const AcquisitionMasks& masks, torch::Tensor* weight) {
  if (!volume.defined() || volume.dim() != 3) reject_acquisition("volume must be D x H x W");
  const SliceAcquisition acquisition(geometry, height, width, {volume.size(0), volume.size(1), volume.size(2)},
                                     AcquisitionFormulation::exact, masks);
  return acquisition.forward(volume, weight);
}

torch::Tensor scatter_slices(const torch::Tensor& slices, const AcquisitionGeometry& geometry,
                             const std::array<std::int64_t, 3>& volume_shape, bool equalize,
                             const AcquisitionMasks& masks) {
  if (!slices.defined() || slices.dim() != 4) reject_acquisition("slices must be n x 1 x h x w");
  constexpr std::int64_t kLargest = std::numeric_limits<int>::max();
  const SliceAcquisition acquisition(geometry, static_cast<int>(std::min(slices.size(2), kLargest)),
                                     static_cast<int>(std::min(slices.size(3), kLargest)), volume_shape,
                                     AcquisitionFormulation::exact, masks);
  if (acquisition.slice_count() != slices.size(0)) {
    reject_acquisition("slices and geometry.transforms must have the same count, got " +
                       std::to_string(slices.size(0)) + " and " + std::to_string(acquisition.slice_count()));
  }
  return acquisition.adjoint(slices, equalize);
}

}  // namespace svort
