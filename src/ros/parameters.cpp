#include "svort_ros/ros/parameters.h"

#include <ros/param.h>

#include <algorithm>
#include <cmath>
#include <sstream>
#include <utility>

namespace svort_ros {
namespace {

using XmlRpc::XmlRpcValue;

template <class Value>
void require(bool condition, const char* option, const Value& value, const char* range) {
  if (condition) return;
  std::ostringstream message;
  message << "node." << option << " is " << value << "; it must be " << range;
  throw std::invalid_argument(message.str());
}

bool is_frame_name(const std::string& name) {
  return !name.empty() && name.front() != '/' && name.find_first_of(" \t\n") == std::string::npos;
}

/// Command lines and launch files can pass strings only: "[a, b]", or words with blanks between them.
std::vector<std::string> split(std::string text) {
  if (text.size() >= 2 && text.front() == '[' && text.back() == ']') {
    text = text.substr(1, text.size() - 2);
    std::replace(text.begin(), text.end(), ',', ' ');
  }
  std::istringstream line(text);
  std::vector<std::string> words;
  for (std::string word; line >> word;) words.push_back(word);
  return words;
}

bool is_fraction(double value) { return value > 0. && value < 1.; }
bool is_positive(double value) { return value > 0. && std::isfinite(value); }

}  // namespace

void validate(const NodeOptions& options) {
  require(is_frame_name(options.scanner_frame), "scanner_frame", "'" + options.scanner_frame + "'",
          "a tf name: not empty, no blanks, no leading slash");
  require(is_frame_name(options.brain_frame), "brain_frame", "'" + options.brain_frame + "'",
          "a tf name: not empty, no blanks, no leading slash");
  require(options.brain_frame != options.scanner_frame, "brain_frame", "'" + options.brain_frame + "'",
          "another name than node.scanner_frame");
  require(options.queue_size >= 1, "queue_size", options.queue_size, "at least 1");
  require(options.threads >= 0, "threads", options.threads, "zero (all cores) or positive");
  require(options.volume_every >= 1, "volume_every", options.volume_every, "at least 1");
  require(is_positive(options.repetition_time_s), "repetition_time_s", options.repetition_time_s, "positive");
  require(is_positive(options.no_slice_warning_s), "no_slice_warning_s", options.no_slice_warning_s, "positive");
  require(is_fraction(options.surface_threshold), "surface_threshold", options.surface_threshold, "between 0 and 1");
  require(is_positive(options.surface_resolution_mm), "surface_resolution_mm", options.surface_resolution_mm,
          "positive");
  require(is_fraction(options.cloud_threshold), "cloud_threshold", options.cloud_threshold, "between 0 and 1");
}

ParameterReader::ParameterReader(XmlRpcValue tree, std::string prefix)
    : tree_(std::move(tree)), prefix_(std::move(prefix)) {
  if (tree_.valid() && tree_.getType() != XmlRpcValue::TypeStruct)
    throw std::runtime_error("parameter " + prefix_.substr(0, prefix_.size() - 1) +
                             " must hold parameters, not a single value");
}

XmlRpcValue* ParameterReader::find(const std::string& key) {
  known_.insert(key);
  return tree_.valid() && tree_.hasMember(key) ? &tree_[key] : nullptr;
}

void ParameterReader::wrong_type(const std::string& key, const char* expected) const {
  throw std::runtime_error("parameter " + prefix_ + key + " has a value of the wrong type; it must be " + expected);
}

void ParameterReader::operator()(const std::string& key, bool& value, const char* /*help*/) {
  XmlRpcValue* node = find(key);
  if (!node) return;
  if (node->getType() != XmlRpcValue::TypeBoolean) wrong_type(key, "true or false");
  value = static_cast<bool>(*node);
}

void ParameterReader::operator()(const std::string& key, int& value, const char* /*help*/) {
  XmlRpcValue* node = find(key);
  if (!node) return;
  if (node->getType() != XmlRpcValue::TypeInt) wrong_type(key, "an integer");
  value = static_cast<int>(*node);
}

void ParameterReader::operator()(const std::string& key, double& value, const char* /*help*/) {
  XmlRpcValue* node = find(key);
  if (!node) return;
  if (node->getType() == XmlRpcValue::TypeInt)  // "3" for "3.0" is what people write
    value = static_cast<int>(*node);
  else if (node->getType() == XmlRpcValue::TypeDouble)
    value = static_cast<double>(*node);
  else
    wrong_type(key, "a number");
}

void ParameterReader::operator()(const std::string& key, std::string& value, const char* /*help*/) {
  XmlRpcValue* node = find(key);
  if (!node) return;
  if (node->getType() != XmlRpcValue::TypeString) wrong_type(key, "a string");
  value = static_cast<std::string>(*node);
}

void ParameterReader::operator()(const std::string& key, std::vector<std::string>& value, const char* /*help*/) {
  XmlRpcValue* node = find(key);
  if (!node) return;
  std::vector<std::string> words;
  if (node->getType() == XmlRpcValue::TypeString) {
    words = split(static_cast<std::string>(*node));
  } else if (node->getType() == XmlRpcValue::TypeArray) {
    for (int i = 0; i < node->size(); ++i) {
      if ((*node)[i].getType() != XmlRpcValue::TypeString) wrong_type(key, "a list of strings");
      words.push_back(static_cast<std::string>((*node)[i]));
    }
  } else {
    wrong_type(key, "a list of strings");
  }
  value = std::move(words);
}

void ParameterReader::reject_unknown() const {
  if (!tree_.valid()) return;
  XmlRpcValue tree = tree_;  // XmlRpc iterates over mutable values only
  for (const auto& entry : tree)
    if (!known_.count(entry.first)) throw std::runtime_error("parameter " + prefix_ + entry.first + " is unknown");
}

ParameterReader read_parameters(const ros::NodeHandle& nh) {
  XmlRpcValue tree;
  ros::param::get(nh.getNamespace(), tree);
  return {tree, nh.getNamespace() + "/"};
}

ServerOptions load_parameters(const ros::NodeHandle& private_nh) {
  ServerOptions options;
  ParameterReader reader = read_parameters(private_nh);
  options.visit(reader);  // beside the sections, the namespace may hold other people's parameters
  validate(options.node);
  validate(options.decision);
  return options;
}

}  // namespace svort_ros
