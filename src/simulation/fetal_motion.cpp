#include "svort_ros/simulation/fetal_motion.h"

#include <algorithm>
#include <cmath>
#include <sstream>
#include <stdexcept>

namespace svort {
namespace {

constexpr double kStep_s = 0.1;
constexpr double kDegree = M_PI / 180.;
constexpr double kDriftTime_s = 5.;  ///< drift changes its direction within seconds
constexpr double kBurstTime_s = 1.;  ///< a moving head does so about once a second

void require(bool ok, const char* option, double value, const char* limit) {
  if (ok) return;
  std::ostringstream text;
  text << "motion." << option << " is " << value << ", must be " << limit;
  throw std::invalid_argument(text.str());
}

void check(const MotionOptions& options) {
  const auto from_zero = [](double value) { return std::isfinite(value) && value >= 0.; };
  const auto positive = [](double value) { return std::isfinite(value) && value > 0.; };
  MotionOptions copy = options;
  copy.visit([&](const char* key, double value, const char*) {
    require(from_zero(value), key, value, "finite and at least 0");
  });
  require(positive(options.burst_s), "burst_s", options.burst_s, "positive");
  require(positive(options.breathing_period_s), "breathing_period_s", options.breathing_period_s, "positive");
  require(positive(options.confinement_mm), "confinement_mm", options.confinement_mm, "positive");
  require(options.startle_return <= 1., "startle_return", options.startle_return, "at most 1");
}

/// Smooth random velocity (Ornstein-Uhlenbeck), components with the given root mean square.
class SmoothVelocity {
 public:
  SmoothVelocity(double time_s) : keep_(std::exp(-kStep_s / time_s)), push_(std::sqrt(1. - keep_ * keep_)) {}
  const Eigen::Vector3d& next(RandomStream* random) {
    value_ = keep_ * value_ + random->normal3(push_);
    return value_;
  }

 private:
  double keep_, push_;
  Eigen::Vector3d value_ = Eigen::Vector3d::Zero();
};

/// Times of a Poisson process.
std::vector<double> event_times(double per_hour, double duration_s, RandomStream* random) {
  std::vector<double> times;
  if (per_hour <= 0.) return times;
  for (double t = random->exponential(3600. / per_hour); t < duration_s; t += random->exponential(3600. / per_hour))
    times.push_back(t);
  return times;
}

/// A movement from rest to rest of unit length: its velocity at `phase` in [0, 1] (minimum jerk).
double rest_to_rest(double phase) {
  return phase <= 0. || phase >= 1. ? 0. : 30. * phase * phase * (1. - phase) * (1. - phase);
}

/// A movement by a given amount within a given time.
struct Push {
  double begin_s, duration_s;
  Eigen::Vector3d rotation, translation;
};

Eigen::Quaterniond turn(const Eigen::Vector3d& rotation) {
  const double angle = rotation.norm();
  if (angle < 1e-12) return Eigen::Quaterniond::Identity();
  return Eigen::Quaterniond(Eigen::AngleAxisd(angle, rotation / angle));
}

}  // namespace

const std::vector<std::string>& motion_classes() {
  static const std::vector<std::string> names{"none", "mild", "moderate", "severe"};
  return names;
}

MotionOptions motion_class(const std::string& name) {
  MotionOptions options;
  if (name == "none") return options;
  options.breathing_mm = 0.5;
  if (name == "mild") {
    options.drift_deg = 3.;
    options.drift_mm = 1.5;
    options.bursts_per_hour = 25.;
    options.burst_deg_per_s = 1.;
    options.burst_mm_per_s = 0.5;
    options.startles_per_hour = 5.;
    options.startle_deg = 4.;
    options.startle_mm = 1.5;
    return options;
  }
  if (name == "moderate") {
    options.drift_deg = 6.;
    options.drift_mm = 3.;
    options.bursts_per_hour = 50.;
    options.burst_deg_per_s = 3.;
    options.burst_mm_per_s = 1.5;
    options.startles_per_hour = 15.;
    options.startle_deg = 10.;
    options.startle_mm = 4.;
    return options;
  }
  if (name == "severe") {
    options.drift_deg = 10.;
    options.drift_mm = 5.;
    options.bursts_per_hour = 80.;
    options.burst_deg_per_s = 6.;
    options.burst_mm_per_s = 3.;
    options.startles_per_hour = 40.;
    options.startle_deg = 20.;
    options.startle_mm = 7.;
    return options;
  }
  std::string known;
  for (const std::string& other : motion_classes()) known += (known.empty() ? "" : ", ") + other;
  throw std::invalid_argument("motion class '" + name + "' is unknown; there are " + known);
}

HeadTrajectory::HeadTrajectory(const MotionOptions& options, double duration_s, RandomStream random) {
  check(options);
  require(std::isfinite(duration_s) && duration_s > 0. && duration_s < 1e5, "duration", duration_s,
          "positive and below 1e5 s");
  std::vector<double> burst_ends;
  const std::vector<double> burst_begins = event_times(options.bursts_per_hour, duration_s, &random);
  for (const double begin : burst_begins)
    burst_ends.push_back(begin + std::clamp(random.exponential(options.burst_s), 1., 4. * options.burst_s));

  // Sizes vary as a gamma distribution of shape 2 does: few are tiny, some are three times the mean.
  const auto size = [&random](double mean) { return random.exponential(0.5 * mean) + random.exponential(0.5 * mean); };
  std::vector<Push> pushes;
  for (const double begin : event_times(options.startles_per_hour, duration_s, &random)) {
    Push push{begin, random.uniform(0.5, 1.), size(options.startle_deg * kDegree) * random.direction(),
              size(options.startle_mm) * random.direction()};
    pushes.push_back(push);
    if (!random.chance(options.startle_return)) continue;
    push.begin_s += push.duration_s + random.uniform(0., 3.);
    push.duration_s = random.uniform(1., 3.);
    push.rotation *= -1.;
    push.translation *= -1.;
    pushes.push_back(push);
  }

  // A velocity v with correlation time tau spreads as 2 tau v^2 t along each axis.
  const double drift_rate = 1. / std::sqrt(3. * 2. * kDriftTime_s * 60.);
  const double component = 1. / std::sqrt(3.);
  SmoothVelocity drift_rotation(kDriftTime_s), drift_translation(kDriftTime_s);
  SmoothVelocity burst_rotation(kBurstTime_s), burst_translation(kBurstTime_s);
  for (int warm_up = 0; warm_up < 200; ++warm_up)
    for (SmoothVelocity* velocity : {&drift_rotation, &drift_translation, &burst_rotation, &burst_translation})
      velocity->next(&random);
  const Eigen::Vector3d breathing = options.breathing_mm * random.direction();
  const double breathing_phase = random.uniform(0., 2. * M_PI);
  const Eigen::Vector3d neck(0., 0., -options.neck_mm);

  Eigen::Quaterniond rotation = Eigen::Quaterniond::Identity();
  Eigen::Vector3d translation = Eigen::Vector3d::Zero();
  Eigen::Vector3d start = Eigen::Vector3d::Zero();
  const auto steps = static_cast<std::size_t>(std::ceil(duration_s / kStep_s)) + 1;
  samples_.reserve(steps);
  for (std::size_t step = 0; step < steps; ++step) {
    const double t = kStep_s * static_cast<double>(step);
    const double breath = std::sin(2. * M_PI * t / options.breathing_period_s + breathing_phase);
    const double length = translation.norm();
    const Eigen::Vector3d confined =
        length > 1e-9 ? Eigen::Vector3d(translation *
                                        (options.confinement_mm * std::tanh(length / options.confinement_mm) / length))
                      : translation;
    const Eigen::Vector3d position = confined + neck - rotation * neck + breath * breathing;
    if (step == 0) start = position;
    samples_.push_back({rotation, position - start});

    Eigen::Vector3d turning = options.drift_deg * kDegree * drift_rate * drift_rotation.next(&random);
    Eigen::Vector3d moving = options.drift_mm * drift_rate * drift_translation.next(&random);
    const Eigen::Vector3d burst_turning = options.burst_deg_per_s * kDegree * component * burst_rotation.next(&random);
    const Eigen::Vector3d burst_moving = options.burst_mm_per_s * component * burst_translation.next(&random);
    for (std::size_t i = 0; i < burst_begins.size(); ++i) {
      if (t < burst_begins[i] || t >= burst_ends[i]) continue;
      turning += burst_turning;
      moving += burst_moving;
    }
    for (const Push& push : pushes) {
      const double rate = rest_to_rest((t + 0.5 * kStep_s - push.begin_s) / push.duration_s) / push.duration_s;
      turning += rate * push.rotation;
      moving += rate * push.translation;
    }
    rotation = (turn(kStep_s * turning) * rotation).normalized();
    translation += kStep_s * moving;
  }
}

Pose HeadTrajectory::at(double time_s) const {
  const double position = std::clamp(time_s / kStep_s, 0., static_cast<double>(samples_.size() - 1));
  const auto before = std::min(static_cast<std::size_t>(position), samples_.size() - 1);
  const std::size_t after = std::min(before + 1, samples_.size() - 1);
  const double share = position - static_cast<double>(before);
  Pose pose = Pose::Identity();
  pose.linear() = samples_[before].rotation.slerp(share, samples_[after].rotation).toRotationMatrix();
  pose.translation() = (1. - share) * samples_[before].translation + share * samples_[after].translation;
  return pose;
}

double HeadTrajectory::speed(double time_s) const {
  constexpr double kSpan_s = 0.2;  // about the time in which a single-shot slice gets its contrast
  return sphere_distance(at(time_s - 0.5 * kSpan_s), at(time_s + 0.5 * kSpan_s)) / kSpan_s;
}

double sphere_distance(const Pose& a, const Pose& b, double radius_mm) {
  // Over the sphere, E|(Ra - Rb) x + d|^2 = |Ra - Rb|_F^2 radius^2 / 3 + |d|^2.
  const double turned = (a.linear() - b.linear()).squaredNorm() * radius_mm * radius_mm / 3.;
  return std::sqrt(turned + (a.translation() - b.translation()).squaredNorm());
}

}  // namespace svort
