#include "svort_ros/ros/inbox.h"

#include <gtest/gtest.h>

#include <future>
#include <thread>
#include <vector>

namespace svort_ros {
namespace {

TEST(Inbox, KeepsTheOrder) {
  Inbox<int> inbox;
  for (int i = 0; i < 5; ++i) EXPECT_TRUE(inbox.push(i));
  EXPECT_EQ(inbox.size(), 5U);
  EXPECT_EQ(inbox.take_all(true).items, (std::deque<int>{0, 1, 2, 3, 4}));
  EXPECT_TRUE(inbox.take_all(false).items.empty());
}

TEST(Inbox, LosesNothingBetweenThreads) {
  constexpr int kSenders = 4;
  constexpr int kItems = 5000;
  Inbox<int> inbox;
  std::vector<std::thread> senders;
  for (int s = 0; s < kSenders; ++s)
    senders.emplace_back([&inbox, s] {
      for (int i = 0; i < kItems; ++i) inbox.push(s * kItems + i);
    });
  std::vector<int> next(kSenders, 0);
  for (int taken = 0; taken < kSenders * kItems;)
    for (const int item : inbox.take_all(true).items) {
      EXPECT_EQ(item % kItems, next.at(static_cast<std::size_t>(item / kItems))++);  // in order for each sender
      ++taken;
    }
  for (std::thread& sender : senders) sender.join();
}

TEST(Inbox, ClosingWakesTheReaderAndLeavesWhatWaits) {
  Inbox<int> inbox;
  auto reader = std::async(std::launch::async, [&inbox] { return inbox.take_all(true); });
  inbox.close();
  const auto batch = reader.get();
  EXPECT_TRUE(batch.closed);
  EXPECT_TRUE(batch.items.empty());
  EXPECT_FALSE(inbox.push(1));

  Inbox<int> other;
  other.push(7);
  other.close();
  const auto rest = other.take_all(true);
  EXPECT_TRUE(rest.closed);
  EXPECT_EQ(rest.items, std::deque<int>{7});
}

}  // namespace
}  // namespace svort_ros
