#include "svort_ros/decision/coverage.h"

#include <Eigen/Eigenvalues>
#include <algorithm>
#include <cmath>
#include <limits>
#include <queue>

#include "checks.h"

namespace svort {
namespace {

constexpr int kHullDirections = 128;
constexpr std::size_t kHullPoints = 4000;  // of all brain blocks, evenly; more change the hull by less than a voxel
constexpr double kFarthest_mm = 100.;      // of the brain from the frame's origin; bounds the grid
constexpr double kProfileReach = 1.25;     // in thicknesses; the profile is below 0.02 beyond

Eigen::Matrix3f matrix_of(const ViewTensor& t) {
  Eigen::Matrix3f m;
  m << t[0], t[1], t[2], t[1], t[3], t[4], t[2], t[4], t[5];
  return m;
}

/// Evenly spread over the sphere (Fibonacci lattice).
const std::vector<Eigen::Vector3d>& directions() {
  static const std::vector<Eigen::Vector3d> all = [] {
    std::vector<Eigen::Vector3d> result;
    const double golden = M_PI * (3. - std::sqrt(5.));
    for (int i = 0; i < kHullDirections; ++i) {
      const double z = 1. - (2. * i + 1.) / kHullDirections;
      const double radius = std::sqrt(1. - z * z);
      result.emplace_back(radius * std::cos(golden * i), radius * std::sin(golden * i), z);
    }
    return result;
  }();
  return all;
}

/// How far the brain reaches in each direction: its hull, even where it has not been seen yet.
std::vector<double> hull_of(const std::vector<Eigen::Vector3d>& points, double share) {
  std::vector<double> reach;
  std::vector<double> along(points.size());
  for (const Eigen::Vector3d& direction : directions()) {
    std::transform(points.begin(), points.end(), along.begin(),
                   [&](const Eigen::Vector3d& p) { return direction.dot(p); });
    const auto rank =
        along.begin() + static_cast<std::ptrdiff_t>(std::floor(share * static_cast<double>(along.size() - 1)));
    std::nth_element(along.begin(), rank, along.end());
    reach.push_back(*rank);
  }
  return reach;
}

/// Squared distance to the nearest zero of `open`, in voxels, along one line (Felzenszwalb and Huttenlocher 2012).
void distance_along(std::vector<double>* f) {
  const auto n = static_cast<int>(f->size());
  std::vector<int> v(f->size(), 0);
  std::vector<double> z(f->size() + 1, 0.), d(f->size());
  int k = 0;
  z[0] = -std::numeric_limits<double>::infinity();
  z[1] = std::numeric_limits<double>::infinity();
  const auto at = [&](int i) { return (*f)[static_cast<std::size_t>(i)]; };
  for (int q = 1; q < n; ++q) {
    double s = 0.;
    for (;;) {
      const int p = v[static_cast<std::size_t>(k)];
      s = ((at(q) + double(q) * q) - (at(p) + double(p) * p)) / (2. * q - 2. * p);
      if (s > z[static_cast<std::size_t>(k)]) break;
      --k;
    }
    ++k;
    v[static_cast<std::size_t>(k)] = q;
    z[static_cast<std::size_t>(k)] = s;
    z[static_cast<std::size_t>(k) + 1] = std::numeric_limits<double>::infinity();
  }
  k = 0;
  for (int q = 0; q < n; ++q) {
    while (z[static_cast<std::size_t>(k) + 1] < q) ++k;
    const int p = v[static_cast<std::size_t>(k)];
    d[static_cast<std::size_t>(q)] = double(q - p) * (q - p) + at(p);
  }
  *f = d;
}

/// Distance of every place to the nearest one that is not open, voxels. What is outside of the grid is not open.
std::vector<double> distances(const ImageGrid& grid, const std::vector<std::uint8_t>& open) {
  constexpr double kFar = 1e9;
  const Eigen::Vector3i size = grid.size + Eigen::Vector3i::Constant(2);
  const auto offset = [&size](int i, int j, int k) {
    return static_cast<std::size_t>((k * size.y() + j) * size.x() + i);
  };
  std::vector<double> squared(static_cast<std::size_t>(size.prod()), 0.);
  for (int k = 0; k < grid.size.z(); ++k)
    for (int j = 0; j < grid.size.y(); ++j)
      for (int i = 0; i < grid.size.x(); ++i)
        if (open[grid.offset(i, j, k)]) squared[offset(i + 1, j + 1, k + 1)] = kFar;
  for (int axis = 0; axis < 3; ++axis) {
    const int a = (axis + 1) % 3, b = (axis + 2) % 3;
    std::vector<double> line(static_cast<std::size_t>(size[axis]));
    for (int p = 0; p < size[a]; ++p)
      for (int q = 0; q < size[b]; ++q) {
        Eigen::Vector3i at;
        at[a] = p;
        at[b] = q;
        for (int r = 0; r < size[axis]; ++r) {
          at[axis] = r;
          line[static_cast<std::size_t>(r)] = squared[offset(at.x(), at.y(), at.z())];
        }
        distance_along(&line);
        for (int r = 0; r < size[axis]; ++r) {
          at[axis] = r;
          squared[offset(at.x(), at.y(), at.z())] = line[static_cast<std::size_t>(r)];
        }
      }
  }
  std::vector<double> result(grid.voxel_count());
  for (int k = 0; k < grid.size.z(); ++k)
    for (int j = 0; j < grid.size.y(); ++j)
      for (int i = 0; i < grid.size.x(); ++i)
        result[grid.offset(i, j, k)] = std::sqrt(squared[offset(i + 1, j + 1, k + 1)]);
  return result;
}

/// Connected parts of what is open, by faces.
std::vector<CoverageGap> gaps_of(const ImageGrid& grid, const std::vector<std::uint8_t>& open) {
  const std::vector<double> depth = distances(grid, open);
  const double voxel = grid.spacing.x();
  std::vector<std::uint8_t> left = open;
  std::vector<CoverageGap> gaps;
  for (int k = 0; k < grid.size.z(); ++k)
    for (int j = 0; j < grid.size.y(); ++j)
      for (int i = 0; i < grid.size.x(); ++i) {
        if (!left[grid.offset(i, j, k)]) continue;
        left[grid.offset(i, j, k)] = 0;
        std::queue<Eigen::Vector3i> front;
        front.push({i, j, k});
        CoverageGap gap;
        double deepest = 0.;
        std::size_t count = 0;
        while (!front.empty()) {
          const Eigen::Vector3i at = front.front();
          front.pop();
          ++count;
          const double here = depth[grid.offset(at.x(), at.y(), at.z())];
          if (here > deepest) {
            deepest = here;
            gap.centre = grid.position(at.cast<double>());
          }
          for (int axis = 0; axis < 3; ++axis)
            for (const int step : {-1, 1}) {
              Eigen::Vector3i next = at;
              next[axis] += step;
              if (next[axis] < 0 || next[axis] >= grid.size[axis]) continue;
              std::uint8_t& there = left[grid.offset(next.x(), next.y(), next.z())];
              if (!there) continue;
              there = 0;
              front.push(next);
            }
        }
        // The distance is between the centres of voxels; the gap ends half a voxel before the one that is not open.
        gap.width_mm = 2. * (deepest - 0.5) * voxel;
        gap.volume_ml = static_cast<double>(count) * voxel * voxel * voxel * 1e-3;
        gaps.push_back(gap);
      }
  std::stable_sort(gaps.begin(), gaps.end(),
                   [](const CoverageGap& a, const CoverageGap& b) { return a.volume_ml > b.volume_ml; });
  return gaps;
}

}  // namespace

void validate(const CoverageOptions& o) {
  const OptionCheck check("decision.coverage.");
  check(o.resolution_mm >= 1. && o.resolution_mm <= 20., "resolution_mm", o.resolution_mm, "from 1 to 20 mm");
  check(o.planned_stacks >= 1 && o.planned_stacks <= 100, "planned_stacks", o.planned_stacks, "from 1 to 100");
  check(o.views > 0. && o.views <= 100., "views", o.views, "in (0, 100]");
  check(o.sharp_views >= 0. && o.sharp_views <= 100., "sharp_views", o.sharp_views, "from 0 to 100");
  check(o.well > 0. && o.well <= 1., "well", o.well, "in (0, 1]");
  check(o.complete > 0. && o.complete <= 1., "complete", o.complete, "in (0, 1]");
  check(o.hull_quantile > 0.5 && o.hull_quantile <= 1., "hull_quantile", o.hull_quantile, "in (0.5, 1]");
}

CoverageTarget coverage_target(const CoverageOptions& options, int stacks) {
  const int begun = std::clamp(stacks, 1, options.planned_stacks);
  CoverageTarget target{options.views, options.sharp_views};
  if (begun < options.planned_stacks) {
    target.views *= static_cast<double>(begun) / options.planned_stacks;
    target.sharp_views *= static_cast<double>(begun - 1) / (options.planned_stacks - 1);
  }
  return target;
}

void add_view(ViewTensor* tensor, const Eigen::Vector3d& n, double amount) {
  const std::array<double, 6> products = {n.x() * n.x(), n.x() * n.y(), n.x() * n.z(),
                                          n.y() * n.y(), n.y() * n.z(), n.z() * n.z()};
  for (std::size_t i = 0; i < 6; ++i) (*tensor)[i] += static_cast<float>(amount * products[i]);
}

double view_count(const ViewTensor& t) { return static_cast<double>(t[0] + t[3] + t[5]); }

double orientation_count(const ViewTensor& tensor) {
  const Eigen::Matrix3f m = matrix_of(tensor);
  const float squared = m.squaredNorm(), trace = m.trace();
  return squared > 0.F ? static_cast<double>(trace * trace / squared) : 0.;
}

double place_score(const ViewTensor& tensor, const CoverageTarget& target) {
  const double views = view_count(tensor);
  if (!(views > 0.)) return 0.;
  const double seen = std::min(1., views / target.views);
  if (!(target.sharp_views > 0.)) return seen;
  Eigen::SelfAdjointEigenSolver<Eigen::Matrix3f> solver;
  solver.computeDirect(matrix_of(tensor), Eigen::EigenvaluesOnly);
  const double sharp = std::max(0., views - static_cast<double>(solver.eigenvalues()[2]));
  return 0.5 * (seen + std::min(1., sharp / target.sharp_views));
}

double profile_weight(double z_mm, double thickness_mm) {
  // Gaussian of full width `thickness`; its values at multiples of the thickness add up to 1.064.
  const double u = z_mm / thickness_mm;
  return std::exp(-4. * M_LN2 * u * u) / 1.0645;
}

Volume CoverageMap::score_volume() const { return {grid, score}; }

Volume CoverageMap::orientation_volume() const {
  Volume volume{grid, std::vector<float>(views.size(), 0.F)};
  for (std::size_t i = 0; i < views.size(); ++i)
    if (brain[i]) volume.values[i] = static_cast<float>(orientation_count(views[i]));
  return volume;
}

CoverageMap measure_coverage(const Estimate& estimate, const QualityMonitor& quality, int stacks,
                             const CoverageOptions& options) {
  CoverageMap map;
  map.stacks = stacks;
  map.target = coverage_target(options, stacks);
  if (quality.size() != estimate.slices.size())
    throw std::invalid_argument("measure_coverage: " + std::to_string(quality.size()) + " scores for " +
                                std::to_string(estimate.slices.size()) + " slices");

  // 1. The brain's hull, from the masks at the slices' poses.
  std::size_t total = 0;
  for (std::size_t i = 0; i < estimate.slices.size(); ++i)
    if (estimate.slices[i].weight > 0.)
      total += static_cast<std::size_t>(std::count(quality.blocks(i).brain.begin(), quality.blocks(i).brain.end(), 1));
  const std::size_t stride = std::max<std::size_t>(1, total / kHullPoints);
  std::vector<Eigen::Vector3d> points;
  std::size_t counter = 0;
  for (std::size_t i = 0; i < estimate.slices.size(); ++i) {
    if (!(estimate.slices[i].weight > 0.)) continue;
    const SliceBlocks& blocks = quality.blocks(i);
    for (int row = 0; row < blocks.size; ++row)
      for (int column = 0; column < blocks.size; ++column) {
        if (!blocks.brain[static_cast<std::size_t>(row * blocks.size + column)]) continue;
        if (counter++ % stride != 0) continue;
        const Eigen::Vector3d point = estimate.slices[i].T_brain_slice * blocks.centre(column, row);
        if (point.norm() < kFarthest_mm) points.push_back(point);
      }
  }
  if (points.empty()) return map;
  const std::vector<double> reach = hull_of(points, options.hull_quantile);

  // 2. A grid of whole voxels around it, at multiples of the voxel size, so that it does not slide between revisions.
  Eigen::Vector3d low = points.front(), high = points.front();
  for (const Eigen::Vector3d& point : points) {
    low = low.cwiseMin(point);
    high = high.cwiseMax(point);
  }
  const double voxel = options.resolution_mm;
  const Eigen::Vector3i first = (low / voxel).array().floor().cast<int>() - 1;
  const Eigen::Vector3i last = (high / voxel).array().ceil().cast<int>() + 1;
  map.grid.size = last - first + Eigen::Vector3i::Ones();
  map.grid.spacing.setConstant(voxel);
  map.grid.T_frame_grid.translation() = 0.5 * voxel * (first + last).cast<double>();
  map.brain.assign(map.grid.voxel_count(), 0);
  map.views.assign(map.grid.voxel_count(), ViewTensor{});
  map.score.assign(map.grid.voxel_count(), 0.F);
  std::vector<std::size_t> places;
  std::vector<Eigen::Vector3d> positions;
  for (int k = 0; k < map.grid.size.z(); ++k)
    for (int j = 0; j < map.grid.size.y(); ++j)
      for (int i = 0; i < map.grid.size.x(); ++i) {
        const Eigen::Vector3d position = map.grid.position({double(i), double(j), double(k)});
        bool inside = true;
        for (std::size_t d = 0; d < reach.size() && inside; ++d) inside = directions()[d].dot(position) <= reach[d];
        if (!inside) continue;
        places.push_back(map.grid.offset(i, j, k));
        positions.push_back(position);
        map.brain[places.back()] = 1;
      }
  map.places = places.size();
  map.brain_mm3 = static_cast<double>(places.size()) * voxel * voxel * voxel;
  if (places.empty()) return map;

  // 3. Who sees what.
  for (std::size_t s = 0; s < estimate.slices.size(); ++s) {
    const SliceEstimate& slice = estimate.slices[s];
    const double score = quality.slices()[s].score;
    if (!(slice.weight > 0.) || !(score > 0.)) continue;
    const SliceBlocks& blocks = quality.blocks(s);
    const Pose T_slice_brain = slice.T_brain_slice.inverse();
    const Eigen::Vector3d across = T_slice_brain.linear().row(2).transpose();
    const double offset = T_slice_brain.translation().z();
    const double limit = kProfileReach * slice.info.thickness;
    const Eigen::Vector3d normal = slice.T_brain_slice.linear().col(2);
    for (std::size_t p = 0; p < places.size(); ++p) {
      const double z = across.dot(positions[p]) + offset;
      if (std::abs(z) > limit) continue;
      const int block = blocks.at(T_slice_brain * positions[p]);
      if (block < 0 || !blocks.brain[static_cast<std::size_t>(block)]) continue;
      add_view(&map.views[places[p]], normal, score * profile_weight(z, slice.info.thickness));
    }
  }

  // 4. What that makes.
  const CoverageTarget full{options.views, options.sharp_views};
  std::vector<std::uint8_t> open(map.brain.size(), 0);
  double sum = 0., orientations = 0.;
  std::size_t well = 0, complete = 0;
  for (const std::size_t place : places) {
    const double score = place_score(map.views[place], map.target);
    map.score[place] = static_cast<float>(score);
    sum += score;
    orientations += orientation_count(map.views[place]);
    well += score >= options.well ? 1 : 0;
    complete += place_score(map.views[place], full) >= options.well ? 1 : 0;
    open[place] = score < options.well ? 1 : 0;
  }
  const auto count = static_cast<double>(places.size());
  map.mean_score = sum / count;
  map.mean_orientations = orientations / count;
  map.seen_well = static_cast<double>(well) / count;
  map.complete = static_cast<double>(complete) / count;
  map.gaps = gaps_of(map.grid, open);
  return map;
}

}  // namespace svort
