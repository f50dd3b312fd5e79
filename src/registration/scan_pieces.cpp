#include "scan_pieces.h"

#include <torch/types.h>

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <map>

namespace svort {
namespace {

constexpr double kVolumeMm = 130.;  // edge: a head at term and some of its motion
constexpr int kSweeps = 4;
// A piece goes elsewhere only if it fits better there by this: not for noise.
constexpr double kMargin = 0.01;
constexpr double kSliceMargin = 0.02;  // the same for a slice by itself

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
  WeightedVolume all{torch::zeros({size_, size_, size_}), torch::zeros({size_, size_, size_})};
  for (std::size_t other = 0; other < seen.size(); ++other) {
    if (other == piece) continue;
    const double weight = std::pow(std::max(0.05, seen[other].correlation), 4.);
    all.sums.add_(seen[other].volume.sums, weight);
    all.support.add_(seen[other].volume.support, weight);
  }
  return faded_volume(all, level_.pixel_mm, centre);
}

Piece ScanPieces::piece_of(const std::vector<std::size_t>& slices, const std::vector<Pose>& poses) const {
  Piece piece;
  piece.bright = level_.bright;
  for (const std::size_t i : slices) {
    piece.points.push_back(&level_.points[i]);
    piece.poses.push_back(poses[i]);
  }
  return piece;
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
    const Piece alone = piece_of({i}, *poses);
    double best = piece_correlation(alone, Pose::Identity(), volume, 1) + kSliceMargin;
    Pose motion_of_slice = Pose::Identity();
    for (const Pose& other : heads) {
      const Pose there = other * here.inverse();
      const double fits = piece_correlation(alone, there, volume, 1);
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
  const PlacedPiece best =
      place_piece(piece_of(pieces_[piece], *poses), volume, centre, tried, kLargestReachRad, kMargin).best;
  for (const std::size_t i : pieces_[piece]) (*poses)[i] = best.motion * (*poses)[i];
  (*seen)[piece] = see(piece, *poses);
  (*seen)[piece].correlation = best.correlation;
}

std::vector<Pose> ScanPieces::centred(std::vector<Pose> poses) const {
  Eigen::Vector3d sum = Eigen::Vector3d::Zero();
  for (std::size_t piece = 0; piece < pieces_.size(); ++piece)
    sum += piece_centre(piece_of(pieces_[piece], poses)) / static_cast<double>(pieces_.size());
  for (Pose& pose : poses) pose.translation() -= sum;
  return poses;
}

std::vector<Pose> ScanPieces::search(std::vector<Pose> poses, const std::atomic<bool>* stop) const {
  const torch::NoGradGuard no_grad;
  if (pieces_.size() < 2) return poses;
  const std::vector<Pose> given = poses;
  poses = centred(std::move(poses));
  const Eigen::Vector3d shift = given.front().translation() - poses.front().translation();
  std::vector<Seen> seen;
  for (std::size_t piece = 0; piece < pieces_.size(); ++piece) seen.push_back(see(piece, poses));
  const auto goes_on = [&](std::size_t piece) { return piece < pieces_.size() && !(stop && stop->load()); };
  for (int sweep = 0; sweep < kSweeps; ++sweep) {
    for (std::size_t piece = 0; goes_on(piece); ++piece) place(piece, &seen, &poses);
    for (std::size_t piece = 0; goes_on(piece); ++piece) share_out(piece, &seen, &poses);
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
    sum += count * piece_correlation(piece_of(pieces_[piece], poses), Pose::Identity(), volume, 1);
    pixels += count;
  }
  return sum / pixels;
}

}  // namespace svort
