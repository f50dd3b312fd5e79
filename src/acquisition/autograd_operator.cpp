#include "autograd_operator.h"

#include <torch/autograd.h>
#include <torch/types.h>

namespace svort {
namespace {

using torch::autograd::AutogradContext;
using torch::autograd::Function;
using torch::autograd::tensor_list;

using PlanPointer = std::shared_ptr<const AcquisitionPlan>;

// Keeps the plan alive for the backward pass.
struct PlanHolder : torch::CustomClassHolder {
  explicit PlanHolder(PlanPointer p) : plan(std::move(p)) {}
  PlanPointer plan;
};

void keep_plan(AutogradContext* context, const PlanPointer& plan) {
  context->saved_data["plan"] = c10::IValue::make_capsule(c10::make_intrusive<PlanHolder>(plan));
}

const SliceOperator& kept_operator(AutogradContext* context) {
  const auto holder = context->saved_data["plan"].toCapsule();
  return *static_cast<const PlanHolder&>(*holder).plan->general().linear;
}

// G B x, of a volume and the poses.
struct Gather : Function<Gather> {
  static torch::Tensor forward(AutogradContext* context, const PlanPointer& plan, const torch::Tensor& volume,
                               const torch::Tensor& transforms) {
    const SliceOperator& linear = *plan->general().linear;
    const torch::Tensor blurred = linear.blur(volume.contiguous());
    keep_plan(context, plan);
    context->saved_data["volume"] = volume.requires_grad();
    context->saved_data["transforms"] = transforms.requires_grad();
    if (transforms.requires_grad()) context->save_for_backward({blurred});
    return linear.gather(blurred);
  }
  static tensor_list backward(AutogradContext* context, const tensor_list& gradients) {
    const SliceOperator& linear = kept_operator(context);
    const torch::Tensor slices = gradients[0].contiguous();
    torch::Tensor volume, transforms;
    if (context->saved_data["volume"].toBool()) volume = linear.blur(linear.scatter(slices));
    if (context->saved_data["transforms"].toBool()) {
      transforms = linear.pose_gradient(context->get_saved_variables()[0], slices);
    }
    return {torch::Tensor(), volume, transforms};
  }
};

// B G^T y, of slices and the poses.
struct Scatter : Function<Scatter> {
  static torch::Tensor forward(AutogradContext* context, const PlanPointer& plan, const torch::Tensor& slices,
                               const torch::Tensor& transforms) {
    const SliceOperator& linear = *plan->general().linear;
    const torch::Tensor values = slices.contiguous();
    keep_plan(context, plan);
    context->saved_data["slices"] = slices.requires_grad();
    context->saved_data["transforms"] = transforms.requires_grad();
    if (transforms.requires_grad()) context->save_for_backward({values});
    return linear.blur(linear.scatter(values));
  }
  static tensor_list backward(AutogradContext* context, const tensor_list& gradients) {
    const SliceOperator& linear = kept_operator(context);
    const torch::Tensor blurred = linear.blur(gradients[0].contiguous());
    torch::Tensor slices, transforms;
    if (context->saved_data["slices"].toBool()) slices = linear.gather(blurred);
    if (context->saved_data["transforms"].toBool()) {
      transforms = linear.pose_gradient(blurred, context->get_saved_variables()[0]);
    }
    return {torch::Tensor(), slices, transforms};
  }
};

// The pixels' weights as a function of the poses: the value is known, the gradient is that of Gather.
struct Weight : Function<Weight> {
  static torch::Tensor forward(AutogradContext* context, const PlanPointer& plan, bool masked, const torch::Tensor&) {
    keep_plan(context, plan);
    context->saved_data["masked"] = masked;
    return (masked ? plan->general().weight : plan->general().share).clone();
  }
  static tensor_list backward(AutogradContext* context, const tensor_list& gradients) {
    const auto holder = context->saved_data["plan"].toCapsule();
    const AcquisitionPlan& plan = *static_cast<const PlanHolder&>(*holder).plan;
    const SliceOperator& linear = *plan.general().linear;
    torch::Tensor ones = torch::ones_like(plan.new_volume());
    if (context->saved_data["masked"].toBool()) ones.masked_fill_(~plan.volume_mask, 0.);
    return {torch::Tensor(), torch::Tensor(), linear.pose_gradient(linear.blur(ones), gradients[0].contiguous())};
  }
};

torch::Tensor weight_of(const PlanPointer& plan, bool masked) {
  const AcquisitionPlan::General& general = plan->general();
  masked = masked && plan->volume_mask.defined();
  // Without blur and mask it is constant between its jumps.
  if (plan->transforms.requires_grad() && (masked || plan->blurs())) {
    return Weight::apply(plan, masked, plan->transforms);
  }
  return masked ? general.weight : general.share;
}

}  // namespace

torch::Tensor general_forward(const PlanPointer& plan, const torch::Tensor& volume) {
  // Not a product: a value outside the mask has no influence even if it is not a number.
  const torch::Tensor source = plan->volume_mask.defined() ? volume.masked_fill(~plan->volume_mask, 0.) : volume;
  const torch::Tensor weight = weight_of(plan, /*masked=*/true), empty = ~(weight > 0);
  return (Gather::apply(plan, source, plan->transforms) / weight.masked_fill(empty, 1.)).masked_fill(empty, 0.);
}

torch::Tensor scatter_scale(const PlanPointer& plan) {
  const torch::Tensor share = weight_of(plan, /*masked=*/false), left_out = ~(share >= kSmallestShare);
  return share.masked_fill(left_out, 1.).reciprocal().masked_fill(left_out, 0.);
}

torch::Tensor divide_by_weights(const AcquisitionPlan& plan, const torch::Tensor& sums, const torch::Tensor& weights) {
  torch::Tensor empty = ~(weights > plan.least_weight);
  if (plan.volume_mask.defined()) empty = empty | ~plan.volume_mask;
  return (sums / weights.masked_fill(empty, 1.)).masked_fill(empty, 0.);
}

torch::Tensor general_adjoint(const PlanPointer& plan, const torch::Tensor& slices, bool equalize) {
  const torch::Tensor scale = scatter_scale(plan);
  // A pixel that is left out may hold anything.
  const torch::Tensor values = slices.masked_fill(scale == 0, 0.) * scale;
  const torch::Tensor sums = Scatter::apply(plan, values, plan->transforms);
  if (equalize) return divide_by_weights(*plan, sums, Scatter::apply(plan, scale, plan->transforms));
  return plan->volume_mask.defined() ? sums.masked_fill(~plan->volume_mask, 0.) : sums;
}

}  // namespace svort
