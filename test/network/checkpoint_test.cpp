#include "svort_ros/network/checkpoint.h"

#include <gtest/gtest.h>
#include <torch/serialize.h>

#include <fstream>
#include <functional>
#include <iterator>
#include <limits>
#include <vector>

#include "io/scratch.h"
#include "network/small_networks.h"
#include "svort_ros/network/deterministic_weights.h"

namespace svort {
namespace {

class CheckpointTest : public Scratch {
 protected:
  void SetUp() override {
    file_ = path("weights.pt");
    torch::manual_seed(3);
    network_ = make_network("v2", small_svort_options());
  }

  /// Writes network_'s file with something changed in its dictionary.
  void write_changed(const std::function<void(c10::impl::GenericDict&)>& change) {
    save_network(file_, network_, {});
    auto content = torch::pickle_load(bytes()).toGenericDict();
    change(content);
    write(torch::pickle_save(content));
  }
  /// The same for the parameters, with a hash that fits.
  void write_changed_parameters(const std::function<void(c10::impl::GenericDict&)>& change) {
    write_changed([&](c10::impl::GenericDict& content) {
      auto parameters = content.at("parameters").toGenericDict();
      change(parameters);
      std::map<std::string, torch::Tensor> state;
      for (const auto& entry : parameters) state.emplace(entry.key().toStringRef(), entry.value().toTensor());
      content.insert_or_assign("sha256", parameter_sha256(state));
    });
  }
  std::vector<char> bytes() const {
    std::ifstream stream(file_, std::ios::binary);
    return {std::istreambuf_iterator<char>(stream), std::istreambuf_iterator<char>()};
  }
  void write(const std::vector<char>& content) const {
    std::ofstream stream(file_, std::ios::binary | std::ios::trunc);
    stream.write(content.data(), static_cast<std::streamsize>(content.size()));
  }
  /// The message of the error that loading gives; empty if it gives none.
  std::string error() const {
    try {
      load_network(file_);
    } catch (const std::runtime_error& thrown) {
      return thrown.what();
    }
    return "";
  }
  void expect_error(const std::string& part) const {
    const std::string message = error();
    EXPECT_NE(message.find(part), std::string::npos) << "message: '" << message << "', expected part: " << part;
    EXPECT_NE(message.find(file_.string()), std::string::npos) << "the file is not named: " << message;
  }

  std::filesystem::path file_;
  NetworkInstance network_;
};

TEST_F(CheckpointTest, RestoresNetworkOptionsAndProvenance) {
  save_network(file_, network_, {{"data", "phantom"}, {"steps", "12"}});
  Checkpoint checkpoint;
  const NetworkInstance loaded = load_network(file_, &checkpoint);
  EXPECT_EQ(loaded.name, "v2");
  EXPECT_EQ(loaded.options, network_.options);
  EXPECT_EQ(checkpoint.provenance, (Provenance{{"data", "phantom"}, {"steps", "12"}}));
  EXPECT_FALSE(is_untrained(checkpoint.provenance));
  EXPECT_EQ(parameter_checksum(*loaded.module), parameter_checksum(*network_.module));
}

TEST_F(CheckpointTest, SameContentIsTheSameBytes) {
  save_network(file_, network_, {{"data", "phantom"}});
  const std::vector<char> first = bytes();
  save_network(file_, network_, {{"data", "phantom"}});
  EXPECT_EQ(first, bytes());
}

TEST_F(CheckpointTest, HalfPrecisionHalvesTheFileAndKeepsElevenBits) {
  save_network(file_, network_, {});
  const auto single = std::filesystem::file_size(file_);
  save_network(file_, network_, {}, WeightPrecision::half);
  EXPECT_LT(static_cast<double>(std::filesystem::file_size(file_)), 0.75 * static_cast<double>(single));
  const NetworkInstance loaded = load_network(file_);
  const auto expected = network_.module->named_parameters();
  for (const auto& entry : loaded.module->named_parameters()) {
    EXPECT_EQ(entry.value().scalar_type(), torch::kFloat32);
    // float16 rounds to 11 bits; below 6e-5 its numbers are 6e-8 apart.
    EXPECT_TRUE(torch::allclose(entry.value(), expected[entry.key()], 0x1p-11, 6e-8)) << entry.key();
  }
}

TEST_F(CheckpointTest, HashIsSha256) {
  // Of the bytes "w\0float32 1\0" and the float 1.0 (00 00 80 3f), computed with Python.
  EXPECT_EQ(parameter_sha256({{"w", torch::ones({1})}}),
            "bc97fe14953c3c29163981e9216734a713fb2ee57837918aff911d264c43021a");
  // Longer than a block, split in two parameters: "a\0float32 40\0" + 160 zero bytes + "b\0float16 2\0" + 4 zero bytes.
  EXPECT_EQ(parameter_sha256({{"a", torch::zeros({40})}, {"b", torch::zeros({2}, torch::kFloat16)}}),
            "40a11cfa48c41f7f0c83ee5de83af5885cf93edb525eeb6fb6f5ee72232245e5");
}

TEST_F(CheckpointTest, NamesWhatIsWrongWithTheFile) {
  expect_error("cannot be read");
  save_network(file_, network_, {});
  const std::vector<char> whole = bytes();
  for (const double part : {0., 0.3, 0.9, 0.999}) {
    write({whole.begin(), whole.begin() + static_cast<std::ptrdiff_t>(part * static_cast<double>(whole.size()))});
    expect_error("is truncated");
  }
  write_changed([](auto& content) { content.insert_or_assign("version", std::int64_t{2}); });
  expect_error("is of format version 2; this program reads version 1");
  write_changed([](auto& content) { content.insert_or_assign("format", "other"); });
  expect_error("its format is 'other'");
  write_changed([](auto& content) { EXPECT_EQ(content.erase("options"), 1U); });
  expect_error("the key 'options' is missing");
  write_changed([](auto& content) { content.insert_or_assign("colour", "red"); });
  expect_error("unknown key 'colour'");
  write_changed([](auto& content) { content.insert_or_assign("network", "v9"); });
  expect_error("there is no network 'v9'; known: v1, v2, live");
  write(torch::pickle_save(torch::zeros({3})));
  expect_error("the file is not a dictionary");
}

TEST_F(CheckpointTest, NamesTheOptionThatIsWrong) {
  const auto set = [this](const c10::IValue& key, const c10::IValue& value) {
    write_changed([&](auto& content) { content.at("options").toGenericDict().insert_or_assign(key, value); });
  };
  set("heads", std::int64_t{3});
  expect_error("features is 64; it must be a positive multiple of heads");
  set("heads", "two");
  expect_error("option 'heads' has a value of the wrong type");
  set("wings", std::int64_t{2});
  expect_error("unknown option 'wings'");
}

TEST_F(CheckpointTest, NamesTheParametersThatAreWrong) {
  write_changed_parameters([](auto& parameters) { EXPECT_EQ(parameters.erase("svrnet1.fc.bias"), 1U); });
  expect_error("does not fit network v2: missing svrnet1.fc.bias");
  write_changed_parameters([](auto& parameters) { parameters.insert("tail", torch::zeros({2})); });
  expect_error("does not fit network v2: unknown tail");
  write_changed_parameters([](auto& parameters) { parameters.insert_or_assign("svrnet1.fc.bias", torch::zeros({8})); });
  expect_error("other shapes of svrnet1.fc.bias (8, expected 9)");
  write_changed_parameters([](auto& parameters) {
    parameters.insert_or_assign("svrnet1.fc.bias", torch::full({9}, std::numeric_limits<float>::quiet_NaN()));
  });
  expect_error("NaN or infinity in svrnet1.fc.bias");
}

TEST_F(CheckpointTest, OneChangedWeightIsNoticed) {
  write_changed([](auto& content) {
    torch::Tensor bias = content.at("parameters").toGenericDict().at("svrnet2.fc.bias").toTensor();
    bias[4] += 1e-3;
  });
  expect_error("is damaged: the parameters' SHA-256 is");
}

TEST_F(CheckpointTest, SavingWithoutAFolderIsAnError) {
  EXPECT_THROW(save_network(path("none") / "weights.pt", network_, {}), std::runtime_error);
}

TEST(NetworkRegistry, NamesTheNetworkAndTheOption) {
  const auto error = [](const std::string& name, const OptionValues& options) -> std::string {
    try {
      make_network(name, options);
    } catch (const std::invalid_argument& thrown) {
      return thrown.what();
    }
    return "";
  };
  EXPECT_NE(error("v3", {}).find("there is no network 'v3'"), std::string::npos);
  EXPECT_NE(error("v1", {{"depth", std::int64_t{3}}}).find("network v1: unknown option 'depth'"), std::string::npos);
  EXPECT_NE(error("v1", {{"encoder_depth", std::int64_t{33}}}).find("depth is 33; it must be 18, 34 or 50"),
            std::string::npos);
  EXPECT_NE(error("v1", {{"gelu", 1.}}).find("option 'gelu' has a value of the wrong type"), std::string::npos);
}

}  // namespace
}  // namespace svort
