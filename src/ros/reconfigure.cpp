#include "svort_ros/ros/reconfigure.h"

#include <limits>
#include <set>
#include <stdexcept>
#include <utility>

namespace svort_ros {
namespace {

using dynamic_reconfigure::Config;

/// Walks through the options; names are those of the visitor, sections joined by "__".
class ConfigWriter {
 public:
  ConfigWriter(Config* config, std::string prefix) : config_(config), prefix_(std::move(prefix)) {}

  void operator()(const std::string& key, bool& value, const char* /*help*/) {
    dynamic_reconfigure::BoolParameter parameter;
    parameter.name = prefix_ + key;
    parameter.value = static_cast<std::uint8_t>(value);
    config_->bools.push_back(parameter);
  }
  void operator()(const std::string& key, int& value, const char* /*help*/) {
    dynamic_reconfigure::IntParameter parameter;
    parameter.name = prefix_ + key;
    parameter.value = value;
    config_->ints.push_back(parameter);
  }
  void operator()(const std::string& key, double& value, const char* /*help*/) {
    dynamic_reconfigure::DoubleParameter parameter;
    parameter.name = prefix_ + key;
    parameter.value = value;
    config_->doubles.push_back(parameter);
  }
  template <class Options>
  void section(const std::string& key, Options& options) {
    options.visit(ConfigWriter(config_, prefix_ + key + "__"));
  }

 private:
  Config* config_;
  std::string prefix_;
};

/// Takes the values of a message; what it takes is crossed off.
class ConfigReader {
 public:
  ConfigReader(const Config* config, std::set<std::string>* left, std::string prefix)
      : config_(config), left_(left), prefix_(std::move(prefix)) {}

  void operator()(const std::string& key, bool& value, const char* /*help*/) {
    for (const auto& parameter : config_->bools)
      if (take(parameter.name, key)) value = parameter.value != 0;
  }
  void operator()(const std::string& key, int& value, const char* /*help*/) {
    for (const auto& parameter : config_->ints)
      if (take(parameter.name, key)) value = parameter.value;
  }
  void operator()(const std::string& key, double& value, const char* /*help*/) {
    for (const auto& parameter : config_->doubles)
      if (take(parameter.name, key)) value = parameter.value;
    for (const auto& parameter : config_->ints)  // "3" for "3.0" is what people write
      if (take(parameter.name, key)) value = parameter.value;
  }
  template <class Options>
  void section(const std::string& key, Options& options) {
    options.visit(ConfigReader(config_, left_, prefix_ + key + "__"));
  }

 private:
  bool take(const std::string& name, const std::string& key) {
    if (name != prefix_ + key) return false;
    left_->erase(name);
    return true;
  }

  const Config* config_;
  std::set<std::string>* left_;
  std::string prefix_;
};

class Describer {
 public:
  Describer(dynamic_reconfigure::Group* group, std::string prefix) : group_(group), prefix_(std::move(prefix)) {}

  void operator()(const std::string& key, bool& /*value*/, const char* help) { add(key, "bool", help); }
  void operator()(const std::string& key, int& /*value*/, const char* help) { add(key, "int", help); }
  void operator()(const std::string& key, double& /*value*/, const char* help) { add(key, "double", help); }
  template <class Options>
  void section(const std::string& key, Options& options) {
    options.visit(Describer(group_, prefix_ + key + "__"));
  }

 private:
  void add(const std::string& key, const char* type, const char* help) {
    dynamic_reconfigure::ParamDescription description;
    description.name = prefix_ + key;
    description.type = type;
    description.description = help;
    group_->parameters.push_back(description);
  }

  dynamic_reconfigure::Group* group_;
  std::string prefix_;
};

dynamic_reconfigure::GroupState default_group() {
  dynamic_reconfigure::GroupState state;
  state.name = "Default";
  state.state = 1;
  return state;
}

/// The ranges that sliders show; what is really allowed the options' own checks say.
Config limits(const svort::DecisionOptions& options, bool upper) {
  Config config = to_config(options);
  for (auto& each : config.bools) each.value = static_cast<std::uint8_t>(upper);
  for (auto& each : config.ints) each.value = upper ? 1000 : 0;
  for (auto& each : config.doubles) each.value = upper ? 1000. : -1000.;
  return config;
}

}  // namespace

Config to_config(const svort::DecisionOptions& options) {
  Config config;
  svort::DecisionOptions copy = options;
  copy.visit(ConfigWriter(&config, ""));
  config.groups.push_back(default_group());
  return config;
}

void apply_config(const Config& config, svort::DecisionOptions* options) {
  std::set<std::string> left;
  for (const auto& each : config.bools) left.insert(each.name);
  for (const auto& each : config.ints) left.insert(each.name);
  for (const auto& each : config.doubles) left.insert(each.name);
  for (const auto& each : config.strs) left.insert(each.name);
  svort::DecisionOptions changed = *options;
  changed.visit(ConfigReader(&config, &left, ""));
  if (!left.empty())
    throw std::invalid_argument("threshold '" + *left.begin() + "' is unknown, or of another type than the one given");
  *options = changed;
}

dynamic_reconfigure::ConfigDescription describe(const svort::DecisionOptions& defaults) {
  dynamic_reconfigure::ConfigDescription description;
  dynamic_reconfigure::Group group;
  group.name = "Default";
  svort::DecisionOptions copy = defaults;
  copy.visit(Describer(&group, ""));
  description.groups.push_back(group);
  description.dflt = to_config(defaults);
  description.min = limits(defaults, false);
  description.max = limits(defaults, true);
  return description;
}

ReconfigureServer::ReconfigureServer(const ros::NodeHandle& nh, const svort::DecisionOptions& options,
                                     std::function<svort::DecisionOptions(const Config&)> change)
    : nh_(nh),
      descriptions_(nh_.advertise<dynamic_reconfigure::ConfigDescription>("parameter_descriptions", 1, true)),
      updates_(nh_.advertise<Config>("parameter_updates", 1, true)) {
  descriptions_.publish(describe(svort::DecisionOptions()));
  updates_.publish(to_config(options));
  service_ =
      nh_.advertiseService<dynamic_reconfigure::Reconfigure::Request, dynamic_reconfigure::Reconfigure::Response>(
          "set_parameters", [this, change](dynamic_reconfigure::Reconfigure::Request& request,
                                           dynamic_reconfigure::Reconfigure::Response& response) {
            response.config = to_config(change(request.config));
            updates_.publish(response.config);
            return true;
          });
}

}  // namespace svort_ros
