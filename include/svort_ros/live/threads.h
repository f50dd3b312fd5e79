#pragma once

namespace svort {

/// Number of threads that the numerical code may use from now on; 0 takes all cores of this process.
/// @throws std::invalid_argument if `count` is negative
void set_thread_count(int count);

/// The number in use.
int thread_count();

/// One core for what this thread computes, for as long as this object lives.
class OneCoreScope {
 public:
  /// @param after afterwards; also what threads begin with that come then (LibTorch gives them what was set last)
  explicit OneCoreScope(int after) : after_(after) { set_thread_count(1); }
  ~OneCoreScope() { set_thread_count(after_); }
  OneCoreScope(const OneCoreScope&) = delete;
  OneCoreScope& operator=(const OneCoreScope&) = delete;

 private:
  const int after_;
};

}  // namespace svort
