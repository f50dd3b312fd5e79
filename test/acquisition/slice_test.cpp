#include "svort_ros/acquisition/slice.h"

#include <gtest/gtest.h>

#include <algorithm>
#include <limits>
#include <stdexcept>

namespace svort {
namespace {

TEST(Slice, IsDescribedForMessages) {
  SliceInfo info;
  info.scan_id = "fetus7";
  info.stack = 1;
  info.index = 4;
  EXPECT_EQ(describe(info), "stack 1 slice 4 of scan fetus7");
}

TEST(Slice, InterleavedOrder) {
  EXPECT_EQ(interleaved_order(5, 2), (std::vector<int>{0, 2, 4, 1, 3}));
  EXPECT_EQ(interleaved_order(7, 3), (std::vector<int>{0, 3, 6, 1, 4, 2, 5}));
  EXPECT_EQ(interleaved_order(3, 1), (std::vector<int>{0, 1, 2}));
  EXPECT_EQ(interleaved_order(2, std::numeric_limits<int>::max()), (std::vector<int>{0, 1}));
  EXPECT_TRUE(interleaved_order(0, 2).empty());
  for (int interleave = 1; interleave < 12; ++interleave) {
    std::vector<int> order = interleaved_order(10, interleave);
    std::sort(order.begin(), order.end());
    EXPECT_EQ(order, (std::vector<int>{0, 1, 2, 3, 4, 5, 6, 7, 8, 9})) << interleave;
  }
  EXPECT_THROW(interleaved_order(-1, 2), std::invalid_argument);
  EXPECT_THROW(interleaved_order(3, 0), std::invalid_argument);
}

}  // namespace
}  // namespace svort
