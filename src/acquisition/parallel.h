#pragma once

#include <ATen/Parallel.h>

#include <algorithm>
#include <atomic>
#include <cstdint>
#include <exception>
#include <system_error>
#include <thread>
#include <vector>

namespace svort {

/// Number of threads that the functions below use: LibTorch's intra-op setting, 1 inside its parallel regions.
inline int worker_count() { return at::in_parallel_region() ? 1 : std::max(1, at::get_num_threads()); }

/// Calls body(worker) for worker 0 .. count - 1, each in a thread of its own; rethrows the first worker's exception.
///
/// at::parallel_for is a serial loop in code that is not compiled with the OpenMP runtime that LibTorch itself was
/// built with, which a package cannot know; threads of the standard library work with every build.
template <class Body>
void run_workers(std::int64_t count, const Body& body) {
  if (count <= 1) {
    if (count == 1) body(std::int64_t{0});
    return;
  }
  std::vector<std::exception_ptr> errors(static_cast<std::size_t>(count));
  const auto run = [&](std::int64_t worker) {
    try {
      body(worker);
    } catch (...) {
      errors[static_cast<std::size_t>(worker)] = std::current_exception();
    }
  };
  std::vector<std::thread> threads;
  threads.reserve(static_cast<std::size_t>(count - 1));
  for (std::int64_t worker = 1; worker < count; ++worker) {
    try {
      threads.emplace_back(run, worker);
    } catch (const std::system_error&) {
      run(worker);  // no thread to be had: slower, not wrong
    }
  }
  run(0);
  for (std::thread& thread : threads) thread.join();
  for (const std::exception_ptr& error : errors) {
    if (error) std::rethrow_exception(error);
  }
}

/// Calls body(begin, end) on consecutive chunks of [0, count), one per thread.
template <class Body>
void parallel_chunks(std::int64_t count, const Body& body) {
  const std::int64_t chunks = std::min<std::int64_t>(worker_count(), count);
  run_workers(chunks, [&](std::int64_t chunk) { body(count * chunk / chunks, count * (chunk + 1) / chunks); });
}

/// Calls body(task) for every task of [0, count), in any order; a thread takes the next task when it is free.
template <class Body>
void parallel_tasks(std::int64_t count, const Body& body) {
  std::atomic<std::int64_t> next{0};
  run_workers(std::min<std::int64_t>(worker_count(), count), [&](std::int64_t) {
    for (std::int64_t task = next++; task < count; task = next++) body(task);
  });
}

}  // namespace svort
