#include <torch/types.h>

#include <Eigen/Core>
#include <Eigen/Geometry>
#include <cmath>
#include <limits>
#include <sstream>
#include <stdexcept>
#include <string>
#include <vector>

#include "svort_ros/geometry/rigid_fit.h"
#include "svort_ros/geometry/rigid_transform.h"
#include "svort_ros/metrics/image_similarity.h"
#include "svort_ros/metrics/pose_error.h"

namespace svort {
namespace {

[[noreturn]] void reject(const char* function, const std::string& what) {
  throw std::invalid_argument(std::string(function) + ": " + what);
}

std::string sizes(const torch::Tensor& tensor) {
  std::ostringstream text;
  if (!tensor.defined()) return "undefined";
  text << tensor.sizes();
  return text.str();
}

torch::Tensor checked_poses(const char* function, const char* name, const torch::Tensor& poses) {
  if (!poses.defined() || poses.dim() != 3 || poses.size(1) != 3 || poses.size(2) != 4)
    reject(function, std::string(name) + " must be n x 3 x 4, got " + sizes(poses));
  return poses.detach().to(torch::kCPU, torch::kFloat64).contiguous();
}

void check_counts(const char* function, const torch::Tensor& estimated, const torch::Tensor& truth) {
  if (estimated.size(0) != truth.size(0))
    reject(function,
           std::to_string(estimated.size(0)) + " estimated poses, but " + std::to_string(truth.size(0)) + " true ones");
}

struct Images {
  torch::Tensor test, reference, mask;
  double range = 0.;
};

Images checked_images(const char* function, const torch::Tensor& test, const torch::Tensor& reference,
                      const SimilarityOptions& options) {
  if (!test.defined() || !reference.defined() || test.sizes() != reference.sizes() || test.dim() == 0)
    reject(function, "images must have the same size, got " + sizes(test) + " and " + sizes(reference));
  Images images;
  images.test = test.detach().to(torch::kCPU, torch::kFloat64);
  images.reference = reference.detach().to(torch::kCPU, torch::kFloat64);
  if (options.mask.defined()) {
    if (options.mask.sizes() != test.sizes() || options.mask.scalar_type() != torch::kBool)
      reject(function, "the mask must be Bool of the images' size, got " + sizes(options.mask));
    images.mask = options.mask.to(torch::kCPU);
  } else {
    images.mask = torch::ones(test.sizes(), torch::kBool);
  }
  if (!images.mask.any().item<bool>()) reject(function, "there is nothing to compare");
  images.range =
      options.data_range ? *options.data_range : (images.reference.max() - images.reference.min()).item<double>();
  return images;
}

/// Weighted mean along every axis, the image continued by reflection (d c b a | a b c d | d c b a).
torch::Tensor window_mean(torch::Tensor image, const std::vector<double>& weights) {
  const auto radius = static_cast<std::int64_t>(weights.size() / 2);
  for (std::int64_t axis = 0; axis < image.dim(); ++axis) {
    const std::int64_t size = image.size(axis);
    torch::Tensor index = torch::arange(-radius, size + radius, torch::kInt64);
    index = torch::where(index < 0, -1 - index, index);
    index = torch::where(index >= size, 2 * size - 1 - index, index);
    const torch::Tensor padded = image.index_select(axis, index);
    torch::Tensor sum = torch::zeros_like(image);
    for (std::size_t k = 0; k < weights.size(); ++k)
      sum.add_(padded.narrow(axis, static_cast<std::int64_t>(k), size), weights[k]);
    image = sum;
  }
  return image;
}

}  // namespace

torch::Tensor poses_tensor(const std::vector<Pose>& poses) {
  torch::Tensor tensor = torch::empty({static_cast<std::int64_t>(poses.size()), 3, 4}, torch::kFloat64);
  double* out = tensor.data_ptr<double>();
  for (const Pose& pose : poses) {
    const TransFirst matrix = trans_first_from_pose(pose);
    for (int i = 0; i < 3; ++i)
      for (int j = 0; j < 4; ++j) *out++ = matrix(i, j);
  }
  return tensor;
}

PoseErrors pose_errors(const torch::Tensor& estimated, const torch::Tensor& truth, const AnchorFrame& frame) {
  constexpr const char* kName = "pose_errors";
  const torch::Tensor a = checked_poses(kName, "estimated", estimated), b = checked_poses(kName, "truth", truth);
  check_counts(kName, a, b);
  PoseErrors errors;
  errors.points =
      (anchor_points_from_matrix(a, frame) - anchor_points_from_matrix(b, frame)).view({-1, 3, 3}).norm(2, 2);
  errors.ed = errors.points.mean(1);
  // arccos((tr - 1) / 2) loses half of the digits near 0. This is the same angle, from the chord.
  const torch::Tensor chord = (a.slice(2, 0, 3) - b.slice(2, 0, 3)).flatten(1).norm(2, 1);
  errors.gd = 2. * torch::asin((chord / std::sqrt(8.)).clamp_max(1.));
  return errors;
}

Pose global_alignment(const torch::Tensor& estimated, const torch::Tensor& truth, const AnchorFrame& frame) {
  constexpr const char* kName = "global_alignment";
  const torch::Tensor a = checked_poses(kName, "estimated", estimated), b = checked_poses(kName, "truth", truth);
  check_counts(kName, a, b);
  if (a.size(0) == 0) reject(kName, "there are no poses");
  const auto points_of = [&frame](const torch::Tensor& poses) {
    const torch::Tensor points = anchor_points_from_matrix(poses, frame).view({-1, 3}).contiguous();
    return Eigen::Matrix3Xd(Eigen::Map<const Eigen::Matrix3Xd>(points.data_ptr<double>(), 3, points.size(0)));
  };
  return fit_points(points_of(a), points_of(b));
}

torch::Tensor transformed_poses(const Pose& transform, const torch::Tensor& poses) {
  const torch::Tensor checked = checked_poses("transformed_poses", "poses", poses);
  const TransFirst matrix = trans_first_from_pose(transform);
  torch::Tensor left = torch::empty({1, 3, 4}, torch::kFloat64);
  for (int i = 0; i < 3; ++i)
    for (int j = 0; j < 4; ++j) left[0][i][j] = matrix(i, j);
  return compose_transforms(left.expand_as(checked), checked);
}

PoseErrors relative_pose_errors(const torch::Tensor& estimated, const torch::Tensor& truth, const AnchorFrame& frame) {
  return pose_errors(transformed_poses(global_alignment(estimated, truth, frame), estimated), truth, frame);
}

ErrorSummary summarise(const torch::Tensor& values) {
  const torch::Tensor all = values.detach().to(torch::kCPU, torch::kFloat64).flatten();
  const torch::Tensor finite = std::get<0>(all.masked_select(torch::isfinite(all)).sort());
  ErrorSummary summary;
  summary.count = finite.numel();
  if (summary.count == 0) {
    summary.mean = summary.deviation = summary.median = summary.maximum = std::numeric_limits<double>::quiet_NaN();
    return summary;
  }
  summary.mean = finite.mean().item<double>();
  summary.deviation = summary.count > 1 ? finite.std().item<double>() : 0.;
  const std::int64_t middle = summary.count / 2;
  summary.median = summary.count % 2 ? finite[middle].item<double>()
                                     : 0.5 * (finite[middle - 1].item<double>() + finite[middle].item<double>());
  summary.maximum = finite[-1].item<double>();
  return summary;
}

double mean_squared_error(const torch::Tensor& test, const torch::Tensor& reference, const SimilarityOptions& options) {
  const Images images = checked_images("mean_squared_error", test, reference, options);
  return torch::pow(images.test - images.reference, 2).masked_select(images.mask).mean().item<double>();
}

double peak_signal_to_noise(const torch::Tensor& test, const torch::Tensor& reference,
                            const SimilarityOptions& options) {
  const Images images = checked_images("peak_signal_to_noise", test, reference, options);
  const double error = torch::pow(images.test - images.reference, 2).masked_select(images.mask).mean().item<double>();
  if (error == 0.) return std::numeric_limits<double>::infinity();
  return 10. * std::log10(images.range * images.range / error);
}

Ssim structural_similarity(const torch::Tensor& test, const torch::Tensor& reference, SsimWindow window,
                           const SimilarityOptions& options) {
  constexpr const char* kName = "structural_similarity";
  const Images images = checked_images(kName, test, reference, options);
  std::vector<double> weights(7, 1. / 7.);
  if (window == SsimWindow::gaussian) {
    weights.clear();
    double sum = 0.;
    for (int i = -5; i <= 5; ++i) {
      weights.push_back(std::exp(-0.5 * i * i / (1.5 * 1.5)));
      sum += weights.back();
    }
    for (double& weight : weights) weight /= sum;
  }
  const auto width = static_cast<std::int64_t>(weights.size());
  double voxels = 1.;
  for (std::int64_t axis = 0; axis < images.test.dim(); ++axis) {
    if (images.test.size(axis) < width)
      reject(kName, "axis " + std::to_string(axis) + " has " + std::to_string(images.test.size(axis)) +
                        " voxels, the window " + std::to_string(width));
    voxels *= static_cast<double>(width);
  }
  const double unbiased = window == SsimWindow::uniform ? voxels / (voxels - 1.) : 1.;
  const double c1 = std::pow(0.01 * images.range, 2), c2 = std::pow(0.03 * images.range, 2);
  const torch::Tensor &x = images.test, &y = images.reference;
  const torch::Tensor mx = window_mean(x, weights), my = window_mean(y, weights);
  const torch::Tensor vx = unbiased * (window_mean(x * x, weights) - mx * mx),
                      vy = unbiased * (window_mean(y * y, weights) - my * my),
                      vxy = unbiased * (window_mean(x * y, weights) - mx * my);
  Ssim result;
  result.map = (2. * mx * my + c1) * (2. * vxy + c2) / ((mx * mx + my * my + c1) * (vx + vy + c2));
  torch::Tensor inner = result.map, counts = images.mask;
  for (std::int64_t axis = 0; axis < x.dim(); ++axis) {
    inner = inner.narrow(axis, width / 2, x.size(axis) - width + 1);
    counts = counts.narrow(axis, width / 2, x.size(axis) - width + 1);
  }
  if (!counts.any().item<bool>()) reject(kName, "no window of the mask lies inside the image");
  result.mean = inner.masked_select(counts).mean().item<double>();
  return result;
}

}  // namespace svort
