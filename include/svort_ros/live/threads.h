#pragma once

namespace svort {

/// Number of threads that the numerical code may use from now on; 0 takes all cores of this process.
/// @throws std::invalid_argument if `count` is negative
void set_thread_count(int count);

/// The number in use.
int thread_count();

}  // namespace svort
