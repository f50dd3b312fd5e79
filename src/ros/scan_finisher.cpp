#include "svort_ros/ros/scan_finisher.h"

#include <exception>
#include <stdexcept>
#include <utility>

#include "svort_ros/live/threads.h"

namespace svort_ros {

ScanFinisher::ScanFinisher(const ScanArchive& archive, Done done)
    : archive_(archive), done_(std::move(done)), thread_([this] { run(); }) {}

void ScanFinisher::take(ArchivedScan scan) {
  ++count_;
  if (!inbox_.push({std::move(scan), std::chrono::steady_clock::now(), svort::thread_count()}))
    throw std::logic_error("ScanFinisher::take: it was stopped");
}

void ScanFinisher::stop() {
  stop_ = true;
  inbox_.close();
  if (thread_.joinable()) thread_.join();
}

void ScanFinisher::run() {
  for (;;) {
    Inbox<Item>::Batch batch = inbox_.take_all(true);
    for (Item& item : batch.items) {
      FinishedScan finished = finish(std::move(item));
      --count_;
      done_(std::move(finished));
    }
    if (batch.closed && batch.items.empty()) return;
  }
}

FinishedScan ScanFinisher::finish(Item item) const {
  FinishedScan result;
  result.scan = std::move(item.scan);
  svort::LivePipeline& pipeline = *result.scan.pipeline;
  try {
    const svort::OneCoreScope one_core(item.threads);
    if (!stop_) pipeline.finalise(&stop_);
    if (result.scan.decisions) result.scan.decisions->update(pipeline);
  } catch (const std::exception& error) {
    result.failure = error.what();
  }
  result.final = pipeline.estimate().final;
  const auto seconds = [&] {
    return std::chrono::duration<double>(std::chrono::steady_clock::now() - item.taken).count();
  };
  result.scan.run.wall_s += seconds();
  if (archive_.enabled()) {
    try {
      archive_.write(&result.scan);
      result.written = true;
    } catch (const std::exception& error) {
      result.not_written = error.what();
    }
  }
  result.seconds = seconds();
  return result;
}

}  // namespace svort_ros
