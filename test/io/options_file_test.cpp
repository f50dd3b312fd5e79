#include "svort_ros/io/options_file.h"

#include "io/scratch.h"
#include "svort_ros/live/live_pipeline.h"

namespace svort {
namespace {

struct Inner {
  double length_mm = 2.5;
  bool flag = false;
  template <class Visitor>
  void visit(Visitor&& v) {
    v("length_mm", length_mm, "a length, mm");
    v("flag", flag, "a switch");
  }
};
struct Outer {
  int count = 3;
  std::string name = "default";
  Inner inner;
  template <class Visitor>
  void visit(Visitor&& v) {
    v("count", count, "a count");
    v("name", name, "a name");
    v.section("inner", inner);
  }
};

using OptionsFile = Scratch;

TEST_F(OptionsFile, OverwritesWhatTheFileNames) {
  Outer options;
  load_options(write("a.yaml", "count: 7\ninner:\n  length_mm: 1.5  # comment\n"), options);
  EXPECT_EQ(options.count, 7);
  EXPECT_EQ(options.name, "default");
  EXPECT_EQ(options.inner.length_mm, 1.5);
  EXPECT_FALSE(options.inner.flag);
}

TEST_F(OptionsFile, EmptyFilesAndSectionsChangeNothing) {
  for (const std::string content : {"", "# nothing\n", "inner:\n", "{}\n"}) {
    Outer options;
    load_options(write("a.yaml", content), options);
    EXPECT_EQ(options.count, 3);
    EXPECT_EQ(options.inner.length_mm, 2.5);
  }
}

TEST_F(OptionsFile, NamesFileAndKeyOfEveryFault) {
  const auto message = [this](const std::string& content) {
    Outer options;
    const std::string text = message_of([&] { load_options(write("a.yaml", content), options); });
    EXPECT_EQ(options.count, 3) << "changed in spite of the error";
    EXPECT_EQ(text.rfind(path("a.yaml").string() + ": ", 0), 0U) << text;
    return text.substr(path("a.yaml").string().size() + 2);
  };
  EXPECT_EQ(message("count: 5\ncuont: 7\n"), "unknown key 'cuont'");
  EXPECT_EQ(message("count: 5\ninner:\n  length: 7\n"), "unknown key 'inner.length'");
  EXPECT_EQ(message("count: many\n"), "'count' has a value of the wrong type");
  EXPECT_EQ(message("count: 1.5\n"), "'count' has a value of the wrong type");
  EXPECT_EQ(message("count: [1, 2]\n"), "'count' has a value of the wrong type");
  EXPECT_EQ(message("count:\n"), "'count' has a value of the wrong type");
  EXPECT_EQ(message("count: 5\ninner:\n  flag: perhaps\n"), "'inner.flag' has a value of the wrong type");
  EXPECT_EQ(message("count: 5\ninner: 7\n"), "'inner' must hold keys and values");
  EXPECT_EQ(message("- count\n"), "the file must hold keys and values");
  EXPECT_EQ(message("count: 5\ncount: 6\n"), "'count' is there twice");
  EXPECT_EQ(message("count: 5\n[1, 2]: 6\n"), "a key of the file is not a plain word");
  EXPECT_TRUE(contains(message("count: [5\n"), "line 2"));
}

TEST_F(OptionsFile, NamesMissingFiles) {
  Outer options;
  EXPECT_MESSAGE(load_options(path("none.yaml"), options), path("none.yaml").string() + ": cannot be read");
  EXPECT_MESSAGE(load_options(path(""), options), "is a folder");
}

TEST_F(OptionsFile, CommandLineOverridesTheFile) {
  Outer options;
  load_options(write("a.yaml", "count: 7\nname: file\ninner:\n  length_mm: 1.5\n  flag: true\n"), options);
  CLI::App app;
  bind_options(app, options);
  app.parse("--count 9 --inner.length_mm=0.25");
  EXPECT_EQ(options.count, 9);
  EXPECT_EQ(options.name, "file");
  EXPECT_EQ(options.inner.length_mm, 0.25);
  EXPECT_TRUE(options.inner.flag);
}

TEST_F(OptionsFile, CommandLineFaults) {
  Outer options;
  CLI::App app;
  bind_options(app, options);
  EXPECT_THROW(app.parse("--inner.length_mm long"), CLI::ParseError);
  EXPECT_THROW(app.parse("--inner.lenght_mm 1"), CLI::ParseError);
}

TEST_F(OptionsFile, HelpNamesDefaults) {
  Outer options;
  CLI::App app;
  bind_options(app, options);
  EXPECT_TRUE(contains(app.help(), "--inner.length_mm"));
  EXPECT_TRUE(contains(app.help(), "a length, mm"));
  EXPECT_TRUE(contains(app.help(), "2.5"));
}

TEST_F(OptionsFile, JsonHoldsEveryOption) {
  Outer options;
  options.name = "x";
  EXPECT_EQ(options_to_json(options).dump(), R"({"count":3,"name":"x","inner":{"length_mm":2.5,"flag":false}})");
}

/// What run.json says of the options can be read back as a configuration (JSON is YAML).
TEST_F(OptionsFile, PipelineOptionsSurviveARoundTrip) {
  PipelineOptions options;
  options.sequence.margin_mm = 4.25;
  options.sequence.intensity.quantile = 0.9;
  options.estimator.cg_iterations = 5;
  const auto file = write("a.yaml", options_to_json(options).dump(2));
  PipelineOptions loaded;
  load_options(file, loaded);
  EXPECT_EQ(options_to_json(loaded), options_to_json(options));
  EXPECT_NE(options_to_json(loaded), options_to_json(PipelineOptions()));
}

}  // namespace
}  // namespace svort
