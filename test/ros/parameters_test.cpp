#include "svort_ros/ros/parameters.h"

#include <gtest/gtest.h>

#include <filesystem>
#include <functional>

#include "svort_ros/io/options_file.h"

namespace svort_ros {
namespace {

using XmlRpc::XmlRpcValue;

ServerOptions read(const XmlRpcValue& tree) {
  ServerOptions options;
  ParameterReader reader(tree, "/svort/");
  options.visit(reader);
  validate(options.node);
  return options;
}

/// The message of the error that reading the tree throws.
std::string error_of(const XmlRpcValue& tree) {
  try {
    read(tree);
  } catch (const std::exception& error) {
    return error.what();
  }
  return "no error";
}

TEST(Parameters, AreReadFromTheirSections) {
  XmlRpcValue tree;
  tree["node"]["queue_size"] = 7;
  tree["node"]["scanner_frame"] = std::string("magnet");
  tree["sequence"]["margin_mm"] = 4;  // an integer for a floating-point option
  tree["sequence"]["intensity"]["quantile"] = 0.5;
  tree["estimator"]["final_volume"]["passes"] = 3;
  tree["diagnostic_period"] = 2.0;  // not ours
  const ServerOptions options = read(tree);
  EXPECT_EQ(options.node.queue_size, 7);
  EXPECT_EQ(options.node.scanner_frame, "magnet");
  EXPECT_DOUBLE_EQ(options.pipeline.sequence.margin_mm, 4.);
  EXPECT_DOUBLE_EQ(options.pipeline.sequence.intensity.quantile, 0.5);
  EXPECT_EQ(options.pipeline.estimator.final_volume.passes, 3);
  EXPECT_EQ(options.node.brain_frame, NodeOptions().brain_frame);  // not given: default
  EXPECT_EQ(read(XmlRpcValue()).node.queue_size, NodeOptions().queue_size);
}

TEST(Parameters, UnknownKeysAndWrongTypesAreNamed) {
  XmlRpcValue tree;
  tree["sequence"]["intensity"]["quantil"] = 0.5;
  EXPECT_EQ(error_of(tree), "parameter /svort/sequence/intensity/quantil is unknown");
  tree = XmlRpcValue();
  tree["node"]["queue_size"] = 7.5;
  EXPECT_EQ(error_of(tree), "parameter /svort/node/queue_size has a value of the wrong type; it must be an integer");
  tree = XmlRpcValue();
  tree["estimator"]["method"] = 3;
  EXPECT_EQ(error_of(tree), "parameter /svort/estimator/method has a value of the wrong type; it must be a string");
  tree = XmlRpcValue();
  tree["sequence"]["margin_mm"] = std::string("3");
  EXPECT_EQ(error_of(tree), "parameter /svort/sequence/margin_mm has a value of the wrong type; it must be a number");
  tree = XmlRpcValue();
  tree["node"] = 5;
  EXPECT_NE(error_of(tree).find("parameter /svort/node must hold parameters"), std::string::npos);
}

TEST(Parameters, ListsComeAsListOrText) {
  struct Options {
    std::vector<std::string> files;
    bool flag = false;
    void visit(ParameterReader& v) {
      v("files", files, "");
      v("flag", flag, "");
    }
  };
  const auto read_files = [](const XmlRpcValue& value) {
    XmlRpcValue tree;
    tree["files"] = value;
    tree["flag"] = XmlRpcValue(true);
    Options options;
    ParameterReader reader(tree, "/player/");
    options.visit(reader);
    EXPECT_TRUE(options.flag);
    return options.files;
  };
  const std::vector<std::string> expected{"a.nii", "b.nii"};
  XmlRpcValue list;
  list[0] = std::string("a.nii");
  list[1] = std::string("b.nii");
  EXPECT_EQ(read_files(list), expected);
  EXPECT_EQ(read_files(std::string("a.nii  b.nii")), expected);
  EXPECT_EQ(read_files(std::string("[a.nii, b.nii]")), expected);
  EXPECT_TRUE(read_files(std::string("")).empty());
  XmlRpcValue numbers;
  numbers[0] = 1;
  EXPECT_THROW(read_files(numbers), std::runtime_error);
}

TEST(NodeOptions, OutOfRangeValuesAreNamed) {
  const auto expect_error = [](const std::string& name, const std::function<void(NodeOptions&)>& change) {
    NodeOptions options;
    change(options);
    try {
      validate(options);
      ADD_FAILURE() << name << " was accepted";
    } catch (const std::invalid_argument& error) {
      EXPECT_NE(std::string(error.what()).find("node." + name), std::string::npos) << error.what();
    }
  };
  EXPECT_NO_THROW(validate(NodeOptions()));
  expect_error("scanner_frame", [](NodeOptions& o) { o.scanner_frame = ""; });
  expect_error("scanner_frame", [](NodeOptions& o) { o.scanner_frame = "/scanner"; });
  expect_error("brain_frame", [](NodeOptions& o) { o.brain_frame = "a b"; });
  expect_error("brain_frame", [](NodeOptions& o) { o.brain_frame = o.scanner_frame; });
  expect_error("queue_size", [](NodeOptions& o) { o.queue_size = 0; });
  expect_error("threads", [](NodeOptions& o) { o.threads = -1; });
  expect_error("volume_every", [](NodeOptions& o) { o.volume_every = 0; });
  expect_error("repetition_time_s", [](NodeOptions& o) { o.repetition_time_s = 0.; });
  expect_error("no_slice_warning_s", [](NodeOptions& o) { o.no_slice_warning_s = -3.; });
  expect_error("surface_threshold", [](NodeOptions& o) { o.surface_threshold = 1.; });
  expect_error("surface_resolution_mm", [](NodeOptions& o) { o.surface_resolution_mm = 0.; });
  expect_error("cloud_threshold", [](NodeOptions& o) { o.cloud_threshold = -0.1; });
}

const std::filesystem::path kConfigs = std::filesystem::path(SVORT_SOURCE_DIR) / "config" / "node";

TEST(ConfigFiles, AllLoadAndMakeAPipeline) {
  int count = 0;
  for (const auto& entry : std::filesystem::directory_iterator(kConfigs)) {
    ServerOptions options;
    ASSERT_NO_THROW(svort::load_options(entry.path(), options)) << entry.path();
    EXPECT_NO_THROW(validate(options.node)) << entry.path();
    EXPECT_NO_THROW(svort::LivePipeline pipeline(options.pipeline)) << entry.path();
    ++count;
  }
  EXPECT_GE(count, 2);
}

/// Collects the names of all keys.
struct KeyCollector {
  std::set<std::string>* keys;
  std::string prefix;
  template <class T>
  void operator()(const std::string& key, T&, const char*) {
    keys->insert(prefix + key);
  }
  template <class Options>
  void section(const std::string& key, Options& options) {
    options.visit(KeyCollector{keys, prefix + key + "."});
  }
};

void collect(const YAML::Node& node, const std::string& prefix, std::set<std::string>* keys) {
  for (const auto& entry : node) {
    const std::string key = prefix + entry.first.as<std::string>();
    if (entry.second.IsMap())
      collect(entry.second, key + ".", keys);
    else
      keys->insert(key);
  }
}

TEST(ConfigFiles, DefaultsNameEveryKeyWithTheValueOfTheStruct) {
  ServerOptions loaded;
  svort::load_options(kConfigs / "default.yaml", loaded);
  EXPECT_EQ(svort::options_to_json(loaded), svort::options_to_json(ServerOptions()));

  std::set<std::string> expected;
  ServerOptions options;
  options.visit(KeyCollector{&expected, ""});
  std::set<std::string> found;
  collect(YAML::LoadFile((kConfigs / "default.yaml").string()), "", &found);
  EXPECT_EQ(found, expected);
}

}  // namespace
}  // namespace svort_ros
