#include "svort_ros/registration/template_registration.h"

#include <Eigen/Cholesky>
#include <algorithm>
#include <cmath>
#include <limits>
#include <numeric>
#include <optional>
#include <random>
#include <sstream>
#include <stdexcept>

#include "../acquisition/parallel.h"
#include "rotation_grid.h"
#include "sampled_volume.h"
#include "slice_terms.h"

namespace svort {
namespace {

constexpr double kBrainShare = 0.25;  // of the bright tissue: brain, not rim

float bright_of(const Volume& volume) {
  std::vector<float> positive;
  for (const float value : volume.values)
    if (value > 0.F) positive.push_back(value);
  if (positive.size() < 10) return 0.F;
  const auto rank = static_cast<std::ptrdiff_t>(0.99 * static_cast<double>(positive.size() - 1));
  std::nth_element(positive.begin(), positive.begin() + rank, positive.end());
  return positive[static_cast<std::size_t>(rank)];
}

struct Shape {
  Eigen::Vector3d centroid = Eigen::Vector3d::Zero();  ///< mm, in the volume's frame
  double volume_mm3 = 0.;
};

/// Centroid and size of what is brighter than a share of the bright tissue.
Shape shape_of(const Volume& volume) {
  const float threshold = static_cast<float>(kBrainShare) * bright_of(volume);
  Shape shape;
  if (!(threshold > 0.F)) return shape;
  const double voxel = volume.grid.spacing.prod();
  Eigen::Vector3d sum = Eigen::Vector3d::Zero();
  double count = 0.;
  std::size_t offset = 0;
  for (int z = 0; z < volume.grid.size.z(); ++z)
    for (int y = 0; y < volume.grid.size.y(); ++y)
      for (int x = 0; x < volume.grid.size.x(); ++x, ++offset)
        if (volume.values[offset] > threshold) {
          sum += Eigen::Vector3d(x, y, z);
          count += 1.;
        }
  if (count > 0.) shape.centroid = volume.grid.position(sum / count);
  shape.volume_mm3 = count * voxel;
  return shape;
}

/// The structure of the brain around the volume's centroid, in coarse voxels: brightness (bright tissue at 1) less a
/// wider blur of it. What is left are cortex, ventricles and outline, whatever the shading and however round the brain.
SampledVolume centred(const Volume& volume, const Shape& shape, const TemplateOptions& options) {
  const double radius = 1.7 * std::cbrt(shape.volume_mm3 * 3. / (4. * M_PI)) + 2. * options.blur_mm;
  const int size = 2 * static_cast<int>(std::ceil(radius / options.voxel_mm)) + 1;
  const auto n = static_cast<std::size_t>(size);
  std::vector<float> sums(n * n * n, 0.F);
  // Every voxel is shared among the eight coarse ones around it. Given whole to the nearest, voxels that are as large
  // as the coarse ones would move by up to half of one, all the same way.
  std::vector<float> counts(n * n * n, 0.F);
  const float scale = 1.F / bright_of(volume);
  std::size_t offset = 0;
  for (int z = 0; z < volume.grid.size.z(); ++z) {
    for (int y = 0; y < volume.grid.size.y(); ++y) {
      for (int x = 0; x < volume.grid.size.x(); ++x, ++offset) {
        const Eigen::Vector3d p = volume.grid.position(Eigen::Vector3d(x, y, z)) - shape.centroid;
        const Eigen::Vector3d at = p / options.voxel_mm + Eigen::Vector3d::Constant(0.5 * (size - 1));
        const Eigen::Vector3i first = at.array().floor().cast<int>();
        if ((first.array() < 0).any() || (first.array() + 1 >= size).any()) continue;
        const Eigen::Vector3f f = (at - first.cast<double>()).cast<float>();
        const float value = std::min(1.5F, volume.values[offset] * scale);
        for (int corner = 0; corner < 8; ++corner) {
          const Eigen::Vector3i step(corner & 1, corner >> 1 & 1, corner >> 2);
          const Eigen::Vector3i i = first + step;
          float share = 1.F;
          for (int axis = 0; axis < 3; ++axis) share *= step[axis] ? f[axis] : 1.F - f[axis];
          const std::size_t to = (static_cast<std::size_t>(i.z()) * n + static_cast<std::size_t>(i.y())) * n +
                                 static_cast<std::size_t>(i.x());
          sums[to] += share * value;
          counts[to] += share;
        }
      }
    }
  }
  for (std::size_t i = 0; i < sums.size(); ++i)
    if (counts[i] > 0.F) sums[i] /= counts[i];
  std::vector<float> structure = blurred(sums, size, options.blur_mm / options.voxel_mm);
  const std::vector<float> wide = blurred(std::move(sums), size, options.wide_blur_mm / options.voxel_mm);
  for (std::size_t i = 0; i < structure.size(); ++i) structure[i] -= wide[i];
  return SampledVolume(std::move(structure), size, options.voxel_mm);
}

struct Candidate {
  Eigen::Matrix3d rotation = Eigen::Matrix3d::Identity();
  Eigen::Vector3d shift = Eigen::Vector3d::Zero();  ///< between the centroids, mm
  double log_scale = 0.;
  double correlation = -2.;
};

/// Points of the template, with their values, to look up in the volume.
struct Points {
  std::vector<Eigen::Vector3f> position;
  std::vector<float> value;
};

/// Samples of the template's brain and of a rim around it: what of the volume lies out there speaks against a pose.
Points brain_points(const SampledVolume& target, std::size_t most, std::uint64_t seed) {
  std::vector<float> near = target.values();
  for (float& value : near) value = std::abs(value);
  constexpr double kRimVoxels = 1.;
  near = blurred(std::move(near), target.size(), kRimVoxels);
  std::vector<std::size_t> chosen;
  for (std::size_t i = 0; i < near.size(); ++i)
    if (near[i] > 0.02F) chosen.push_back(i);
  if (chosen.size() > most) {
    std::mt19937_64 random(seed);  // std::shuffle differs between libraries; this does not
    for (std::size_t i = 0; i < most; ++i) std::swap(chosen[i], chosen[i + random() % (chosen.size() - i)]);
    chosen.resize(most);
    std::sort(chosen.begin(), chosen.end());
  }
  Points points;
  const auto n = static_cast<std::size_t>(target.size());
  const double centre = 0.5 * (target.size() - 1);
  for (const std::size_t i : chosen) {
    const Eigen::Vector3d at(static_cast<double>(i % n), static_cast<double>(i / n % n),
                             static_cast<double>(i / n / n));
    points.position.emplace_back(((at.array() - centre) * target.voxel_mm()).matrix().cast<float>());
    points.value.push_back(target.values()[i]);
  }
  return points;
}

/// Correlation of the template's points with the volume where the candidate puts them.
double score(const Points& points, const SampledVolume& volume, const Candidate& candidate) {
  const Eigen::Matrix3f linear = (std::exp(candidate.log_scale) * candidate.rotation).cast<float>();
  const Eigen::Vector3f shift = candidate.shift.cast<float>();
  double sum_a = 0., sum_b = 0., sum_aa = 0., sum_bb = 0., sum_ab = 0.;
  for (std::size_t i = 0; i < points.value.size(); ++i) {
    const double a = points.value[i], b = volume.at(linear * points.position[i] + shift).value;
    sum_a += a;
    sum_b += b;
    sum_aa += a * a;
    sum_bb += b * b;
    sum_ab += a * b;
  }
  const auto n = static_cast<double>(points.value.size());
  const double variance = (n * sum_aa - sum_a * sum_a) * (n * sum_bb - sum_b * sum_b);
  return variance > 0. ? (n * sum_ab - sum_a * sum_b) / std::sqrt(variance) : -1.;
}

/// Gauss-Newton on template = gain x volume + offset over rotation, shift and size; a step that lowers the correlation
/// is halved, and the search ends when none helps.
Candidate refined(const Points& points, const SampledVolume& volume, Candidate candidate) {
  using Vector7d = Eigen::Matrix<double, 7, 1>;
  using Matrix7d = Eigen::Matrix<double, 7, 7>;
  candidate.correlation = score(points, volume, candidate);
  for (int iteration = 0; iteration < 12; ++iteration) {
    const Eigen::Matrix3f linear = (std::exp(candidate.log_scale) * candidate.rotation).cast<float>();
    const Eigen::Vector3f shift = candidate.shift.cast<float>();
    std::vector<SampledVolume::Sample> samples(points.value.size());
    double sum_a = 0., sum_b = 0., sum_bb = 0., sum_ab = 0.;
    for (std::size_t i = 0; i < points.value.size(); ++i) {
      samples[i] = volume.at(linear * points.position[i] + shift);
      const double a = points.value[i], b = samples[i].value;
      sum_a += a;
      sum_b += b;
      sum_bb += b * b;
      sum_ab += a * b;
    }
    const auto n = static_cast<double>(points.value.size());
    const double spread = n * sum_bb - sum_b * sum_b;
    if (!(spread > 0.)) break;
    const double gain = std::max(0.1, (n * sum_ab - sum_a * sum_b) / spread), offset = (sum_a - gain * sum_b) / n;
    Matrix7d hessian = Matrix7d::Zero();
    Vector7d gradient = Vector7d::Zero();
    for (std::size_t i = 0; i < points.value.size(); ++i) {
      const Eigen::Vector3d x = (linear * points.position[i]).cast<double>();
      const Eigen::Vector3d force = gain * samples[i].gradient.cast<double>();
      const Eigen::Vector3d torque = x.cross(force);
      Vector7d row;
      row << torque.x(), torque.y(), torque.z(), force.x(), force.y(), force.z(), force.dot(x);
      const double difference = gain * samples[i].value + offset - points.value[i];
      hessian += row * row.transpose();
      gradient += difference * row;
    }
    hessian.diagonal() *= 1.001;
    hessian.diagonal().array() += 1e-9;
    Vector7d step = -hessian.ldlt().solve(gradient);
    const double length =
        std::max({step.head<3>().norm() / 0.2, step.segment<3>(3).norm() / 8., std::abs(step(6)) / 0.1});
    if (!(length < std::numeric_limits<double>::infinity())) break;
    if (length > 1.) step /= length;
    bool better = false;
    for (int halving = 0; halving < 4 && !better; ++halving, step *= 0.5) {
      Candidate next = candidate;
      Vector6d twist = Vector6d::Zero();
      twist.head<3>() = step.head<3>();
      next.rotation = motion(twist).linear() * candidate.rotation;
      next.shift += step.segment<3>(3);
      next.log_scale = std::clamp(next.log_scale + step(6), -0.5, 0.5);
      next.correlation = score(points, volume, next);
      if (next.correlation > candidate.correlation) {
        better = next.correlation - candidate.correlation > 1e-6;
        candidate = next;
        if (!better) return candidate;
      }
    }
    if (!better) break;
  }
  return candidate;
}

double angle_between(const Eigen::Matrix3d& a, const Eigen::Matrix3d& b) {
  return Eigen::AngleAxisd(Eigen::Matrix3d(a.transpose() * b)).angle();
}

/// The best pose, and the best one that is another answer.
std::pair<Candidate, std::optional<Candidate>> search(const SampledVolume& target, const SampledVolume& volume,
                                                      double log_scale, const TemplateOptions& options) {
  const double distinct = options.distinct_deg * M_PI / 180.;
  const Points points =
      brain_points(target, static_cast<std::size_t>(options.samples), static_cast<std::uint64_t>(options.seed));
  const std::vector<Eigen::Quaterniond> rotations = spread_rotations(options.rotations);
  std::vector<Candidate> tried(rotations.size());
  parallel_chunks(static_cast<std::int64_t>(tried.size()), [&](std::int64_t begin, std::int64_t end) {
    for (auto i = static_cast<std::size_t>(begin); i < static_cast<std::size_t>(end); ++i) {
      tried[i].rotation = rotations[i].normalized().toRotationMatrix();
      tried[i].log_scale = log_scale;
      tried[i].correlation = score(points, volume, tried[i]);
    }
  });
  std::stable_sort(tried.begin(), tried.end(),
                   [](const Candidate& a, const Candidate& b) { return a.correlation > b.correlation; });
  // The best of each neighbourhood, not the same peak six times.
  std::vector<Candidate> chosen;
  for (const Candidate& candidate : tried) {
    if (static_cast<int>(chosen.size()) == options.refined) break;
    const bool known = std::any_of(chosen.begin(), chosen.end(), [&](const Candidate& other) {
      return angle_between(candidate.rotation, other.rotation) < 0.7 * distinct;
    });
    if (!known) chosen.push_back(candidate);
  }
  const Points all =
      brain_points(target, 4 * static_cast<std::size_t>(options.samples), static_cast<std::uint64_t>(options.seed));
  parallel_tasks(static_cast<std::int64_t>(chosen.size()), [&](std::int64_t i) {
    Candidate& candidate = chosen[static_cast<std::size_t>(i)];
    candidate = refined(all, volume, candidate);
  });
  std::stable_sort(chosen.begin(), chosen.end(),
                   [](const Candidate& a, const Candidate& b) { return a.correlation > b.correlation; });
  for (std::size_t i = 1; i < chosen.size(); ++i)
    if (angle_between(chosen[0].rotation, chosen[i].rotation) > distinct) return {chosen[0], chosen[i]};
  return {chosen[0], std::nullopt};
}

SampledVolume mirrored(const SampledVolume& volume) {
  std::vector<float> values = volume.values();
  const auto n = static_cast<std::ptrdiff_t>(volume.size());
  for (auto row = values.begin(); row != values.end(); row += n) std::reverse(row, row + n);
  return SampledVolume(std::move(values), volume.size(), volume.voxel_mm());
}

Shape checked_shape(const Volume& volume, const std::string& name) {
  if (volume.values.size() != volume.grid.voxel_count() || volume.empty())
    throw std::invalid_argument("template registration: " + name + " is empty");
  for (const float value : volume.values)
    if (!std::isfinite(value)) throw std::invalid_argument("template registration: " + name + " holds NaN or infinity");
  const Shape shape = shape_of(volume);
  if (!(shape.volume_mm3 > 0.)) throw std::invalid_argument("template registration: " + name + " shows no brain");
  return shape;
}

}  // namespace

void validate(const TemplateOptions& options) {
  const auto require = [](bool condition, const char* name, double value, const char* range) {
    if (condition) return;
    std::ostringstream message;
    message << "template_match." << name << " is " << value << "; it must be " << range;
    throw std::invalid_argument(message.str());
  };
  require(options.voxel_mm >= 1. && options.voxel_mm <= 8., "voxel_mm", options.voxel_mm, "from 1 to 8 mm");
  require(options.blur_mm >= 0. && options.blur_mm <= 20., "blur_mm", options.blur_mm, "from 0 to 20 mm");
  require(options.wide_blur_mm > options.blur_mm && options.wide_blur_mm <= 50., "wide_blur_mm", options.wide_blur_mm,
          "above blur_mm, at most 50 mm");
  require(options.rotations >= 24 && options.rotations <= 1000000, "rotations", options.rotations,
          "from 24 to 1,000,000");
  require(options.refined >= 1 && options.refined <= 1000, "refined", options.refined, "from 1 to 1000");
  require(options.samples >= 100, "samples", options.samples, "at least 100");
  require(options.seed >= 0, "seed", options.seed, "zero or positive");
  require(options.distinct_deg > 0. && options.distinct_deg < 180., "distinct_deg", options.distinct_deg,
          "between 0 and 180 degrees");
}

double brain_volume_mm3(const Volume& volume) { return shape_of(volume).volume_mm3; }

std::vector<std::size_t> nearest_templates(const std::vector<BrainTemplate>& templates, double volume_mm3, int count) {
  std::vector<double> distance;
  for (const BrainTemplate& each : templates)
    distance.push_back(std::abs(std::log(std::max(1., brain_volume_mm3(each.volume)) / std::max(1., volume_mm3))));
  std::vector<std::size_t> order(templates.size());
  std::iota(order.begin(), order.end(), std::size_t{0});
  std::stable_sort(order.begin(), order.end(), [&](std::size_t a, std::size_t b) { return distance[a] < distance[b]; });
  order.resize(std::min(order.size(), static_cast<std::size_t>(std::max(0, count))));
  return order;
}

TemplateMatch match_template(const Volume& volume, const BrainTemplate& target, const TemplateOptions& options) {
  validate(options);
  const Shape of_volume = checked_shape(volume, "the volume");
  const Shape of_target = checked_shape(target.volume, "template " + target.name);
  const SampledVolume there = centred(volume, of_volume, options);
  const SampledVolume here = centred(target.volume, of_target, options);
  const double log_scale = std::log(of_volume.volume_mm3 / of_target.volume_mm3) / 3.;
  const auto [best, second] = search(here, there, log_scale, options);
  const auto [best_mirrored, unused] = search(mirrored(here), there, log_scale, options);

  TemplateMatch match;
  match.template_name = target.name;
  match.scale = std::exp(best.log_scale);
  match.correlation = best.correlation;
  match.runner_up = second ? second->correlation : -1.;
  match.mirrored = best_mirrored.correlation;
  match.sure =
      match.correlation >= options.least_correlation && match.correlation - match.runner_up >= options.least_margin;
  match.handedness_sure = match.sure && match.correlation - match.mirrored >= options.least_margin;
  // volume = scale R (template - c_t) + shift + c_v; a rigid map the other way keeps the size of the volume.
  match.T_template_volume.linear() = best.rotation.transpose();
  match.T_template_volume.translation() =
      of_target.centroid - best.rotation.transpose() * (of_volume.centroid + best.shift);
  return match;
}

}  // namespace svort
