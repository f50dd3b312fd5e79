#include "svort_ros/acquisition/slice.h"

#include <stdexcept>

namespace svort {

std::string describe(const SliceInfo& info) {
  return "stack " + std::to_string(info.stack) + " slice " + std::to_string(info.index) + " of scan " + info.scan_id;
}

std::vector<int> interleaved_order(int count, int interleave) {
  if (count < 0) {
    throw std::invalid_argument("interleaved_order: count is " + std::to_string(count) + ", must not be negative");
  }
  if (interleave < 1) {
    throw std::invalid_argument("interleaved_order: interleave is " + std::to_string(interleave) +
                                ", must be at least 1");
  }
  std::vector<int> order;
  order.reserve(static_cast<std::size_t>(count));
  for (int first = 0; first < interleave && first < count; ++first) {
    for (int index = first; index < count; index += interleave) {
      order.push_back(index);
      if (index > count - interleave) break;  // index + interleave could overflow
    }
  }
  return order;
}

}  // namespace svort
