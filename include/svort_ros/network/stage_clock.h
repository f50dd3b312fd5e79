#pragma once

#include <chrono>
#include <functional>
#include <map>
#include <string>
#include <utility>

namespace svort {

/// Adds up the time that the named stages of a computation take. One thread uses it.
class StageClock {
 public:
  /// @param wait called before the time is read, e.g. to wait for a GPU; may be empty
  explicit StageClock(std::function<void()> wait = {}) : wait_(std::move(wait)) {}

  /// Counts from its construction to its end.
  class Scope {
   public:
    Scope(StageClock* clock, const char* stage) : clock_(clock), stage_(stage) {
      if (clock_ != nullptr) start_ = clock_->now();
    }
    ~Scope() {
      if (clock_ == nullptr) return;
      clock_->milliseconds_[stage_] += std::chrono::duration<double, std::milli>(clock_->now() - start_).count();
    }
    Scope(const Scope&) = delete;
    Scope& operator=(const Scope&) = delete;

   private:
    StageClock* clock_;
    const char* stage_;
    std::chrono::steady_clock::time_point start_;
  };

  /// ms by stage since construction or clear().
  const std::map<std::string, double>& milliseconds() const { return milliseconds_; }
  void clear() { milliseconds_.clear(); }

 private:
  std::chrono::steady_clock::time_point now() const {
    if (wait_) wait_();
    return std::chrono::steady_clock::now();
  }

  std::function<void()> wait_;
  std::map<std::string, double> milliseconds_;
};

}  // namespace svort
