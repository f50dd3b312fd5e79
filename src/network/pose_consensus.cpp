#include "svort_ros/network/pose_consensus.h"

#include <torch/types.h>

#include <Eigen/Core>
#include <Eigen/SVD>
#include <algorithm>
#include <array>
#include <cmath>
#include <limits>
#include <map>
#include <stdexcept>
#include <string>
#include <vector>

#include "../registration/trajectory.h"
#include "svort_ros/geometry/pose.h"
#include "svort_ros/geometry/rigid_transform.h"

namespace svort {
namespace {

using Points = Eigen::Matrix3d;  // three anchor points, one per column

struct Vote {
  Points nominal, direct, mirrored;
  Pose T_nominal_slice = Pose::Identity();
  double weight = 1.;
};

Points reflected(const Points& points) {
  Points result = points;
  result.row(0) *= -1.;
  return result;
}

double squared_distance(const Points& a, const Points& b) { return (a - b).squaredNorm() / 3.; }

// Geman-McClure: quadratic near 0, levels off at robust^2. Its weight is that of iteratively reweighted least squares.
double cost(double squared, double robust) { return squared / (1. + squared / (robust * robust)); }
double influence(double squared, double robust) {
  const double ratio = 1. / (1. + squared / (robust * robust));
  return ratio * ratio;
}

Points moved(const Pose& motion, const Points& points) {
  return (motion.linear() * points).colwise() + motion.translation();
}

double total_cost(const std::vector<Vote>& votes, const Pose& motion, bool has_mirrored, double robust) {
  double sum = 0.;
  for (const Vote& vote : votes) {
    const Points here = moved(motion, vote.nominal);
    sum += vote.weight * cost(squared_distance(here, vote.direct), robust);
    if (!has_mirrored) continue;
    const double nearer =
        std::min(squared_distance(here, vote.mirrored), squared_distance(reflected(here), vote.mirrored));
    sum += vote.weight * cost(nearer, robust);
  }
  return sum;
}

// Weighted correspondences between points before and after a rigid motion, gathered for a Procrustes fit.
class Procrustes {
 public:
  void add(const Points& from, const Points& to, double weight) {
    total_ += 3. * weight;
    from_ += weight * from.rowwise().sum();
    to_ += weight * to.rowwise().sum();
    product_ += weight * to * from.transpose();
  }
  Pose fit() const {
    const Eigen::Vector3d from = from_ / total_, to = to_ / total_;
    const Eigen::JacobiSVD<Eigen::Matrix3d> svd(product_ - total_ * to * from.transpose(),
                                                Eigen::ComputeFullU | Eigen::ComputeFullV);
    Eigen::Vector3d signs = Eigen::Vector3d::Ones();
    if ((svd.matrixU() * svd.matrixV().transpose()).determinant() < 0.) signs.z() = -1.;
    Pose motion = Pose::Identity();
    motion.linear() = svd.matrixU() * signs.asDiagonal() * svd.matrixV().transpose();
    motion.translation() = to - motion.linear() * from;
    return motion;
  }

 private:
  double total_ = 0.;
  Eigen::Vector3d from_ = Eigen::Vector3d::Zero(), to_ = Eigen::Vector3d::Zero();
  Eigen::Matrix3d product_ = Eigen::Matrix3d::Zero();
};

// Reweighted least squares from `motion`; `prior` slices' worth of weight hold it to where it started.
Pose refine(const std::vector<Vote>& votes, Pose motion, bool has_mirrored, double prior,
            const ConsensusOptions& options) {
  const Pose start = motion;
  const double robust = options.robust_mm;
  double total = 0.;
  for (const Vote& vote : votes) total += vote.weight;
  for (int iteration = 0; iteration < options.iterations; ++iteration) {
    Procrustes fit;
    for (const Vote& vote : votes) {
      const Points here = moved(motion, vote.nominal);
      fit.add(vote.nominal, vote.direct, vote.weight * influence(squared_distance(here, vote.direct), robust));
      if (has_mirrored) {
        const double as_is = squared_distance(here, vote.mirrored);
        const double turned = squared_distance(reflected(here), vote.mirrored);
        fit.add(vote.nominal, as_is <= turned ? vote.mirrored : reflected(vote.mirrored),
                vote.weight * influence(std::min(as_is, turned), robust));
      }
      if (prior > 0.) fit.add(vote.nominal, moved(start, vote.nominal), prior * vote.weight / total);
    }
    motion = fit.fit();
  }
  return motion;
}

Pose solve(const std::vector<Vote>& votes, bool has_mirrored, const ConsensusOptions& options) {
  std::vector<std::pair<double, Pose>> candidates;
  const auto try_vote = [&](const Vote& vote, const Points& points) {
    const Eigen::Vector3d x = (points.col(2) - points.col(0)).normalized();
    const Eigen::Vector3d z = (points.col(2) - points.col(0)).cross(points.col(1) - points.col(0)).normalized();
    Pose T_brain_slice = Pose::Identity();
    T_brain_slice.linear().col(0) = x;
    T_brain_slice.linear().col(1) = z.cross(x);
    T_brain_slice.linear().col(2) = z;
    T_brain_slice.translation() = points.col(1);
    if (!is_rigid(T_brain_slice, 1e-6)) return;  // three points on a line span no plane
    const Pose motion = T_brain_slice * vote.T_nominal_slice.inverse();
    candidates.emplace_back(total_cost(votes, motion, has_mirrored, options.robust_mm), motion);
  };
  const std::size_t tried = std::min(votes.size(), static_cast<std::size_t>(options.candidates));
  for (std::size_t i = 0; i < tried; ++i) {
    const Vote& vote = votes[i * votes.size() / tried];
    try_vote(vote, vote.direct);
    if (!has_mirrored) continue;
    try_vote(vote, vote.mirrored);
    try_vote(vote, reflected(vote.mirrored));
  }
  if (candidates.empty()) candidates.emplace_back(0., Pose::Identity());
  std::stable_sort(candidates.begin(), candidates.end(),
                   [](const auto& a, const auto& b) { return a.first < b.first; });
  candidates.resize(std::min(candidates.size(), static_cast<std::size_t>(options.refined)));
  std::pair<double, Pose> best = candidates.front();
  best.first = std::numeric_limits<double>::infinity();
  for (const auto& candidate : candidates) {
    const Pose motion = refine(votes, candidate.second, has_mirrored, 0., options);
    const double value = total_cost(votes, motion, has_mirrored, options.robust_mm);
    if (value < best.first) best = {value, motion};
  }
  return best.second;
}

void require(bool condition, const std::string& message) {
  if (!condition) throw std::invalid_argument("pose_consensus: " + message);
}

/// @throws std::invalid_argument naming what does not fit
std::vector<Vote> checked_votes(const PoseVotes& votes, const ConsensusOptions& options) {
  require(options.robust_mm > 0. && std::isfinite(options.robust_mm), "robust_mm must be positive");
  require(options.candidates > 0, "candidates must be positive");
  require(options.refined > 0, "refined must be positive");
  require(options.iterations > 0, "iterations must be positive");
  require(std::isfinite(options.stack_prior), "stack_prior must be finite");
  require(options.views >= 1 && options.views <= 100, "views must be 1 to 100");
  require(options.motion_cost > 0. && std::isfinite(options.motion_cost), "motion_cost must be positive");
  require(votes.direct.defined() && votes.direct.dim() == 2 && votes.direct.size(1) == 9, "direct must be n x 9");
  const std::int64_t n = votes.direct.size(0);
  const bool has_mirrored = votes.mirrored.defined();
  require(!has_mirrored || votes.mirrored.sizes() == votes.direct.sizes(), "mirrored must be n x 9");
  require(!votes.scale.defined() || (votes.scale.dim() == 1 && votes.scale.size(0) == n), "scale must have n values");
  require(votes.stack.defined() && votes.stack.dim() == 1 && votes.stack.size(0) == n &&
              votes.stack.scalar_type() == torch::kInt64,
          "stack must have n values, int64");
  require(votes.nominal.defined() && votes.nominal.dim() == 3 && votes.nominal.size(0) == n,
          "nominal must be n x 3 x 4");
  for (const torch::Tensor& tensor : {votes.direct, votes.mirrored, votes.scale, votes.nominal}) {
    require(!tensor.defined() || tensor.isfinite().all().item<bool>(), "a vote is not finite");
  }

  const torch::Tensor nominal = votes.nominal.to(torch::kFloat64);
  const torch::Tensor nominal_points = anchor_points_from_matrix(nominal, votes.frame).contiguous();
  const torch::Tensor direct = votes.direct.to(torch::kFloat64).contiguous();
  const torch::Tensor mirrored = has_mirrored ? votes.mirrored.to(torch::kFloat64).contiguous() : direct;
  std::vector<Vote> all(static_cast<std::size_t>(n));
  for (std::int64_t i = 0; i < n; ++i) {
    Vote& vote = all[static_cast<std::size_t>(i)];
    vote.nominal = Eigen::Map<const Points>(nominal_points.data_ptr<double>() + 9 * i);
    vote.direct = Eigen::Map<const Points>(direct.data_ptr<double>() + 9 * i);
    vote.mirrored = Eigen::Map<const Points>(mirrored.data_ptr<double>() + 9 * i);
    vote.T_nominal_slice = pose_from_tensor(votes.nominal[i]);
    if (votes.scale.defined()) {
      const double ratio = static_cast<double>(votes.scale[i].item<float>()) / options.robust_mm;
      vote.weight = 1. / (0.01 + ratio * ratio);
    }
  }
  return all;
}

/// Slices that the votes are of, each the same number of times.
std::size_t slices_of(const std::vector<Vote>& votes, const torch::Tensor& motions) {
  require(motions.defined() && motions.dim() == 3 && motions.size(0) > 0 &&
              votes.size() % static_cast<std::size_t>(motions.size(0)) == 0,
          "motions must be n x 3 x 4, one per slice");
  return static_cast<std::size_t>(motions.size(0));
}

/// Half the weighted squared distance of points, in the six numbers of motion() that moves `from`.
void add_points(const Points& from, const Points& to, double weight, SliceTerms* terms) {
  for (int point = 0; point < 3; ++point) {
    const Eigen::Vector3d x = from.col(point), difference = x - to.col(point);
    Eigen::Matrix<double, 3, 6> jacobian;
    jacobian << 0., x.z(), -x.y(), 1., 0., 0., -x.z(), 0., x.x(), 0., 1., 0., x.y(), -x.x(), 0., 0., 0., 1.;
    terms->hessian += weight * jacobian.transpose() * jacobian;
    terms->gradient += weight * jacobian.transpose() * difference;
  }
}

}  // namespace

torch::Tensor pose_consensus(const PoseVotes& votes, const ConsensusOptions& options) {
  const std::vector<Vote> all = checked_votes(votes, options);
  const std::int64_t n = votes.direct.size(0);
  const bool has_mirrored = votes.mirrored.defined();
  const torch::Tensor stack = votes.stack.contiguous();
  std::map<std::int64_t, std::vector<std::int64_t>> stacks;
  for (std::int64_t i = 0; i < n; ++i) stacks[stack.data_ptr<std::int64_t>()[i]].push_back(i);
  std::vector<Pose> motions(static_cast<std::size_t>(n), Pose::Identity());
  const auto members = [&all](const std::vector<std::int64_t>& slices) {
    std::vector<Vote> result;
    for (const std::int64_t i : slices) result.push_back(all[static_cast<std::size_t>(i)]);
    return result;
  };
  if (votes.common_frame && n > 0) {
    const Pose common = solve(all, has_mirrored, options);
    std::fill(motions.begin(), motions.end(), common);
  }
  for (const auto& [number, slices] : stacks) {
    const std::vector<Vote> own = members(slices);
    Pose motion = motions[static_cast<std::size_t>(slices.front())];
    if (!votes.common_frame) {
      motion = solve(own, has_mirrored, options);
    } else if (options.stack_prior >= 0.) {
      double weight = 0.;  // of an average slice
      for (const Vote& vote : own) weight += vote.weight / static_cast<double>(own.size());
      motion = refine(own, motion, has_mirrored, options.stack_prior * weight, options);
    }
    for (const std::int64_t i : slices) motions[static_cast<std::size_t>(i)] = motion;
  }

  return tensor_from_poses(motions);
}

torch::Tensor trajectory_consensus(const PoseVotes& votes, const torch::Tensor& start,
                                   const ConsensusOptions& options) {
  // Reweighted least squares; both losses begin wide, so that what begins as an outlier may still pull.
  constexpr int kSteps = 30, kSettled = 16;
  constexpr double kWideRobust = 4., kRobustFactor = 0.8;                 // of robust_mm, and from step to step
  constexpr double kWideRestMm = 10., kRestFactor = 0.75, kRestMm = 0.3;  // motions below this are rest
  constexpr double kLeverMm = 40., kLargestStepMm = 20., kSettledMm = 0.05;
  constexpr double kBetweenStacks = 0.3;  // of motion_cost: there is more time
  const std::vector<Vote> all = checked_votes(votes, options);
  const std::size_t n = slices_of(all, start);
  const bool has_mirrored = votes.mirrored.defined();
  const double share = static_cast<double>(n) / static_cast<double>(all.size()) / (has_mirrored ? 2. : 1.);
  std::vector<std::int64_t> stack(n);
  for (std::size_t i = 0; i < n; ++i) stack[i] = votes.stack[static_cast<std::int64_t>(i)].item<std::int64_t>();

  std::vector<Pose> motions = poses_from_tensor(start);
  double robust = kWideRobust * options.robust_mm, rest_mm = kWideRestMm;
  for (int step = 0; step < kSteps; ++step) {
    std::vector<SliceTerms> terms(n);
    for (std::size_t k = 0; k < all.size(); ++k) {
      const Vote& vote = all[k];
      const Points here = moved(motions[k % n], vote.nominal);
      const double scale =
          votes.scale.defined() ? votes.scale[static_cast<std::int64_t>(k)].item<float>() : options.robust_mm;
      // Mean over the three points, as the scale is.
      const double weight = share / (3. * scale * scale);
      const auto add = [&](const Points& to) {
        add_points(here, to, weight * influence(squared_distance(here, to), robust), &terms[k % n]);
      };
      add(vote.direct);
      if (!has_mirrored) continue;
      const Points other = reflected(vote.mirrored);
      add(squared_distance(here, vote.mirrored) <= squared_distance(here, other) ? vote.mirrored : other);
    }
    std::vector<double> spread_mm;  // quadratic bounds of the total variation
    for (std::size_t i = 0; i + 1 < n; ++i) {
      const bool within = stack[i] == stack[i + 1];
      const double size = motion_size(twist_of(motions[i + 1] * motions[i].inverse()), kLeverMm);
      const double cost = options.motion_cost * (within ? 1. : kBetweenStacks);
      spread_mm.push_back(within || votes.common_frame ? std::sqrt(std::hypot(size, rest_mm) / cost)
                                                       : std::numeric_limits<double>::infinity());
    }
    WalkOptions walk;
    walk.lever_mm = kLeverMm;
    walk.jump_mm = std::numeric_limits<double>::infinity();  // the bounds are all the robustness there is
    double largest = 0.;
    const std::vector<Vector6d> steps = solve_trajectory(terms, motions, spread_mm, walk);
    for (std::size_t i = 0; i < n; ++i) {
      const double size = motion_size(steps[i], kLeverMm);
      motions[i] = motion(size > kLargestStepMm ? Vector6d(steps[i] * (kLargestStepMm / size)) : steps[i]) * motions[i];
      largest = std::max(largest, size);
    }
    robust = std::max(options.robust_mm, kRobustFactor * robust);
    rest_mm = std::max(kRestMm, kRestFactor * rest_mm);
    if (step >= kSettled && largest < kSettledMm) break;
  }
  return tensor_from_poses(motions);
}

double vote_agreement(const PoseVotes& votes, const torch::Tensor& motions, const ConsensusOptions& options) {
  const std::vector<Vote> all = checked_votes(votes, options);
  const std::size_t n = slices_of(all, motions);
  const std::vector<Pose> poses = poses_from_tensor(motions);
  const double squared = options.robust_mm * options.robust_mm;
  std::size_t asked = 0, agree = 0;
  for (std::size_t k = 0; k < all.size(); ++k) {
    const Points here = moved(poses[k % n], all[k].nominal);
    agree += squared_distance(here, all[k].direct) < squared;
    ++asked;
    if (!votes.mirrored.defined()) continue;
    agree +=
        std::min(squared_distance(here, all[k].mirrored), squared_distance(here, reflected(all[k].mirrored))) < squared;
    ++asked;
  }
  return static_cast<double>(agree) / static_cast<double>(asked);
}

}  // namespace svort
