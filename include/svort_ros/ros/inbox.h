#pragma once

#include <condition_variable>
#include <cstddef>
#include <deque>
#include <mutex>
#include <utility>

namespace svort_ros {

/// First in, first out between ROS callbacks and the worker. Unbounded: nothing that was taken in is lost.
template <class Item>
class Inbox {
 public:
  /// @return false if the inbox was closed; the item is not taken then
  bool push(Item item) {
    {
      const std::lock_guard<std::mutex> lock(mutex_);
      if (closed_) return false;
      items_.push_back(std::move(item));
    }
    changed_.notify_one();
    return true;
  }

  struct Batch {
    std::deque<Item> items;
    bool closed = false;  ///< nothing will come after these
  };
  /// Everything that is waiting. With `wait`, at least one item, unless the inbox is closed.
  Batch take_all(bool wait) {
    std::unique_lock<std::mutex> lock(mutex_);
    if (wait) changed_.wait(lock, [this] { return closed_ || !items_.empty(); });
    return {std::exchange(items_, {}), closed_};
  }

  /// What waits already can still be taken.
  void close() {
    {
      const std::lock_guard<std::mutex> lock(mutex_);
      closed_ = true;
    }
    changed_.notify_all();
  }

  std::size_t size() const {
    const std::lock_guard<std::mutex> lock(mutex_);
    return items_.size();
  }
  bool closed() const {
    const std::lock_guard<std::mutex> lock(mutex_);
    return closed_;
  }

 private:
  mutable std::mutex mutex_;
  std::condition_variable changed_;
  std::deque<Item> items_;
  bool closed_ = false;
};

}  // namespace svort_ros
