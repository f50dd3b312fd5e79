#include "svort_ros/ros/bag.h"

#include <rosbag/bag.h>
#include <rosbag/view.h>

#include <algorithm>
#include <set>
#include <stdexcept>
#include <system_error>

namespace svort_ros {
namespace {

std::string without_slash(const std::string& topic) {
  return !topic.empty() && topic.front() == '/' ? topic.substr(1) : topic;
}

[[noreturn]] void fail(const std::filesystem::path& bag, const std::string& reason) {
  throw std::runtime_error(bag.string() + ": " + reason);
}

/// Says what is there instead of the topic that was asked for.
std::string describe_topics(const rosbag::Bag& bag) {
  std::set<std::string> topics;
  for (const rosbag::ConnectionInfo* connection : rosbag::View(bag).getConnections())
    if (connection->datatype == ros::message_traits::datatype<Slice>()) topics.insert(connection->topic);
  if (topics.empty()) return "the bag holds no slices at all";
  std::string text = "slices are on";
  for (const std::string& topic : topics) text += " " + topic;
  return text;
}

}  // namespace

std::vector<Slice> read_slices(const std::filesystem::path& path, const std::string& topic) {
  if (!std::filesystem::is_regular_file(path)) fail(path, "there is no such file");
  std::vector<Slice> slices;
  try {
    rosbag::Bag bag(path.string(), rosbag::bagmode::Read);
    rosbag::View view(bag, [&](const rosbag::ConnectionInfo* connection) {
      return without_slash(connection->topic) == without_slash(topic);
    });
    if (view.size() == 0) fail(path, "no message on topic '" + topic + "'; " + describe_topics(bag));
    for (const rosbag::MessageInstance& message : view) {
      const auto slice = message.instantiate<Slice>();
      if (!slice)
        fail(path, "topic '" + topic + "' holds " + message.getDataType() +
                       (message.getDataType() == ros::message_traits::datatype<Slice>()
                            ? " of another version of this package"
                            : ", not slices"));
      slices.push_back(*slice);
    }
  } catch (const rosbag::BagException& error) {
    fail(path, std::string("not a readable bag: ") + error.what());
  }
  return slices;
}

void write_slices(const std::filesystem::path& path, const std::vector<Slice>& slices, const std::string& topic) {
  std::filesystem::path part = path;
  part += ".part";
  try {
    rosbag::Bag bag(part.string(), rosbag::bagmode::Write);
    ros::Time last = ros::TIME_MIN;  // rosbag refuses time zero
    for (const Slice& slice : slices) {
      last = std::max(slice.header.stamp, last + ros::Duration(0, 1));
      bag.write(topic, last, slice);
    }
    bag.close();
    std::filesystem::rename(part, path);
  } catch (const std::exception& error) {
    std::error_code ignored;
    std::filesystem::remove(part, ignored);
    fail(path, std::string("cannot be written: ") + error.what());
  }
}

}  // namespace svort_ros
