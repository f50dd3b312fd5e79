#include "svort_ros/decision/slice_quality.h"

#include <algorithm>
#include <cmath>
#include <limits>
#include <set>

#include "checks.h"
#include "svort_ros/decision/motion_monitor.h"

namespace svort {
namespace {

constexpr double kTiny = std::numeric_limits<double>::min();
constexpr double kNaN = std::numeric_limits<double>::quiet_NaN();
constexpr double kBlockMm = 3.;             // about a slice's thickness: finer would only add noise
constexpr double kVoidShare = 0.6;          // a block is void below this share of what is expected there
constexpr double kExpectedQuantile = 0.75;  // of the ratios: the part of a slice without void, if that is the larger
constexpr double kBrightEnough = 0.2;       // of the scan's scale; darker places say nothing about a loss of signal
constexpr int kNeighbours = 2;              // slices of the stack on either side
constexpr std::size_t kFewestBlocks = 8;
constexpr double kJumpMm = 2.;
constexpr double kLeastNoise = 1e-3;  // of the scan's scale: less does not matter
constexpr double kUsualSpread = 2.;   // median absolute deviations: what a scan's own anatomy and contrast explain

double median(std::vector<double> values) {
  if (values.empty()) return kNaN;
  const auto middle = values.begin() + static_cast<std::ptrdiff_t>(values.size() / 2);
  std::nth_element(values.begin(), middle, values.end());
  return *middle;
}

double quantile(std::vector<double> values, double q) {
  const auto rank = values.begin() + static_cast<std::ptrdiff_t>(q * static_cast<double>(values.size() - 1));
  std::nth_element(values.begin(), rank, values.end());
  return *rank;
}

/// By how much each value is above what is usual in the scan; 0 within that. Damage of up to half of the slices leaves
/// the measure as it is.
std::vector<double> above_usual(const std::vector<double>& values) {
  const double middle = median(values);
  std::vector<double> deviations;
  deviations.reserve(values.size());
  for (const double value : values) deviations.push_back(std::abs(value - middle));
  const double limit = middle + kUsualSpread * median(deviations);
  std::vector<double> above;
  above.reserve(values.size());
  for (const double value : values) above.push_back(std::max(0., value - limit));
  return above;
}

/// Trilinear; NaN outside of the grid.
double sample(const Volume& volume, const Eigen::Vector3d& index) {
  const Eigen::Vector3d floor = index.array().floor();
  const Eigen::Vector3i low = floor.cast<int>();
  if ((low.array() < 0).any() || (low.array() + 1 >= volume.grid.size.array()).any()) return kNaN;
  const Eigen::Vector3d f = index - floor;
  const float* v = volume.values.data() + volume.grid.offset(low.x(), low.y(), low.z());
  const auto row = static_cast<std::size_t>(volume.grid.size.x());
  const std::size_t plane = row * static_cast<std::size_t>(volume.grid.size.y());
  const auto mix = [](double a, double b, double t) { return a + t * (b - a); };
  const auto line = [&](std::size_t offset) { return mix(double(v[offset]), double(v[offset + 1]), f.x()); };
  return mix(mix(line(0), line(row), f.y()), mix(line(plane), line(plane + row), f.y()), f.z());
}

/// How a slice's blocks compare with what is expected of them: ratios where both are bright.
struct Loss {
  double void_share = kNaN;  ///< share of blocks far below the slice's own usual ratio
  double gain = kNaN;        ///< that usual ratio
};
Loss loss_of(const std::vector<double>& ratios) {
  Loss loss;
  if (ratios.size() < kFewestBlocks) return loss;
  loss.gain = quantile(ratios, kExpectedQuantile);
  std::size_t dark = 0;
  for (const double ratio : ratios) dark += ratio < kVoidShare * loss.gain ? 1 : 0;
  loss.void_share = static_cast<double>(dark) / static_cast<double>(ratios.size());
  return loss;
}

/// Against the volume: three planes through the slice's thickness stand for its profile.
Loss loss_against(const SliceBlocks& blocks, const Pose& T_brain_slice, double thickness_mm, double scale,
                  const Volume& volume) {
  std::vector<double> ratios;
  const Eigen::Vector3d half_spread = T_brain_slice.linear().col(2) * (thickness_mm / 3.);
  for (int row = 0; row < blocks.size; ++row)
    for (int column = 0; column < blocks.size; ++column) {
      const auto at = static_cast<std::size_t>(row * blocks.size + column);
      if (!blocks.brain[at]) continue;
      const Eigen::Vector3d place = T_brain_slice * blocks.centre(column, row);
      double expected = 0.;
      for (const double side : {-1., 0., 1.})
        expected += sample(volume, volume.grid.index(place + side * half_spread)) / 3.;
      if (!(expected > kBrightEnough)) continue;
      ratios.push_back(static_cast<double>(blocks.mean[at]) / scale / expected);
    }
  return loss_of(ratios);
}

/// Against the mean of its neighbours in the stack, where the scanner says that they lie.
Loss loss_against(const SliceBlocks& blocks, const SliceInfo& info, double scale,
                  const std::vector<std::pair<const SliceBlocks*, const SliceInfo*>>& neighbours) {
  std::vector<Pose> T_neighbour_slice;
  for (const auto& neighbour : neighbours)
    T_neighbour_slice.push_back(neighbour.second->T_scanner_slice.inverse() * info.T_scanner_slice);
  std::vector<double> ratios;
  for (int row = 0; row < blocks.size; ++row)
    for (int column = 0; column < blocks.size; ++column) {
      const auto at = static_cast<std::size_t>(row * blocks.size + column);
      if (!blocks.brain[at]) continue;
      double sum = 0.;
      int count = 0;
      for (std::size_t k = 0; k < neighbours.size(); ++k) {
        const SliceBlocks& other = *neighbours[k].first;
        const int place = other.at(T_neighbour_slice[k] * blocks.centre(column, row));
        if (place < 0 || !other.brain[static_cast<std::size_t>(place)]) continue;
        sum += static_cast<double>(other.mean[static_cast<std::size_t>(place)]);
        ++count;
      }
      if (count == 0 || !(sum / count > kBrightEnough * scale)) continue;
      ratios.push_back(static_cast<double>(blocks.mean[at]) / (sum / count));
    }
  return loss_of(ratios);
}

double loss_log(double ratio) { return std::isfinite(ratio) && ratio < 1. ? -std::log(std::max(ratio, 1e-3)) : 0.; }

double or_typical(double value, double typical) { return std::isfinite(value) ? value : typical; }

/// What a feature that is not known yet counts as: the median of undamaged slices.
constexpr QualityFeatures kTypical{0.75, 2.6, 0., 0., 0., 0., 0.02, 0.2};

double sigmoid(double logit) { return 1. / (1. + std::exp(-logit)); }

std::array<double, QualityFeatures::kCount> coefficients(const SliceQualityOptions& o) {
  return {o.weight, o.similarity, o.void_volume, o.dark_volume, o.void_image, o.dark_image, o.noise, o.jump};
}

constexpr std::array<QualityReason, QualityFeatures::kCount> kReasons = {
    QualityReason::outlier,     QualityReason::low_similarity, QualityReason::signal_void, QualityReason::dark,
    QualityReason::signal_void, QualityReason::dark,           QualityReason::noise,       QualityReason::pose_jump};

std::vector<QualityReason> reasons_of(const SliceEstimate& slice, const QualityFeatures& features,
                                      const SliceQualityOptions& options) {
  std::set<QualityReason> reasons;
  if (slice.weight <= 0. || slice.status == PoseStatus::outlier) reasons.insert(QualityReason::outlier);
  const auto values = features.values(), typical = kTypical.values(), factors = coefficients(options);
  for (std::size_t i = 1; i < values.size(); ++i)
    if (factors[i] * (or_typical(values[i], typical[i]) - typical[i]) < -options.reason_logit)
      reasons.insert(kReasons[i]);
  return {reasons.begin(), reasons.end()};
}

}  // namespace

const char* to_string(QualityReason reason) {
  switch (reason) {
    case QualityReason::outlier:
      return "outlier";
    case QualityReason::low_similarity:
      return "low_similarity";
    case QualityReason::signal_void:
      return "signal_void";
    case QualityReason::dark:
      return "dark";
    case QualityReason::noise:
      return "noise";
    case QualityReason::pose_jump:
      return "pose_jump";
  }
  return "unknown";
}

const std::array<const char*, QualityFeatures::kCount>& QualityFeatures::names() {
  static const std::array<const char*, kCount> all = {"weight",     "similarity", "void_volume", "dark_volume",
                                                      "void_image", "dark_image", "noise",       "jump"};
  return all;
}

void validate(const SliceQualityOptions& options) {
  const OptionCheck check("decision.quality.");
  check(options.accept >= 0. && options.accept <= 1., "accept", options.accept, "from 0 to 1");
  check(options.reason_logit >= 0. && std::isfinite(options.reason_logit), "reason_logit", options.reason_logit,
        "zero or positive");
  SliceQualityOptions copy = options;
  copy.visit([&check](const std::string& name, double value, const char*) {
    check(std::isfinite(value), name.c_str(), value, "finite");
  });
}

const QualityFeatures& typical_quality() {
  static const QualityFeatures typical = kTypical;
  return typical;
}

double quality_score(const QualityFeatures& features, const SliceQualityOptions& options) {
  const auto values = features.values(), typical = kTypical.values(), factors = coefficients(options);
  double logit = options.intercept;
  for (std::size_t i = 0; i < values.size(); ++i) logit += factors[i] * or_typical(values[i], typical[i]);
  return sigmoid(logit);
}

double image_quality_score(const QualityFeatures& f, const SliceQualityOptions& o) {
  return sigmoid(o.image_intercept + o.image_void * f.void_image + o.image_dark * f.dark_image +
                 o.image_noise * f.noise);
}

int SliceBlocks::at(const Eigen::Vector3d& in_slice) const {
  const Eigen::Vector3d p = T_slice_blocks.inverse() * in_slice;
  const double middle = 0.5 * (size - 1);
  const double column = std::round(p.x() / edge_mm + middle), row = std::round(p.y() / edge_mm + middle);
  if (!(column >= 0.) || !(row >= 0.) || column >= size || row >= size) return -1;
  return static_cast<int>(row) * size + static_cast<int>(column);
}

SliceBlocks make_blocks(const PreparedSlice& slice) {
  const int step = std::max(1, static_cast<int>(std::lround(kBlockMm / slice.resolution)));
  SliceBlocks blocks;
  blocks.size = slice.size / step;
  blocks.edge_mm = step * slice.resolution;
  // Blocks begin at pixel 0, so their middle is not the crop's if pixels are left over.
  const double left_over = 0.5 * slice.resolution * (slice.size - blocks.size * step);
  Pose shift = Pose::Identity();
  shift.translation() << -left_over, -left_over, 0.;
  blocks.T_slice_blocks = slice.T_slice_crop * shift;
  const auto pixel = [&](int column, int row) { return static_cast<std::size_t>(row * slice.size + column); };
  for (int row = 0; row < blocks.size; ++row)
    for (int column = 0; column < blocks.size; ++column) {
      double sum = 0.;
      int count = 0;
      for (int y = row * step; y < (row + 1) * step; ++y)
        for (int x = column * step; x < (column + 1) * step; ++x)
          if (slice.mask[pixel(x, y)]) {
            sum += static_cast<double>(slice.pixels[pixel(x, y)]);
            ++count;
          }
      blocks.mean.push_back(count > 0 ? static_cast<float>(sum / count) : 0.F);
      blocks.brain.push_back(2 * count >= step * step ? 1 : 0);
    }
  blocks.brain_mm2 = static_cast<double>(slice.brain_pixels) * slice.resolution * slice.resolution;

  std::vector<double> seconds;  // second differences: anatomy is smooth, noise is not
  double sum = 0.;
  for (int y = 0; y < slice.size; ++y)
    for (int x = 0; x < slice.size; ++x) {
      if (!slice.mask[pixel(x, y)]) continue;
      sum += static_cast<double>(slice.pixels[pixel(x, y)]);
      if (x > 0 && x + 1 < slice.size && slice.mask[pixel(x - 1, y)] && slice.mask[pixel(x + 1, y)])
        seconds.push_back(std::abs(static_cast<double>(slice.pixels[pixel(x - 1, y)]) -
                                   2. * static_cast<double>(slice.pixels[pixel(x, y)]) +
                                   static_cast<double>(slice.pixels[pixel(x + 1, y)])));
      if (y > 0 && y + 1 < slice.size && slice.mask[pixel(x, y - 1)] && slice.mask[pixel(x, y + 1)])
        seconds.push_back(std::abs(static_cast<double>(slice.pixels[pixel(x, y - 1)]) -
                                   2. * static_cast<double>(slice.pixels[pixel(x, y)]) +
                                   static_cast<double>(slice.pixels[pixel(x, y + 1)])));
    }
  if (slice.brain_pixels > 0) blocks.typical = sum / static_cast<double>(slice.brain_pixels);
  if (!seconds.empty()) blocks.noise = median(std::move(seconds));
  return blocks;
}

QualityMonitor::QualityMonitor(const SliceQualityOptions& options) : options_(options) { validate(options); }

void QualityMonitor::set_options(const SliceQualityOptions& options) {
  validate(options);
  options_ = options;
}

void QualityMonitor::clear() {
  cache_.clear();
  first_scores_.clear();
  blocks_.clear();
  slices_.clear();
}

const std::vector<SliceQuality>& QualityMonitor::update(const SliceSequence& sequence, const Estimate& estimate,
                                                        const Volume& volume, double radius_mm) {
  const auto& prepared = sequence.slices();
  if (prepared.size() != estimate.slices.size())
    throw std::invalid_argument("QualityMonitor: " + std::to_string(estimate.slices.size()) + " poses for " +
                                std::to_string(prepared.size()) + " slices");
  const std::size_t count = prepared.size();
  const double scale = sequence.intensity_scale();
  blocks_.clear();
  slices_.assign(count, {});
  std::map<std::pair<int, int>, std::size_t> place;  // stack and index -> which slice
  std::vector<double> log_noises;
  for (std::size_t i = 0; i < count; ++i) {
    const auto key = std::make_pair(prepared[i]->info.stack, prepared[i]->info.index);
    std::shared_ptr<const SliceBlocks>& cached = cache_[key];
    if (!cached) cached = std::make_shared<const SliceBlocks>(make_blocks(*prepared[i]));
    blocks_.push_back(cached);
    place[key] = i;
    log_noises.push_back(std::log(std::max({cached->noise, kLeastNoise * scale, kTiny})));
  }
  const std::vector<double> noises = above_usual(log_noises);

  std::map<int, std::vector<double>> gains;  // against the volume, by stack
  std::vector<Loss> against_volume(count);
  for (std::size_t i = 0; i < count; ++i) {
    const SliceEstimate& slice = estimate.slices[i];
    if (volume.empty() || !std::isfinite(slice.ncc)) continue;
    against_volume[i] = loss_against(*blocks_[i], slice.T_brain_slice, slice.info.thickness, scale, volume);
    if (std::isfinite(against_volume[i].gain)) gains[slice.info.stack].push_back(against_volume[i].gain);
  }

  std::vector<double> void_shares;
  std::vector<Loss> against_neighbours;
  for (std::size_t i = 0; i < count; ++i) {
    const SliceInfo& info = estimate.slices[i].info;
    std::vector<std::pair<const SliceBlocks*, const SliceInfo*>> neighbours;
    for (int step = -kNeighbours; step <= kNeighbours; ++step) {
      const auto found = place.find({info.stack, info.index + step});
      if (step != 0 && found != place.end())
        neighbours.emplace_back(blocks_[found->second].get(), &estimate.slices[found->second].info);
    }
    against_neighbours.push_back(loss_against(*blocks_[i], info, scale, neighbours));
    void_shares.push_back(or_typical(against_neighbours[i].void_share, kTypical.void_image));
  }
  void_shares = above_usual(void_shares);

  for (std::size_t i = 0; i < count; ++i) {
    const SliceEstimate& slice = estimate.slices[i];
    SliceQuality& quality = slices_[i];
    quality.stack = slice.info.stack;
    quality.index = slice.info.index;
    quality.stamp_ns = slice.info.stamp_ns;
    QualityFeatures& f = quality.features;
    f.weight = slice.weight;
    f.similarity = std::isfinite(slice.ncc) ? -std::log(1. - std::clamp(slice.ncc, 0., 0.995)) : kNaN;
    f.void_volume = against_volume[i].void_share;
    f.dark_volume = std::isfinite(against_volume[i].gain)
                        ? loss_log(against_volume[i].gain / median(gains[slice.info.stack]))
                        : kNaN;

    f.void_image = void_shares[i];
    f.dark_image = loss_log(against_neighbours[i].gain);
    f.noise = noises[i];

    // A jump that comes back is out of range; a step that stays may be the head's. The newest has no slice after it.
    double jump = std::numeric_limits<double>::infinity();
    for (const std::ptrdiff_t step : {-1, 1}) {
      const std::ptrdiff_t other = static_cast<std::ptrdiff_t>(i) + step;
      if (other < 0 || other >= static_cast<std::ptrdiff_t>(count)) continue;
      jump = std::min(jump,
                      sphere_displacement(slice.T_scanner_brain,
                                          estimate.slices[static_cast<std::size_t>(other)].T_scanner_brain, radius_mm));
    }
    f.jump = std::isfinite(jump) ? std::log1p(jump / kJumpMm) : 0.;

    quality.score = quality_score(f, options_);
    if (slice.weight <= 0. || slice.status == PoseStatus::outlier) quality.score = 0.;  // it fits nowhere
    quality.image_score = image_quality_score(f, options_);
    quality.first_score =
        first_scores_.emplace(std::make_pair(quality.stack, quality.index), quality.score).first->second;
    quality.reasons = reasons_of(slice, f, options_);
  }
  return slices_;
}

}  // namespace svort
