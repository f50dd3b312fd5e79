#pragma once

// Option structs describe themselves through a member template
//
//     template <class Visitor> void visit(Visitor&& v) { v("key", member, "help with unit"); v.section("name", struct);
//     }
//
// so that one list serves YAML files, command lines, ROS parameters and run.json, and a default exists only once.

#include <yaml-cpp/yaml.h>

#include <CLI/CLI.hpp>
#include <filesystem>
#include <nlohmann/json.hpp>
#include <set>
#include <stdexcept>
#include <string>

namespace svort {
namespace options_detail {

class YamlReader {
 public:
  YamlReader(const YAML::Node& node, std::string file, std::string prefix)
      : node_(node), file_(std::move(file)), prefix_(std::move(prefix)) {
    if (node_ && !node_.IsNull() && !node_.IsMap())
      throw std::runtime_error(file_ + ": " + where() + " must hold keys and values");
  }

  template <class T>
  void operator()(const std::string& key, T& value, const char* /*help*/) {
    known_.insert(key);
    if (!node_ || !node_[key]) return;
    try {
      value = node_[key].template as<T>();
    } catch (const YAML::Exception&) {
      throw std::runtime_error(file_ + ": '" + prefix_ + key + "' has a value of the wrong type");
    }
  }
  template <class Options>
  void section(const std::string& key, Options& options) {
    known_.insert(key);
    if (!node_ || !node_[key]) return;
    YamlReader reader(node_[key], file_, prefix_ + key + ".");
    options.visit(reader);
    reader.reject_unknown();
  }
  /// Also repeated keys: YAML forbids them, but the parser would silently take one of the values.
  void reject_unknown() const {
    if (!node_ || !node_.IsMap()) return;
    std::set<std::string> seen;
    for (const auto& entry : node_) {
      if (!entry.first.IsScalar()) throw std::runtime_error(file_ + ": a key of " + where() + " is not a plain word");
      const std::string& key = entry.first.Scalar();
      if (!known_.count(key)) throw std::runtime_error(file_ + ": unknown key '" + prefix_ + key + "'");
      if (!seen.insert(key).second) throw std::runtime_error(file_ + ": '" + prefix_ + key + "' is there twice");
    }
  }

 private:
  std::string where() const { return prefix_.empty() ? "the file" : "'" + prefix_.substr(0, prefix_.size() - 1) + "'"; }

  YAML::Node node_;
  std::string file_;
  std::string prefix_;
  std::set<std::string> known_;
};

class CommandLineBinder {
 public:
  CommandLineBinder(CLI::App& app, std::string group, std::string prefix)
      : app_(app), group_(std::move(group)), prefix_(std::move(prefix)) {}

  template <class T>
  void operator()(const std::string& key, T& value, const char* help) {
    app_.add_option("--" + prefix_ + key, value, help)->capture_default_str()->group(group_);
  }
  template <class Options>
  void section(const std::string& key, Options& options) {
    options.visit(CommandLineBinder(app_, "Options: " + prefix_ + key, prefix_ + key + "."));
  }

 private:
  CLI::App& app_;
  std::string group_;
  std::string prefix_;
};

class JsonWriter {
 public:
  explicit JsonWriter(nlohmann::ordered_json& json) : json_(json) {}

  template <class T>
  void operator()(const std::string& key, T& value, const char* /*help*/) {
    json_[key] = value;
  }
  template <class Options>
  void section(const std::string& key, Options& options) {
    options.visit(JsonWriter(json_[key]));
  }

 private:
  nlohmann::ordered_json& json_;
};

}  // namespace options_detail

/// Overwrites the members that the YAML file names; all others keep their values, and after an error all do.
/// @throws std::runtime_error naming the file and the key: missing file, syntax error, unknown or repeated key, wrong
///         type
template <class Options>
void load_options(const std::filesystem::path& file, Options& options) {
  YAML::Node root;
  if (std::filesystem::is_directory(file)) throw std::runtime_error(file.string() + ": is a folder, not a file");
  try {
    root = YAML::LoadFile(file.string());
  } catch (const YAML::BadFile&) {
    throw std::runtime_error(file.string() + ": cannot be read");
  } catch (const YAML::Exception& error) {
    throw std::runtime_error(file.string() + ": " + error.what());
  }
  options_detail::YamlReader reader(root, file.string(), "");
  Options loaded = options;
  loaded.visit(reader);
  reader.reject_unknown();
  options = loaded;
}

/// Adds one command-line option per member, "--section.key". What the line says overrides what the struct holds.
template <class Options>
void bind_options(CLI::App& app, Options& options) {
  options.visit(options_detail::CommandLineBinder(app, "Options", ""));
}

/// The options as JSON, for run.json.
template <class Options>
nlohmann::ordered_json options_to_json(Options options) {
  nlohmann::ordered_json json = nlohmann::ordered_json::object();
  options.visit(options_detail::JsonWriter(json));
  return json;
}

}  // namespace svort
