#pragma once

#include <ATen/Parallel.h>

#include <algorithm>
#include <cstdint>
#include <exception>
#include <system_error>
#include <thread>
#include <vector>

namespace svort {

/// Number of threads that parallel_chunks() uses: LibTorch's intra-op setting, 1 inside its parallel regions.
inline int worker_count() { return at::in_parallel_region() ? 1 : std::max(1, at::get_num_threads()); }

/// Calls body(begin, end) on consecutive chunks of [0, count), one per thread; rethrows the first chunk's exception.
///
/// at::parallel_for is a serial loop in code that is not compiled with the OpenMP runtime that LibTorch itself was
/// built with, which a package cannot know; threads of the standard library work with every build.
template <class Body>
void parallel_chunks(std::int64_t count, const Body& body) {
  const std::int64_t chunks = std::min<std::int64_t>(worker_count(), count);
  if (chunks <= 1) {
    if (count > 0) body(std::int64_t{0}, count);
    return;
  }
  std::vector<std::exception_ptr> errors(static_cast<std::size_t>(chunks));
  const auto run = [&](std::int64_t chunk) {
    try {
      body(count * chunk / chunks, count * (chunk + 1) / chunks);
    } catch (...) {
      errors[static_cast<std::size_t>(chunk)] = std::current_exception();
    }
  };
  std::vector<std::thread> threads;
  threads.reserve(static_cast<std::size_t>(chunks - 1));
  for (std::int64_t chunk = 1; chunk < chunks; ++chunk) {
    try {
      threads.emplace_back(run, chunk);
    } catch (const std::system_error&) {
      run(chunk);  // no thread to be had: slower, not wrong
    }
  }
  run(0);
  for (std::thread& thread : threads) thread.join();
  for (const std::exception_ptr& error : errors) {
    if (error) std::rethrow_exception(error);
  }
}

}  // namespace svort
