#include "scan_pieces.h"

#include <torch/types.h>

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <map>

#include "../acquisition/parallel.h"
#include "rotation_grid.h"
#include "trajectory.h"

namespace svort {
namespace {

constexpr double kVolumeMm = 130.;  // edge: a head at term and some of its motion
constexpr double kVoxelBlur = 1.;   // fills the gaps between the slices of few pieces, voxels
constexpr double kLeastShare = 0.02;
constexpr int kSweeps = 4;
constexpr int kRotations = 6300;  // all over SO(3), 13 degrees apart; 800 of them within reach
constexpr double kReachRad = 1.4;
constexpr std::size_t kRefined = 6;
constexpr double kDistinctRad = 0.35;
// A piece goes elsewhere only if it fits better there by this: not for noise.
constexpr double kMargin = 0.01;
constexpr double kSliceMargin = 0.02;  // the same for a slice by itself
constexpr double kLeverMm = 40., kLargestStepMm = 6., kSmallStepMm = 0.2;
constexpr int kSteps = 8;
constexpr double kImageScale = 0.12;  // as RefinementOptions

std::vector<float> values_of(const torch::Tensor& volume) {
  return std::vector<float>(volume.data_ptr<float>(), volume.data_ptr<float>() + volume.numel());
}

/// Pearson's correlation from sums.
class Correlation {
 public:
  void add(double a, double b) {
    ++count_;
    a_ += a;
    b_ += b;
    aa_ += a * a;
    bb_ += b * b;
    ab_ += a * b;
  }
  double value() const {
    const double variances = (count_ * aa_ - a_ * a_) * (count_ * bb_ - b_ * b_);
    return variances > 0. ? (count_ * ab_ - a_ * b_) / std::sqrt(variances) : -1.;
  }

 private:
  double count_ = 0., a_ = 0., b_ = 0., aa_ = 0., bb_ = 0., ab_ = 0.;
};

double angle_of(const Pose& pose) { return Eigen::AngleAxisd(pose.linear()).angle(); }

std::vector<Eigen::Quaterniond> rotations_within_reach() {
  std::vector<Eigen::Quaterniond> rotations = spread_rotations(kRotations);
  const auto beyond = [](const Eigen::Quaterniond& rotation) {
    return rotation.angularDistance(Eigen::Quaterniond::Identity()) > kReachRad;
  };
  rotations.erase(std::remove_if(rotations.begin(), rotations.end(), beyond), rotations.end());
  return rotations;
}

}  // namespace

ScanPieces::ScanPieces(const RegistrationInput& input, int slices_per_piece, double pixel_mm, double blur_mm)
    : input_(input), level_(make_level(input, pixel_mm, blur_mm, SliceContent::outline)) {
  std::map<int, std::vector<std::size_t>> stacks;
  for (std::size_t i = 0; i < input.count(); ++i)
    if (!level_.points[i].value.empty()) stacks[input.stack[i]].push_back(i);
  for (const auto& [stack, slices] : stacks) {
    const auto count = static_cast<std::size_t>(
        std::max(1., std::round(static_cast<double>(slices.size()) / static_cast<double>(slices_per_piece))));
    const std::size_t first = pieces_.size();
    pieces_.resize(first + count);
    for (std::size_t i = 0; i < slices.size(); ++i) pieces_[first + i * count / slices.size()].push_back(slices[i]);
  }
  size_ = static_cast<int>(std::ceil(kVolumeMm / level_.pixel_mm)) + 6;
}

ScanPieces::Seen ScanPieces::see(std::size_t piece, const std::vector<Pose>& poses) const {
  std::vector<std::int64_t> index;
  std::vector<Pose> of_piece;
  std::vector<double> thickness_mm;
  for (const std::size_t i : pieces_[piece]) {
    index.push_back(static_cast<std::int64_t>(i));
    of_piece.push_back(poses[i]);
    thickness_mm.push_back(input_.thickness_mm[i]);
  }
  const torch::Tensor select = torch::tensor(index, torch::kInt64);
  const SliceAcquisition acquisition = cube_acquisition(level_.masks.index_select(0, select), of_piece, thickness_mm,
                                                        level_.pixel_mm, size_, level_.pixel_mm);
  return {weighted_volume(level_.slices.index_select(0, select), acquisition, std::vector<double>(index.size(), 1.))};
}

SampledVolume ScanPieces::others(const std::vector<Seen>& seen, std::size_t piece, Eigen::Vector3d* centre) const {
  torch::Tensor sums = torch::zeros({size_, size_, size_}), support = torch::zeros_like(sums);
  for (std::size_t other = 0; other < seen.size(); ++other) {
    if (other == piece) continue;
    const double weight = std::pow(std::max(0.05, seen[other].correlation), 4.);
    sums.add_(seen[other].volume.sums, weight);
    support.add_(seen[other].volume.support, weight);
  }
  std::vector<float> values = blurred(values_of(sums), size_, kVoxelBlur);
  const std::vector<float> seen_by = blurred(values_of(support), size_, kVoxelBlur);
  // Fades where next to nothing was seen.
  const float least =
      std::max(1e-12F, static_cast<float>(kLeastShare) * *std::max_element(seen_by.begin(), seen_by.end()));
  Eigen::Vector3d sum = Eigen::Vector3d::Zero();
  double brightness = 0.;
  std::size_t at = 0;
  for (int z = 0; z < size_; ++z)
    for (int y = 0; y < size_; ++y)
      for (int x = 0; x < size_; ++x, ++at) {
        values[at] /= std::max(seen_by[at], least);
        sum += static_cast<double>(values[at]) * Eigen::Vector3d(x, y, z);
        brightness += static_cast<double>(values[at]);
      }
  *centre = Eigen::Vector3d::Zero();
  if (brightness > 0.) *centre = (sum / brightness - Eigen::Vector3d::Constant(0.5 * (size_ - 1))) * level_.pixel_mm;
  return SampledVolume(std::move(values), size_, level_.pixel_mm);
}

Eigen::Vector3d ScanPieces::centre_of(std::size_t piece, const std::vector<Pose>& poses) const {
  Eigen::Vector3d sum = Eigen::Vector3d::Zero();
  double brightness = 0.;
  for (const std::size_t i : pieces_[piece]) {
    const SlicePoints& points = level_.points[i];
    for (std::size_t k = 0; k < points.value.size(); ++k) {
      const Eigen::Vector2d p = points.position[k].cast<double>();
      sum += static_cast<double>(points.value[k]) * (poses[i] * Eigen::Vector3d(p.x(), p.y(), 0.));
      brightness += static_cast<double>(points.value[k]);
    }
  }
  return brightness > 0. ? Eigen::Vector3d(sum / brightness) : Eigen::Vector3d(Eigen::Vector3d::Zero());
}

double ScanPieces::correlation(const std::vector<std::size_t>& slices, const std::vector<Pose>& poses,
                               const Pose& motion, const SampledVolume& volume, std::size_t stride) const {
  Correlation correlation;
  for (const std::size_t i : slices) {
    const Eigen::Affine3f pose = (motion * poses[i]).cast<float>();
    const SlicePoints& points = level_.points[i];
    for (std::size_t k = 0; k < points.value.size(); k += stride) {
      const Eigen::Vector3f p(points.position[k].x(), points.position[k].y(), 0.F);
      correlation.add(static_cast<double>(volume.at(pose * p).value), static_cast<double>(points.value[k]));
    }
  }
  return correlation.value();
}

Pose ScanPieces::refined(std::size_t piece, const std::vector<Pose>& poses, Pose motion_of_piece,
                         const SampledVolume& volume) const {
  // The blur in plane is far wider than a slice is thick: its profile need not be sampled.
  const ProfileTaps taps = profile_taps(0.);
  SliceTermOptions start;
  start.image_scale = kImageScale * level_.bright;
  start.offset_spread = 0.1 * level_.bright;
  std::vector<SliceTermOptions> options(pieces_[piece].size(), start);
  for (int step = 0; step < kSteps; ++step) {
    Matrix6d hessian = Matrix6d::Zero();
    Vector6d gradient = Vector6d::Zero();
    for (std::size_t j = 0; j < options.size(); ++j) {
      const std::size_t i = pieces_[piece][j];
      const SliceTerms terms = slice_terms(level_.points[i], taps, volume, motion_of_piece * poses[i], options[j]);
      options[j].gain = terms.gain;
      options[j].offset = terms.offset;
      hessian += terms.hessian;
      gradient += terms.gradient;
    }
    hessian.diagonal() *= 1. + 1e-3;
    hessian.diagonal().array() += 1e-9;
    Vector6d change = -hessian.ldlt().solve(gradient);
    const double size_mm = motion_size(change, kLeverMm);
    if (size_mm > kLargestStepMm) change *= kLargestStepMm / size_mm;
    motion_of_piece = motion(change) * motion_of_piece;
    if (size_mm < kSmallStepMm) break;
  }
  return motion_of_piece;
}

Pose ScanPieces::head(std::size_t slice, const std::vector<Pose>& poses) const {
  return poses[slice] * input_.T_world_slice[slice].inverse();
}

void ScanPieces::share_out(std::size_t piece, std::vector<Seen>* seen, std::vector<Pose>* poses) const {
  Eigen::Vector3d centre;
  const SampledVolume volume = others(*seen, piece, &centre);
  std::vector<Pose> heads;
  if (piece > 0) heads.push_back(head(pieces_[piece - 1].front(), *poses));
  if (piece + 1 < pieces_.size()) heads.push_back(head(pieces_[piece + 1].back(), *poses));
  bool moved = false;
  for (const std::size_t i : pieces_[piece]) {
    const Pose here = head(i, *poses);
    double best = correlation({i}, *poses, Pose::Identity(), volume, 1) + kSliceMargin;
    Pose motion_of_slice = Pose::Identity();
    for (const Pose& other : heads) {
      const Pose there = other * here.inverse();
      const double fits = correlation({i}, *poses, there, volume, 1);
      if (fits <= best) continue;
      best = fits;
      motion_of_slice = there;
      moved = true;
    }
    (*poses)[i] = motion_of_slice * (*poses)[i];
  }
  if (!moved) return;
  const double before = (*seen)[piece].correlation;
  (*seen)[piece] = see(piece, *poses);
  (*seen)[piece].correlation = before;
}

void ScanPieces::place(std::size_t piece, std::vector<Seen>* seen, std::vector<Pose>* poses) const {
  Eigen::Vector3d centre;
  const SampledVolume volume = others(*seen, piece, &centre);
  std::vector<Pose> tried;
  const Pose here = head(pieces_[piece].front(), *poses);
  if (piece > 0) tried.push_back(head(pieces_[piece - 1].front(), *poses) * here.inverse());
  if (piece + 1 < pieces_.size()) tried.push_back(head(pieces_[piece + 1].front(), *poses) * here.inverse());
  static const std::vector<Eigen::Quaterniond> turns = rotations_within_reach();
  const Eigen::Vector3d own_centre = centre_of(piece, *poses);
  for (const Eigen::Quaterniond& rotation : turns) {
    Pose turn = Pose::Identity();
    turn.linear() = rotation.toRotationMatrix();
    turn.translation() = centre - turn.linear() * own_centre;
    tried.push_back(turn);
  }
  struct Candidate {
    Pose motion;
    double correlation;
  };
  std::vector<Candidate> candidates(tried.size());
  parallel_tasks(static_cast<std::int64_t>(tried.size()), [&](std::int64_t task) {
    const auto k = static_cast<std::size_t>(task);
    candidates[k] = {tried[k], correlation(pieces_[piece], *poses, tried[k], volume, 2)};
  });
  std::stable_sort(candidates.begin(), candidates.end(),
                   [](const Candidate& a, const Candidate& b) { return a.correlation > b.correlation; });
  std::vector<Candidate> chosen = {{Pose::Identity(), -1.}};  // where it is comes first
  for (const Candidate& candidate : candidates) {
    if (chosen.size() > kRefined) break;
    const bool distinct = std::all_of(chosen.begin() + 1, chosen.end(), [&](const Candidate& other) {
      return angle_of(candidate.motion * other.motion.inverse()) > kDistinctRad;
    });
    if (distinct) chosen.push_back(candidate);
  }
  parallel_tasks(static_cast<std::int64_t>(chosen.size()), [&](std::int64_t task) {
    Candidate& candidate = chosen[static_cast<std::size_t>(task)];
    candidate.motion = refined(piece, *poses, candidate.motion, volume);
    candidate.correlation = correlation(pieces_[piece], *poses, candidate.motion, volume, 1);
  });
  const Candidate* best = &chosen.front();
  for (const Candidate& candidate : chosen)
    if (candidate.correlation > std::max(best->correlation, chosen.front().correlation + kMargin)) best = &candidate;
  for (const std::size_t i : pieces_[piece]) (*poses)[i] = best->motion * (*poses)[i];
  (*seen)[piece] = see(piece, *poses);
  (*seen)[piece].correlation = best->correlation;
}

std::vector<Pose> ScanPieces::centred(std::vector<Pose> poses) const {
  Eigen::Vector3d sum = Eigen::Vector3d::Zero();
  for (std::size_t piece = 0; piece < pieces_.size(); ++piece)
    sum += centre_of(piece, poses) / static_cast<double>(pieces_.size());
  for (Pose& pose : poses) pose.translation() -= sum;
  return poses;
}

std::vector<Pose> ScanPieces::search(std::vector<Pose> poses) const {
  const torch::NoGradGuard no_grad;
  if (pieces_.size() < 2) return poses;
  const std::vector<Pose> given = poses;
  poses = centred(std::move(poses));
  const Eigen::Vector3d shift = given.front().translation() - poses.front().translation();
  std::vector<Seen> seen;
  for (std::size_t piece = 0; piece < pieces_.size(); ++piece) seen.push_back(see(piece, poses));
  for (int sweep = 0; sweep < kSweeps; ++sweep) {
    for (std::size_t piece = 0; piece < pieces_.size(); ++piece) place(piece, &seen, &poses);
    for (std::size_t piece = 0; piece < pieces_.size(); ++piece) share_out(piece, &seen, &poses);
  }
  // Slices without brain go along with those before them.
  std::size_t last = pieces_.front().front();
  for (std::size_t i = 0; i < poses.size(); ++i) {
    if (level_.points[i].value.empty())
      poses[i] = poses[last] * given[last].inverse() * given[i];
    else
      last = i;
  }
  for (Pose& pose : poses) pose.translation() += shift;
  return poses;
}

double ScanPieces::agreement(const std::vector<Pose>& given) const {
  const torch::NoGradGuard no_grad;
  if (pieces_.size() < 2) return -1.;
  const std::vector<Pose> poses = centred(given);
  std::vector<Seen> seen;
  for (std::size_t piece = 0; piece < pieces_.size(); ++piece) seen.push_back(see(piece, poses));
  double sum = 0., pixels = 0.;
  for (std::size_t piece = 0; piece < pieces_.size(); ++piece) {
    Eigen::Vector3d centre;
    const SampledVolume volume = others(seen, piece, &centre);
    double count = 0.;
    for (const std::size_t i : pieces_[piece]) count += static_cast<double>(level_.points[i].value.size());
    sum += count * correlation(pieces_[piece], poses, Pose::Identity(), volume, 1);
    pixels += count;
  }
  return sum / pixels;
}

}  // namespace svort
