#include "svort_ros/simulation/anatomy.h"

#include <torch/nn/functional/vision.h>
#include <torch/types.h>

#include <algorithm>
#include <array>
#include <cmath>
#include <sstream>
#include <stdexcept>

#include "head_rim.h"
#include "purposes.h"
#include "smooth_fields.h"
#include "svort_ros/simulation/random_stream.h"

namespace svort {
namespace {

namespace F = torch::nn::functional;

constexpr double kSigmaOfFwhm = 1. / 2.3548200450309493;

void require(bool ok, const char* option, double value, const char* limit) {
  if (ok) return;
  std::ostringstream text;
  text << "anatomy." << option << " is " << value << ", must be " << limit;
  throw std::invalid_argument(text.str());
}

float quantile_within(const torch::Tensor& image, const torch::Tensor& mask, double quantile) {
  const torch::Tensor values = std::get<0>(image.masked_select(mask).sort());
  const auto rank = static_cast<std::int64_t>(quantile * static_cast<double>(values.numel() - 1));
  return values[rank].item<float>();
}

/// Takes out of a deformation the rigid motion that it has on average over the brain: it would be an unknown pose.
/// @param brain        d x h x w, 1 in the given brain, centred
/// @param position     of the output voxels from the brain's centre, mm, per axis (x, y, z)
/// @param scale        by which the brain grows before it is deformed
/// @param displacement 3 x z x y x x, in the given brain, mm
void take_out_rigid_part(const torch::Tensor& brain, double brain_mm, const std::array<torch::Tensor, 3>& position,
                         const Eigen::Vector3d& scale, double resolution_mm, torch::Tensor* displacement) {
  // The field is smooth: voxels a few mm apart tell as much as all of them.
  constexpr double kSpacingMm = 4.;
  const auto every = std::max<std::int64_t>(1, std::llround(kSpacingMm / resolution_mm));
  const auto thinned = [every](const torch::Tensor& tensor, int axis) {
    return tensor.slice(axis, 0, c10::nullopt, every);
  };
  // In the given brain, and in grid_sample's coordinates; x, y, z along the last axis.
  std::vector<torch::Tensor> along, sampled_at;
  for (int axis = 2; axis >= 0; --axis) {
    along.push_back((thinned(position[static_cast<std::size_t>(axis)], 0) / scale[axis]).to(torch::kFloat32));
    sampled_at.push_back(along.back() / (0.5 * static_cast<double>(brain.size(2 - axis) - 1) * brain_mm));
  }
  const auto points_of = [&](const std::vector<torch::Tensor>& axes) {
    std::vector<torch::Tensor> grids = torch::meshgrid(axes, "ij");
    std::reverse(grids.begin(), grids.end());
    return torch::stack(grids, -1).to(brain.device());
  };
  const torch::Tensor weight =
      F::grid_sample(brain.unsqueeze(0).unsqueeze(0), points_of(sampled_at).unsqueeze(0),
                     F::GridSampleFuncOptions().mode(torch::kBilinear).padding_mode(torch::kZeros).align_corners(true))
          .flatten()
          .to(torch::kFloat64);
  const torch::Tensor points = points_of(along).view({-1, 3}).to(torch::kFloat64);
  const torch::Tensor moved =
      thinned(thinned(thinned(*displacement, 1), 2), 3).flatten(1).t().to(torch::kFloat64).contiguous();
  const torch::Tensor total = weight.sum().clamp_min(1e-6);
  const torch::Tensor centre = torch::matmul(weight, points) / total, shift = torch::matmul(weight, moved) / total;
  const torch::Tensor weighted = ((points - centre) * weight.unsqueeze(1)).t();
  const torch::Tensor spread = torch::matmul(weighted, points - centre).cpu();
  const torch::Tensor turned = torch::matmul(weighted, moved - shift).cpu();
  const auto matrix = [](const torch::Tensor& tensor) {
    return Eigen::Matrix3d(
        Eigen::Map<const Eigen::Matrix<double, 3, 3, Eigen::RowMajor>>(tensor.contiguous().data_ptr<double>()));
  };
  const Eigen::Matrix3d second = matrix(spread), cross = matrix(turned);
  const Eigen::Matrix3d inertia = second.trace() * Eigen::Matrix3d::Identity() - second;
  const Eigen::Vector3d moment(cross(1, 2) - cross(2, 1), cross(2, 0) - cross(0, 2), cross(0, 1) - cross(1, 0));
  const Eigen::Vector3d rotation = inertia.ldlt().solve(moment);
  // d - shift - rotation x (p - centre), axis by axis
  const torch::Tensor centre_cpu = centre.cpu(), shift_cpu = shift.cpu();
  const auto from_centre = [&](int axis) {
    std::array<std::int64_t, 3> view{1, 1, 1};
    view[static_cast<std::size_t>(2 - axis)] = -1;
    return (position[static_cast<std::size_t>(axis)] / scale[axis] - centre_cpu[axis].item<double>())
        .to(torch::kFloat32)
        .view(view)
        .to(brain.device());
  };
  for (int axis = 0; axis < 3; ++axis) {
    const int next = (axis + 1) % 3, last = (axis + 2) % 3;
    displacement->select(0, axis)
        .sub_(shift_cpu[axis].item<double>())
        .sub_(from_centre(last), rotation[next])
        .add_(from_centre(next), rotation[last]);
  }
}

}  // namespace

AnatomyOptions no_anatomy_variation() {
  AnatomyOptions options;
  options.scale_min = options.scale_max = 1.;
  options.aspect = options.elastic_mm = options.contrast = options.rim_share = 0.;
  return options;
}

AnatomySource::AnatomySource(const std::vector<BrainVolume>& volumes, const NetworkGrid& grid,
                             const AnatomyOptions& options, torch::Device device)
    : grid_(grid), options_(options), device_(device) {
  const torch::NoGradGuard no_grad;
  require(options.scale_min > 0.1 && options.scale_min <= options.scale_max, "scale_min", options.scale_min,
          "above 0.1 and at most scale_max");
  require(options.scale_max < 10., "scale_max", options.scale_max, "below 10");
  require(options.aspect >= 0. && options.aspect <= 0.2, "aspect", options.aspect, "in 0 .. 0.2");
  require(options.elastic_mm >= 0. && options.elastic_mm <= 20., "elastic_mm", options.elastic_mm, "in 0 .. 20");
  require(options.elastic_spacing_mm >= 5. && options.elastic_spacing_mm <= 200., "elastic_spacing_mm",
          options.elastic_spacing_mm, "in 5 .. 200");
  require(options.contrast >= 0. && options.contrast <= 1., "contrast", options.contrast, "in 0 .. 1");
  require(options.rim_share >= 0. && options.rim_share <= 1., "rim_share", options.rim_share, "in 0 .. 1");
  require(options.rim_mm >= 0. && options.rim_mm <= 15., "rim_mm", options.rim_mm, "in 0 .. 15");
  if (volumes.empty()) throw std::invalid_argument("simulator: at least one brain volume is needed");
  if (!(grid.resolution_mm > 0.) || grid.volume_shape[0] < 2 || grid.volume_shape[1] < 2 || grid.volume_shape[2] < 2)
    throw std::invalid_argument("simulator: the grid must have at least 2 voxels along each axis, of a positive size");

  for (const BrainVolume& volume : volumes) {
    check(volume);
    Source source;
    source.extent = brain_extent(volume);
    const double native = volume.resolution_mm;
    source.resolution_mm = std::max(native, grid.resolution_mm / 1.6);
    const double blur_mm2 = std::max(0., grid.resolution_mm * grid.resolution_mm - native * native);
    const double sigma = kSigmaOfFwhm * std::sqrt(blur_mm2);

    const torch::Tensor mask = volume.mask.to(device);
    torch::Tensor image = volume.image.to(device);
    image = (image / quantile_within(image, mask, 0.99)).masked_fill(~mask, 0.);
    std::vector<torch::Tensor> channels;
    channels.push_back(mask.to(torch::kFloat32));
    if (volume.labels.defined()) {
      const torch::Tensor labels = volume.labels.to(device);
      const int most = labels.max().item<int>();
      for (int label = 0; label <= most; ++label) {
        const torch::Tensor of_label = image.masked_fill(labels != label, 0.);
        if (label == 0 || of_label.any().item<bool>()) channels.push_back(of_label);
      }
    } else {
      channels.push_back(image);
    }

    std::array<torch::Tensor, 3> axes;
    for (int axis = 0; axis < 3; ++axis) {
      // A margin for the low-pass; array dimensions are z, y, x.
      const double reach = source.extent.half_size[axis] + 2. * sigma + 2. * source.resolution_mm;
      const auto out = 2 * static_cast<std::int64_t>(std::ceil(reach / source.resolution_mm)) + 1;
      const std::int64_t in = volume.image.size(2 - axis);
      axes[static_cast<std::size_t>(2 - axis)] =
          low_pass_matrix(in, -0.5 * static_cast<double>(in - 1) * native, native, out,
                          source.extent.centre[axis] - 0.5 * static_cast<double>(out - 1) * source.resolution_mm,
                          source.resolution_mm, sigma)
              .to(device);
    }
    std::vector<torch::Tensor> filtered;
    for (const torch::Tensor& channel : channels) filtered.push_back(apply_axes(channel.unsqueeze(0), axes));
    torch::Tensor all = torch::cat(filtered).contiguous();
    // Means over the brain alone: at its border the low-pass must not mix in the dark outside.
    all.slice(0, 1).div_(all.slice(0, 0, 1).clamp_min(0.1));
    source.channels = all;
    sources_.push_back(source);
  }
}

Anatomy AnatomySource::make(std::uint64_t seed, std::uint64_t number) const {
  const torch::NoGradGuard no_grad;
  const Source& source = sources_[volume_of(number)];
  RandomStream random(seed, number, purpose::kAnatomy);
  const double size = random.uniform(options_.scale_min, options_.scale_max);
  Eigen::Vector3d scale;
  for (int axis = 0; axis < 3; ++axis) scale[axis] = size * std::exp(random.normal(options_.aspect));

  // Tissue contrast: a factor per class.
  const std::int64_t classes = source.channels.size(0) - 1;
  std::vector<float> factors(static_cast<std::size_t>(classes), 1.F);
  if (classes > 1)
    for (float& factor : factors) factor = static_cast<float>(std::exp(random.normal(options_.contrast)));
  const torch::Tensor weights = torch::tensor(factors).to(device_);
  const torch::Tensor brain = source.channels.slice(0, 0, 1);
  const torch::Tensor image = torch::matmul(weights, source.channels.slice(0, 1).flatten(1)).view(brain.sizes());
  const torch::Tensor input = torch::cat({brain, image}).unsqueeze(0);

  // The part of the grid that the brain can reach.
  const Eigen::Vector3d centre = source.extent.centre;
  const Eigen::Vector3d reach = source.extent.half_size.cwiseProduct(scale) +
                                Eigen::Vector3d::Constant(4. * options_.elastic_mm + 2. * grid_.resolution_mm);
  std::array<std::int64_t, 3> first{}, count{};  // x, y, z
  std::array<torch::Tensor, 3> position;         // of the output voxels from the brain's centre, mm
  for (int axis = 0; axis < 3; ++axis) {
    const auto a = static_cast<std::size_t>(axis);
    const std::int64_t voxels = grid_.volume_shape[2 - a];
    const double middle = centre[axis] / grid_.resolution_mm + 0.5 * static_cast<double>(voxels - 1);
    const double half = reach[axis] / grid_.resolution_mm;
    first[a] = std::clamp<std::int64_t>(static_cast<std::int64_t>(std::floor(middle - half)), 0, voxels - 1);
    const auto last =
        std::clamp<std::int64_t>(static_cast<std::int64_t>(std::ceil(middle + half)), first[a], voxels - 1);
    count[a] = last - first[a] + 1;
    position[a] =
        (torch::arange(count[a], torch::kFloat64) + (static_cast<double>(first[a]) - middle)) * grid_.resolution_mm;
  }

  // Smooth deformation on a lattice of control points.
  torch::Tensor displacement;  // 3 x z x y x x, mm
  if (options_.elastic_mm > 0.) {
    std::array<std::int64_t, 3> points{};
    std::array<torch::Tensor, 3> basis;
    for (std::size_t a = 0; a < 3; ++a) {
      points[a] = spline_points(reach[static_cast<int>(a)], options_.elastic_spacing_mm);
      basis[a] = spline_matrix(position[a], points[a], options_.elastic_spacing_mm);
    }
    torch::Tensor coefficients = torch::empty({3, points[2], points[1], points[0]}, torch::kFloat32);
    const std::int64_t total = points[0] * points[1] * points[2];
    float* out = coefficients.data_ptr<float>();
    for (std::int64_t n = 0; n < total; ++n) {
      const Eigen::Vector3d drawn = random.normal3(options_.elastic_mm / kSplineDeviation);
      for (int axis = 0; axis < 3; ++axis) out[axis * total + n] = static_cast<float>(drawn[axis]);
    }
    displacement =
        apply_axes(coefficients.to(device_), {basis[2].to(device_), basis[1].to(device_), basis[0].to(device_)});
    take_out_rigid_part(source.channels[0], source.resolution_mm, position, scale, grid_.resolution_mm, &displacement);
  }

  // Where each output voxel comes from, in grid_sample's coordinates.
  torch::Tensor where =
      torch::empty({1, count[2], count[1], count[0], 3}, torch::TensorOptions().dtype(torch::kFloat32).device(device_));
  for (int axis = 0; axis < 3; ++axis) {
    const auto a = static_cast<std::size_t>(axis);
    std::array<std::int64_t, 3> view{1, 1, 1};
    view[2 - a] = count[a];
    const double half_mm = 0.5 * static_cast<double>(input.size(4 - axis) - 1) * source.resolution_mm;
    const torch::Tensor along = (position[a] / (scale[axis] * half_mm)).to(torch::kFloat32).view(view).to(device_);
    torch::Tensor target = where.select(4, axis).squeeze(0);
    if (displacement.defined())
      torch::add_out(target, along.expand_as(target), displacement[axis], 1. / half_mm);
    else
      target.copy_(along.expand_as(target));
  }
  const torch::Tensor sampled = F::grid_sample(
      input, where,
      F::GridSampleFuncOptions().mode(torch::kBilinear).padding_mode(torch::kZeros).align_corners(true))[0];

  Anatomy anatomy;
  const auto on_device = torch::TensorOptions().device(device_);
  const auto& shape = grid_.volume_shape;
  anatomy.image = torch::zeros({shape[0], shape[1], shape[2]}, on_device.dtype(torch::kFloat32));
  anatomy.mask = torch::zeros({shape[0], shape[1], shape[2]}, on_device.dtype(torch::kBool));
  const auto part = [&](const torch::Tensor& volume) {
    return volume.narrow(0, first[2], count[2]).narrow(1, first[1], count[1]).narrow(2, first[0], count[0]);
  };
  const torch::Tensor inside = sampled[0] > 0.5;
  part(anatomy.mask).copy_(inside);
  part(anatomy.image).copy_(sampled[1] * inside);
  if (!inside.any().item<bool>())
    throw std::invalid_argument("simulator: the brain does not reach into the grid; is the volume centred?");
  RandomStream of_rim(seed, number, purpose::kRim);
  if (of_rim.chance(options_.rim_share)) add_head_rim(options_.rim_mm, grid_.resolution_mm, &of_rim, &anatomy);
  BrainVolume measured;
  measured.mask = anatomy.mask;
  measured.resolution_mm = grid_.resolution_mm;
  anatomy.extent = brain_extent(measured);
  return anatomy;
}

}  // namespace svort
