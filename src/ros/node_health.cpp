#include "svort_ros/ros/node_health.h"

#include <utility>

#include "svort_ros/io/results.h"

namespace svort_ros {
namespace {

using diagnostic_msgs::DiagnosticStatus;

constexpr std::size_t kLatencyWindow = 200;      // slices; about three stacks
constexpr std::chrono::seconds kRateWindow{30};  // long enough for a slow sequence
constexpr double kMillisecondsPerSecond = 1000.;

void push_bounded(std::deque<double>* values, double value) {
  values->push_back(value);
  if (values->size() > kLatencyWindow) values->pop_front();
}

svort::Percentiles percentiles(const std::deque<double>& values) {
  return svort::percentiles({values.begin(), values.end()});
}

void add_percentiles(diagnostic_updater::DiagnosticStatusWrapper& status, const std::string& name,
                     const std::deque<double>& values) {
  const svort::Percentiles p = percentiles(values);
  status.addf(name + ", median / p95 / max (ms)", "%.1f / %.1f / %.1f", p.median, p.p95, p.max);
}

}  // namespace

NodeHealth::NodeHealth(const ros::NodeHandle& nh, const ros::NodeHandle& private_nh, const NodeOptions& options,
                       std::function<std::size_t()> inbox_length)
    : options_(options), inbox_length_(std::move(inbox_length)), updater_(nh, private_nh, private_nh.getNamespace()) {
  updater_.setHardwareID("none");
  updater_.add("slices", this, &NodeHealth::report_slices);
  updater_.add("estimator", this, &NodeHealth::report_estimator);
  updater_.add("results", this, &NodeHealth::report_results);
  timer_ =
      nh.createTimer(ros::Duration(updater_.getPeriod()), [this](const ros::TimerEvent&) { updater_.force_update(); });
}

void NodeHealth::set_estimator(Estimator estimator) {
  const std::lock_guard<std::mutex> lock(mutex_);
  estimator_ = std::move(estimator);
}

void NodeHealth::slice_answered(svort::ArrivalStatus status, double latency_ms) {
  const std::lock_guard<std::mutex> lock(mutex_);
  ++counts_[status];
  recent_arrivals_.push_back(Clock::now());
  while (recent_arrivals_.back() - recent_arrivals_.front() > kRateWindow) recent_arrivals_.pop_front();
  push_bounded(&pose_latencies_ms_, latency_ms);
}

void NodeHealth::volume_published(double latency_ms) {
  const std::lock_guard<std::mutex> lock(mutex_);
  push_bounded(&volume_latencies_ms_, latency_ms);
}

void NodeHealth::set_agreement(double agreement) {
  const std::lock_guard<std::mutex> lock(mutex_);
  agreement_ = agreement;
}

void NodeHealth::failed(const std::string& what) {
  const std::lock_guard<std::mutex> lock(mutex_);
  ++failures_;
  last_failure_ = what;
}

void NodeHealth::write_failed(const std::string& what, std::size_t scans_kept_in_memory) {
  const std::lock_guard<std::mutex> lock(mutex_);
  ++failed_writes_;
  last_write_failed_ = true;
  last_write_failure_ = what;
  scans_kept_ = scans_kept_in_memory;
}

void NodeHealth::write_succeeded(std::size_t scans_kept_in_memory) {
  const std::lock_guard<std::mutex> lock(mutex_);
  ++writes_;
  last_write_failed_ = false;
  scans_kept_ = scans_kept_in_memory;
}

void NodeHealth::set_ended_scans(std::size_t being_finalised) {
  const std::lock_guard<std::mutex> lock(mutex_);
  being_finalised_ = being_finalised;
}

void NodeHealth::report_slices(diagnostic_updater::DiagnosticStatusWrapper& status) {
  const std::size_t waiting = inbox_length_();
  const std::lock_guard<std::mutex> lock(mutex_);
  std::size_t kept = 0;
  std::size_t rejected = 0;
  for (const auto& [code, count] : counts_) (svort::is_kept(code) ? kept : rejected) += count;

  // Empty slices lie at the ends of every stack; the other reasons say that something is wrong.
  const auto empty = counts_.find(svort::ArrivalStatus::empty_mask);
  const std::size_t broken = rejected - (empty == counts_.end() ? 0 : empty->second);
  const double limit_ms = kMillisecondsPerSecond * options_.repetition_time_s;
  if (kept + rejected == 0)
    status.summary(DiagnosticStatus::OK, "no slice yet");
  else if (percentiles(pose_latencies_ms_).p95 > limit_ms)
    status.summary(DiagnosticStatus::WARN, "poses take longer than the repetition time");
  else if (percentiles(volume_latencies_ms_).p95 > limit_ms)
    status.summary(DiagnosticStatus::WARN, "volumes take longer than the repetition time");
  else if (broken > 0)
    status.summaryf(DiagnosticStatus::WARN, "%zu slices rejected", broken);
  else
    status.summary(DiagnosticStatus::OK, "slices are answered in time");

  double rate = 0.;
  if (recent_arrivals_.size() > 1) {
    const std::chrono::duration<double> span = recent_arrivals_.back() - recent_arrivals_.front();
    if (span.count() > 0.) rate = static_cast<double>(recent_arrivals_.size() - 1) / span.count();
  }
  status.addf("slice rate (1/s)", "%.2f", rate);
  add_percentiles(status, "pose latency", pose_latencies_ms_);
  add_percentiles(status, "volume latency", volume_latencies_ms_);
  status.addf("repetition time (ms)", "%.0f", limit_ms);
  status.add("inbox length", waiting);
  status.add("kept", kept);
  status.add("rejected", rejected);
  for (const auto& [code, count] : counts_) status.add(svort::to_string(code), count);
}

void NodeHealth::report_estimator(diagnostic_updater::DiagnosticStatusWrapper& status) {
  const std::lock_guard<std::mutex> lock(mutex_);
  if (failures_ > 0)
    status.summaryf(DiagnosticStatus::ERROR, "%zu internal errors, the last: %s", failures_, last_failure_.c_str());
  else if (estimator_.method == "nominal")
    status.summary(DiagnosticStatus::WARN, "poses are nominal: the scanner's own, no head motion is estimated");
  else if (agreement_ < svort::kAgreement)
    status.summaryf(DiagnosticStatus::WARN,
                    "slices do not agree with each other (%.2f, should be %.2f): poses may be far off", agreement_,
                    svort::kAgreement);
  else if (!estimator_.warnings.empty())
    status.summary(DiagnosticStatus::WARN, estimator_.warnings.back());
  else
    status.summary(DiagnosticStatus::OK, "head motion is estimated");
  status.add("method", estimator_.method);
  status.add("device", estimator_.device);
  status.add("threads", estimator_.threads);
  status.add("agreement of slices", agreement_);
}

void NodeHealth::report_results(diagnostic_updater::DiagnosticStatusWrapper& status) {
  const std::lock_guard<std::mutex> lock(mutex_);
  if (scans_kept_ > 0)
    status.summaryf(DiagnosticStatus::ERROR,
                    "%zu scans could not be written and are kept in memory; free the disk "
                    "and call ~save: %s",
                    scans_kept_, last_write_failure_.c_str());
  else if (last_write_failed_)
    status.summary(DiagnosticStatus::ERROR, "could not be written: " + last_write_failure_);
  else if (options_.output_directory.empty())
    status.summary(DiagnosticStatus::WARN, "~node/output_directory is not set: nothing is written");
  else
    status.summary(DiagnosticStatus::OK, "written to " + options_.output_directory);
  status.add("writes", writes_);
  status.add("failed writes", failed_writes_);
  status.add("scans kept in memory", scans_kept_);
  status.add("ended scans being finalised", being_finalised_);
}

}  // namespace svort_ros
