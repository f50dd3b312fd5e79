#include "svort_ros/ros/svort_server.h"

#include <ros/callback_queue.h>
#include <ros/ros.h>
#include <ros/spinner.h>
#include <std_srvs/Trigger.h>

#include <atomic>
#include <chrono>
#include <cmath>
#include <exception>
#include <functional>
#include <future>
#include <limits>
#include <set>
#include <string>
#include <thread>
#include <utility>

#include "svort_ros/Veto.h"
#include "svort_ros/decision/decision_engine.h"
#include "svort_ros/io/brain_templates.h"
#include "svort_ros/live/threads.h"
#include "svort_ros/ros/arrivals.h"
#include "svort_ros/ros/conversions.h"
#include "svort_ros/ros/decision_publisher.h"
#include "svort_ros/ros/estimate_publisher.h"
#include "svort_ros/ros/inbox.h"
#include "svort_ros/ros/names.h"
#include "svort_ros/ros/node_health.h"
#include "svort_ros/ros/parameters.h"
#include "svort_ros/ros/reconfigure.h"
#include "svort_ros/ros/scan_archive.h"
#include "svort_ros/ros/scan_finisher.h"

namespace svort_ros {

/// Answer of a service.
struct CommandAnswer {
  bool success = false;
  std::string message;
};

// Slices and services have threads of their own: a service that waits for the worker must not hold up slices.
struct SvortServer::CallbackThreads {
  ros::CallbackQueue slice_queue;
  ros::CallbackQueue service_queue;
  ros::AsyncSpinner slice_spinner{1, &slice_queue};
  ros::AsyncSpinner service_spinner{1, &service_queue};

  void start() {
    slice_spinner.start();
    service_spinner.start();
  }
  void stop() {
    slice_spinner.stop();
    service_spinner.stop();
  }
  static ros::NodeHandle on(const ros::NodeHandle& nh, ros::CallbackQueue* queue) {
    ros::NodeHandle handle(nh);
    handle.setCallbackQueue(queue);
    return handle;
  }
};

class SvortServer::Worker {
 public:
  using Command = CommandAnswer (Worker::*)();

  Worker(const ros::NodeHandle& nh, const ros::NodeHandle& private_nh, const ServerOptions& options)
      : options_(options),
        topic_(nh.resolveName(kSliceTopic)),
        templates_(svort::load_templates(options.pipeline.estimator.templates)),
        pipeline_(std::make_unique<svort::LivePipeline>(options.pipeline, templates_)),
        decisions_(std::make_unique<svort::DecisionEngine>(options.decision)),
        archive_(options.node.output_directory),
        status_publisher_(ros::NodeHandle(nh).advertise<SliceStatus>(kSliceStatusTopic, 1000)),
        publisher_(nh, options.node, [this](EstimatePublisher::Product product) { subscribed(product); }),
        decision_publisher_(nh, options.node, [this] { subscribed_to_decisions(); }),
        health_(nh, private_nh, options.node, [this] { return inbox_.size(); }),
        finisher_(archive_, [this](FinishedScan scan) { finished(std::move(scan)); }),
        thread_([this] { run(); }) {}

  /// Answers everything that has arrived, and ends the thread.
  void stop() {
    ending_ = true;
    hurry_ = true;
    inbox_.close();
    if (thread_.joinable()) thread_.join();
  }
  ~Worker() { stop(); }

  // Called by ROS threads.

  void receive(const Slice::ConstPtr& message) {
    ++waiting_;
    hurry_ = true;
    inbox_.push({message, Clock::now(), nullptr});
  }

  /// Has the worker execute the command after all that arrived before it, and waits for the answer.
  CommandAnswer call(Command command) {
    return call(std::function<CommandAnswer()>([this, command] { return (this->*command)(); }));
  }
  CommandAnswer call(const std::function<CommandAnswer()>& command) {
    const CommandAnswer stopping{false, "the node is shutting down"};
    const auto promise = std::make_shared<std::promise<CommandAnswer>>();
    std::future<CommandAnswer> answer = promise->get_future();
    const auto execute = [this, command, promise, stopping](bool closed) {
      promise->set_value(closed ? stopping : guarded_answer(command));
    };
    return inbox_.push({nullptr, Clock::now(), execute}) ? answer.get() : stopping;
  }

  // Commands; these run on the worker's thread.

  CommandAnswer reset();
  CommandAnswer save();
  CommandAnswer finalise();
  CommandAnswer veto(int id, const std::string& reason);

  /// Changes thresholds. @return those in use afterwards: the old ones if something is wrong with the change
  svort::DecisionOptions reconfigure(const dynamic_reconfigure::Config& change);

 private:
  struct Item {
    Slice::ConstPtr slice;  ///< null: it is a command
    Clock::time_point arrived;
    std::function<void(bool closed)> command;
  };

  void subscribed(EstimatePublisher::Product product) {
    inbox_.push({nullptr, Clock::now(), [this, product](bool closed) {
                   if (!closed) guarded([&] { publisher_.publish(product, *pipeline_); });
                 }});
  }

  void subscribed_to_decisions() {
    inbox_.push({nullptr, Clock::now(), [this](bool closed) {
                   if (!closed) guarded([&] { decision_publisher_.publish_pictures(*decisions_, *pipeline_); });
                 }});
  }

  /// From the finisher's thread.
  void finished(FinishedScan scan) {
    finished_.push(std::move(scan));
    inbox_.push({nullptr, Clock::now(), [](bool) {}});  // wakes the worker
  }

  void run();
  void take_finished();
  void answer(const Slice& message, Clock::time_point arrived);
  svort::Arrival take_in(const SliceFromMessage& decoded);
  void end_scan();
  void update_volume();
  void improve();
  void report_estimator();
  void publish_volume();
  void report_agreement();
  void forget_agreement();
  void decide();
  void publish_estimate();
  void save_at_exit();
  svort::RunInfo run_info() const;

  /// An exception here is a fault of this program or a lack of memory; the node reports it and goes on.
  template <class Action>
  bool guarded(const Action& action) {
    try {
      action();
      return true;
    } catch (const std::exception& error) {
      ROS_ERROR("internal error: %s", error.what());
      health_.failed(error.what());
      return false;
    }
  }
  CommandAnswer guarded_answer(const std::function<CommandAnswer()>& command) {
    CommandAnswer answer{false, "internal error; the log says more"};
    guarded([&] { answer = command(); });
    return answer;
  }

  const ServerOptions options_;
  const std::string topic_;
  Inbox<Item> inbox_;
  Inbox<FinishedScan> finished_;
  std::atomic<int> waiting_{0};      ///< slices that are not answered yet
  std::atomic<bool> ending_{false};  ///< stop() was called
  std::atomic<bool> hurry_{false};   ///< a slice has come, or the end: what takes long gives up

  // The worker's thread alone touches these.
  const std::vector<svort::BrainTemplate> templates_;
  std::unique_ptr<svort::LivePipeline> pipeline_;
  std::unique_ptr<svort::DecisionEngine> decisions_;  ///< of the same scan
  std::uint64_t revision_offset_ = 0;  ///< of pipelines that were put aside, so that revisions go on counting
  std::set<std::string> ended_scans_;
  ScanArchive archive_;
  AwaitingVolume awaiting_volume_;
  ScanProgress progress_;
  Clock::time_point scan_started_;
  bool estimate_is_new_ = false;
  bool has_unsaved_ = false;
  std::size_t warned_ = 0;  ///< warnings of the estimator that are in the log
  bool agreed_ = true;      ///< the last estimate did, as far as known

  ros::Publisher status_publisher_;
  EstimatePublisher publisher_;
  DecisionPublisher decision_publisher_;
  NodeHealth health_;
  ScanFinisher finisher_;
  std::thread thread_;  ///< last: it uses all of the above
};

void SvortServer::Worker::report_estimator() {
  const svort::EstimatorNotes notes = pipeline_->notes();
  health_.set_estimator(
      {options_.pipeline.estimator.method, pipeline_->device(), svort::thread_count(), notes.warnings});
  for (; warned_ < notes.warnings.size(); ++warned_) ROS_WARN("%s", notes.warnings[warned_].c_str());
}

void SvortServer::Worker::run() {
  svort::set_thread_count(options_.node.threads);
  report_estimator();
  for (;;) {
    const bool volume_is_due = awaiting_volume_.size() > 0;
    Inbox<Item>::Batch batch = inbox_.take_all(!volume_is_due);
    for (Item& item : batch.items) {
      if (item.slice)
        answer(*item.slice, item.arrived);
      else
        item.command(batch.closed);
    }
    take_finished();
    if (estimate_is_new_) publish_estimate();
    report_estimator();
    if (batch.closed) break;
    // A volume takes longer than a slice: it waits for a pause, but in a steady stream not forever.
    const auto limit = static_cast<std::size_t>(options_.node.volume_every);
    if (awaiting_volume_.size() > 0 && (inbox_.size() == 0 || awaiting_volume_.size() >= limit)) update_volume();
    if (inbox_.size() == 0) improve();
  }
  finisher_.stop();
  take_finished();
  save_at_exit();
}

void SvortServer::Worker::take_finished() {
  for (FinishedScan& finished : finished_.take_all(false).items) {
    health_.set_ended_scans(finisher_.count());
    const std::string name = "scan " + finished.scan.pipeline->sequence().scan_id();
    if (!finished.failure.empty()) {
      health_.failed(finished.failure);
      ROS_ERROR("%s could not be finalised, internal error: %s", name.c_str(), finished.failure.c_str());
    }
    const char* how = finished.final ? "is final" : "ends as it was while slices came";
    if (finished.final)
      guarded([&] { publisher_.publish_final(*finished.scan.pipeline, finished.scan.revision_offset); });
    if (finished.written) {
      health_.write_succeeded(archive_.kept());
      ROS_INFO("%s %s, and is in %s (%.1f s)", name.c_str(), how, finished.scan.folder.c_str(), finished.seconds);
    } else if (!finished.not_written.empty()) {
      archive_.keep(std::move(finished.scan));
      health_.write_failed(finished.not_written, archive_.kept());
      ROS_ERROR("%s could not be written and is kept in memory until ~save succeeds: %s", name.c_str(),
                finished.not_written.c_str());
    } else {
      ROS_WARN("%s %s, and is not written: ~node/output_directory is not set", name.c_str(), how);
    }
  }
}

void SvortServer::Worker::answer(const Slice& message, Clock::time_point arrived) {
  SliceStatus status;
  status.header.stamp = message.header.stamp;
  status.header.frame_id = options_.node.scanner_frame;
  status.scan_id = message.scan_id;
  status.stack = message.stack;
  status.index = message.index;
  status.status = SliceStatus::FAILED;
  status.reason = "the node failed on this slice; its log says more";

  const bool worked = guarded([&] {
    const SliceFromMessage decoded = from_msg(message);
    const svort::Arrival arrival = take_in(decoded);
    const bool kept = svort::is_kept(arrival.status);
    if (kept) publisher_.publish_transforms(*pipeline_);

    svort::JournalEntry entry = make_journal_entry(*pipeline_, decoded.slice.info, arrival);
    entry.latency_ms = milliseconds_since(arrived);
    const std::size_t number = pipeline_->journal().add(entry);
    has_unsaved_ = true;
    progress_.add(entry.info, arrival.status);
    const std::string head = progress_head(progress_, entry.info, arrival.status);
    if (kept) {
      awaiting_volume_.add({number, arrived, head});
      estimate_is_new_ = true;
    } else if (arrival.status == svort::ArrivalStatus::empty_mask) {  // normal at the ends of a stack
      ROS_INFO("%s", rejection_line(head, entry).c_str());
    } else {
      ROS_WARN("%s", rejection_line(head, entry).c_str());
    }

    status.status = to_status_code(arrival.status);
    status.kept = kept;
    status.reason = arrival.reason;
    status.warnings = arrival.warnings;
    if (kept && !message.header.frame_id.empty() && message.header.frame_id != options_.node.scanner_frame)
      status.warnings.push_back("header.frame_id is '" + message.header.frame_id + "'; the pose is taken to be in '" +
                                options_.node.scanner_frame + "'");
    for (const std::string& warning : status.warnings)
      ROS_WARN_THROTTLE(10., "%s: %s", svort::describe(entry.info).c_str(), warning.c_str());
    status.sequence_length = static_cast<std::uint32_t>(entry.sequence_length);
    status.revision = kept ? entry.revision + revision_offset_ : 0;
    health_.slice_answered(arrival.status, entry.latency_ms);
  });
  --waiting_;
  if (!worked) status.kept = false;
  status.latency = milliseconds_since(arrived) / 1000.;
  status_publisher_.publish(status);
}

svort::Arrival SvortServer::Worker::take_in(const SliceFromMessage& decoded) {
  if (!decoded.ok) return rejection(decoded);
  const svort::SliceSequence& sequence = pipeline_->sequence();
  const std::string& scan_id = decoded.slice.info.scan_id;
  if (sequence.slices().empty()) {
    scan_started_ = Clock::now();
  } else if (scan_id != sequence.scan_id() && sequence.check(decoded.slice).starts_scan) {
    if (ended_scans_.count(scan_id)) {  // the sequence knows, unless it was put aside with an unwritten scan
      svort::Arrival arrival;
      arrival.status = svort::ArrivalStatus::ended_scan;
      arrival.reason = svort::describe(decoded.slice.info) + ": this scan has ended";
      return arrival;
    }
    end_scan();
    scan_started_ = Clock::now();
  }
  return pipeline_->add(decoded.slice);
}

void SvortServer::Worker::end_scan() {
  const std::string scan_id = pipeline_->sequence().scan_id();
  ROS_INFO("scan %s has ended with %zu slices", scan_id.c_str(), pipeline_->sequence().slices().size());
  auto next = std::make_unique<svort::LivePipeline>(options_.pipeline, templates_);
  auto next_decisions = std::make_unique<svort::DecisionEngine>(decisions_->options());
  if (awaiting_volume_.size() > 0) update_volume();  // its last slices
  ArchivedScan ended;
  ended.run = run_info();
  ended.folder = archive_.begin_scan();
  ended.revision_offset = revision_offset_;
  revision_offset_ += pipeline_->estimate().revision;
  ended.pipeline = std::exchange(pipeline_, std::move(next));
  ended.decisions = std::exchange(decisions_, std::move(next_decisions));
  finisher_.take(std::move(ended));
  health_.set_ended_scans(finisher_.count());
  ended_scans_.insert(scan_id);
  forget_agreement();
  publisher_.begin_scan();
  progress_.clear();
  awaiting_volume_.clear();
  has_unsaved_ = false;
}

void SvortServer::Worker::update_volume() {
  const bool worked = guarded([&] {
    pipeline_->update_volume();
    publish_volume();
  });
  if (!worked) awaiting_volume_.clear();  // the next slice is the next attempt
}

void SvortServer::Worker::improve() {
  bool improved = false;
  guarded([&] {
    while (inbox_.size() == 0 && !inbox_.closed() && pipeline_->improve()) improved = true;
  });
  if (!improved) return;
  guarded([&] { publisher_.publish_transforms(*pipeline_); });
  publish_estimate();
  if (inbox_.size() == 0) update_volume();
}

void SvortServer::Worker::publish_volume() {
  publisher_.publish_volume(*pipeline_, revision_offset_);
  publish_estimate();  // with the volume came each slice's ncc
  report_agreement();
  const std::vector<AwaitingVolume::Published> published = awaiting_volume_.volume_published(*pipeline_);
  guarded([&] { decide(); });
  for (const AwaitingVolume::Published& slice : published) {
    pipeline_->journal().set_decision_latency(slice.slice.entry, milliseconds_since(slice.slice.arrived));
    health_.volume_published(slice.latency_ms);
    ROS_INFO("%s", slice.line.c_str());
  }
  has_unsaved_ = true;
}

void SvortServer::Worker::forget_agreement() {
  agreed_ = true;
  health_.set_agreement(std::numeric_limits<double>::quiet_NaN());
}

void SvortServer::Worker::report_agreement() {
  const double agreement = pipeline_->estimate().agreement;
  health_.set_agreement(agreement);
  const bool agrees = !(agreement < svort::kAgreement);
  if (agrees == agreed_) return;
  agreed_ = agrees;
  if (agrees)
    ROS_INFO("slices agree with each other again (%.2f)", agreement);
  else
    ROS_WARN(
        "slices do not agree with each other (%.2f, should be %.2f): the head has jumped or turned far; poses may "
        "be far off until they do again",
        agreement, svort::kAgreement);
}

void SvortServer::Worker::decide() {
  const std::size_t known = decisions_->planner().events().size();
  if (!decisions_->update(*pipeline_)) return;
  decision_publisher_.publish(*decisions_, *pipeline_, revision_offset_);
  const auto& events = decisions_->planner().events();
  for (std::size_t i = known; i < events.size(); ++i) {
    const svort::ReacquisitionRequest& request = events[i].request;
    std::string reasons;
    for (const std::string& reason : request.reasons) reasons += " " + reason;
    ROS_INFO("request %d %s: stack %d slice %d%s, gain %.1f %%, %.1f s left", request.id, events[i].event.c_str(),
             request.stack, request.index, reasons.c_str(), 100. * request.gain, events[i].budget_left_s);
  }
}

CommandAnswer SvortServer::Worker::veto(int id, const std::string& reason) {
  const int count = decisions_->veto(id, reason);
  if (count == 0) return {false, id == 0 ? "no request waits" : "request " + std::to_string(id) + " does not wait"};
  has_unsaved_ = true;
  decision_publisher_.publish(*decisions_, *pipeline_, revision_offset_);
  const std::string text = std::to_string(count) + (count == 1 ? " request vetoed" : " requests vetoed");
  ROS_INFO("%s: %s", text.c_str(), reason.c_str());
  return {true, text};
}

svort::DecisionOptions SvortServer::Worker::reconfigure(const dynamic_reconfigure::Config& change) {
  svort::DecisionOptions in_use;
  call([&]() -> CommandAnswer {
    in_use = decisions_->options();
    try {
      svort::DecisionOptions wanted = in_use;
      apply_config(change, &wanted);
      decisions_->set_options(wanted);
      in_use = wanted;
      ROS_INFO("thresholds changed: %s", decisions_->planner().events().back().detail.c_str());
    } catch (const std::invalid_argument& error) {
      ROS_ERROR("thresholds stay as they are: %s", error.what());
    }
    return {true, ""};
  });
  return in_use;
}

void SvortServer::Worker::publish_estimate() {
  guarded([&] { publisher_.publish_estimate(*pipeline_, revision_offset_); });
  estimate_is_new_ = false;
}

CommandAnswer SvortServer::Worker::finalise() {
  const auto started = Clock::now();
  const std::size_t slices = pipeline_->sequence().slices().size();
  if (slices == 0) return {false, "there is no slice yet"};
  hurry_ = false;
  if (waiting_ > 0 || ending_) hurry_ = true;  // in this order: receive() raises them in the other
  const bool changed = pipeline_->finalise(&hurry_);
  const bool final = pipeline_->estimate().final;
  if (changed) {
    publisher_.publish_transforms(*pipeline_);
    publish_volume();
    publisher_.publish_final(*pipeline_, revision_offset_);
  }
  const std::string after = ", after " + std::to_string(std::lround(milliseconds_since(started))) + " ms";
  const std::string text =
      "scan " + pipeline_->sequence().scan_id() + " with " + std::to_string(slices) + " slices " +
      (changed ? "is final" + after
       : final ? std::string("was final already")
               : "is not final: given up" + after + ", because " + (ending_ ? "the node ends" : "a slice came"));
  ROS_INFO("%s", text.c_str());
  return {final, text};
}

CommandAnswer SvortServer::Worker::reset() {
  const std::size_t slices = pipeline_->sequence().slices().size();
  pipeline_->reset();
  ended_scans_.clear();
  forget_agreement();
  archive_.begin_scan();
  progress_.clear();
  awaiting_volume_.clear();
  estimate_is_new_ = false;
  has_unsaved_ = false;
  publisher_.clear(*pipeline_, revision_offset_);
  decisions_->clear();
  decision_publisher_.clear(*pipeline_, revision_offset_);
  const std::string text = std::to_string(slices) + " slices forgotten";
  ROS_INFO("reset: %s", text.c_str());
  return {true, text};
}

CommandAnswer SvortServer::Worker::save() {
  CommandAnswer answer{true, ""};
  const auto add = [&](const std::string& text) { answer.message += (answer.message.empty() ? "" : "; ") + text; };
  const auto fail = [&](const std::string& text) {
    answer.success = false;
    add(text);
    health_.write_failed(text, archive_.kept());
    ROS_ERROR("not written: %s", text.c_str());
  };
  const ScanArchive::Retry retried = archive_.retry();
  for (const auto& folder : retried.written) {
    add("wrote " + folder.string());
    health_.write_succeeded(archive_.kept());
  }
  for (const std::string& failure : retried.failures) fail(failure);

  if (const std::size_t ended = finisher_.count(); ended > 0)
    add(std::to_string(ended) + (ended == 1 ? " ended scan is" : " ended scans are") +
        " being finalised and will be written then");
  const std::size_t slices = pipeline_->sequence().slices().size();
  if (slices > 0) {
    try {
      const auto folder = archive_.save(*pipeline_, run_info(), decisions_.get());
      health_.write_succeeded(archive_.kept());
      has_unsaved_ = false;
      add("wrote " + folder.string() + " (" + std::to_string(slices) + " slices, revision " +
          std::to_string(pipeline_->estimate().revision + revision_offset_) + ")");
    } catch (const std::exception& error) {
      fail(error.what());
    }
  } else if (answer.message.empty()) {
    answer = {false, "there is no slice to save"};
  }
  if (answer.success) ROS_INFO("%s", answer.message.c_str());
  return answer;
}

void SvortServer::Worker::save_at_exit() {
  const bool scan_in_hand = has_unsaved_ && !pipeline_->sequence().slices().empty();
  if (scan_in_hand && !archive_.enabled())
    ROS_WARN("the scan in hand is not written: ~node/output_directory is not set");
  else if (scan_in_hand || archive_.kept() > 0)
    guarded([&] { save(); });
}

svort::RunInfo SvortServer::Worker::run_info() const {
  svort::RunInfo run;
  run.program = "svort_node";
  run.inputs = {topic_};
  run.threads = svort::thread_count();
  run.wall_s = milliseconds_since(scan_started_) / 1000.;
  return run;
}

class SvortServer::Callbacks {
 public:
  Callbacks(const ros::NodeHandle& slice_nh, const ros::NodeHandle& service_nh, const ServerOptions& options,
            Worker* worker)
      : options_(options.node),
        worker_(worker),
        slice_nh_(slice_nh),
        service_nh_(service_nh),
        thresholds_(ros::NodeHandle(service_nh, kThresholds), options.decision,
                    [worker](const dynamic_reconfigure::Config& change) { return worker->reconfigure(change); }) {
    subscriber_ = slice_nh_.subscribe<Slice>(
        kSliceTopic, static_cast<std::uint32_t>(options_.queue_size),
        [worker](const Slice::ConstPtr& message) { worker->receive(message); }, ros::VoidConstPtr(),
        ros::TransportHints().tcpNoDelay());
    serve(kResetService, &Worker::reset);
    serve(kSaveService, &Worker::save);
    serve(kFinaliseService, &Worker::finalise);
    services_.push_back(service_nh_.advertiseService<Veto::Request, Veto::Response>(
        kVetoService, [worker](Veto::Request& request, Veto::Response& response) {
          const CommandAnswer answer = worker->call([&] { return worker->veto(request.id, request.reason); });
          response.success = static_cast<std::uint8_t>(answer.success);
          response.message = answer.message;
          return true;
        }));
    publisher_timer_ = slice_nh_.createTimer(ros::Duration(options_.no_slice_warning_s),
                                             [this](const ros::TimerEvent&) { check_publishers(); });
  }

 private:
  void serve(const char* name, Worker::Command command) {
    services_.push_back(service_nh_.advertiseService<std_srvs::Trigger::Request, std_srvs::Trigger::Response>(
        name, [this, command](std_srvs::Trigger::Request&, std_srvs::Trigger::Response& response) {
          const CommandAnswer answer = worker_->call(command);
          response.success = static_cast<std::uint8_t>(answer.success);
          response.message = answer.message;
          return true;
        }));
  }

  void check_publishers() {
    const bool alone = subscriber_.getNumPublishers() == 0;
    if (alone && !warned_)
      ROS_WARN("nobody has published slices on %s for %.1f s", subscriber_.getTopic().c_str(),
               options_.no_slice_warning_s);
    warned_ = alone;
  }

  NodeOptions options_;
  Worker* worker_;
  ros::NodeHandle slice_nh_;
  ros::NodeHandle service_nh_;
  ros::Subscriber subscriber_;
  std::vector<ros::ServiceServer> services_;
  ros::Timer publisher_timer_;
  ReconfigureServer thresholds_;
  bool warned_ = false;
};

SvortServer::SvortServer(const ros::NodeHandle& nh, const ros::NodeHandle& private_nh)
    : threads_(std::make_unique<CallbackThreads>()) {
  const ServerOptions options = load_parameters(private_nh);
  const ros::NodeHandle slice_nh = CallbackThreads::on(nh, &threads_->slice_queue);
  worker_ = std::make_unique<Worker>(slice_nh, CallbackThreads::on(private_nh, &threads_->slice_queue), options);
  callbacks_ = std::make_unique<Callbacks>(slice_nh, CallbackThreads::on(private_nh, &threads_->service_queue), options,
                                           worker_.get());
  threads_->start();
  ROS_INFO("listening to %s; estimator: %s", nh.resolveName(kSliceTopic).c_str(),
           options.pipeline.estimator.method.c_str());
  if (options.pipeline.estimator.method == "nominal")
    ROS_WARN("poses are nominal: the scanner's own, no head motion is estimated");
}

SvortServer::~SvortServer() {
  worker_->stop();  // first: services that wait for it get their answers
  threads_->stop();
  callbacks_.reset();
  worker_.reset();
}

}  // namespace svort_ros
