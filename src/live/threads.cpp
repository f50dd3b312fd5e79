#include "svort_ros/live/threads.h"

#include <ATen/Parallel.h>

#include <stdexcept>
#include <string>
#include <thread>

namespace svort {

void set_thread_count(int count) {
  if (count < 0) throw std::invalid_argument("threads must not be negative, got " + std::to_string(count));
  if (count == 0) count = static_cast<int>(std::max(1U, std::thread::hardware_concurrency()));
  at::set_num_threads(count);
}

int thread_count() { return at::get_num_threads(); }

}  // namespace svort
