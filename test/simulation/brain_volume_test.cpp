#include "svort_ros/simulation/brain_volume.h"

#include <gtest/gtest.h>
#include <torch/serialize.h>
#include <torch/types.h>

#include <filesystem>
#include <fstream>
#include <iterator>
#include <string>

namespace svort {
namespace {

/// Packs of volumes: what a machine without a NIfTI library trains from.
class VolumePack : public testing::Test {
 protected:
  void SetUp() override {
    folder_ = std::filesystem::path(testing::TempDir()) / "svort_volume_pack";
    std::filesystem::remove_all(folder_);
    std::filesystem::create_directories(folder_);
  }
  void TearDown() override { std::filesystem::remove_all(folder_); }

  static BrainVolume phantom(const std::string& name, double resolution_mm, std::uint64_t seed) {
    PhantomOptions options;
    options.resolution_mm = resolution_mm;
    options.seed = seed;
    BrainVolume volume = make_phantom(options);
    volume.name = name;
    return volume;
  }
  static std::string message(const std::filesystem::path& path) {
    try {
      load_brain_volumes(path);
    } catch (const std::runtime_error& error) {
      return error.what();
    }
    return "nothing was thrown";
  }
  /// A pack, as it is or with one entry changed.
  std::filesystem::path pack_with(const std::string& name, const std::string& key, const torch::Tensor& value) const {
    save_brain_volumes(folder_ / "whole.pt", {phantom("A", 4., 1)});
    std::ifstream file(folder_ / "whole.pt", std::ios::binary);
    const std::vector<char> bytes((std::istreambuf_iterator<char>(file)), std::istreambuf_iterator<char>());
    const c10::impl::GenericDict whole = torch::pickle_load(bytes).toGenericDict();
    c10::Dict<std::string, torch::Tensor> changed;
    for (const auto& entry : whole)
      if (entry.key().toStringRef() != key || value.defined())
        changed.insert(entry.key().toStringRef(), entry.key().toStringRef() == key ? value : entry.value().toTensor());
    const std::vector<char> result = torch::pickle_save(changed);
    std::ofstream(folder_ / name, std::ios::binary).write(result.data(), static_cast<std::streamsize>(result.size()));
    return folder_ / name;
  }

  std::filesystem::path folder_;
};

TEST_F(VolumePack, ReadsBackWhatItWrote) {
  BrainVolume first = phantom("folder/A.nii.gz", 4., 1), second = phantom("B", 3., 2);
  second.labels = torch::Tensor();  // a volume without parcellation
  save_brain_volumes(folder_ / "pack.pt", {first, second});
  EXPECT_FALSE(std::filesystem::exists(folder_ / "pack.pt.partial"));
  const std::vector<BrainVolume> read = load_brain_volumes(folder_ / "pack.pt");
  ASSERT_EQ(read.size(), 2U);
  EXPECT_EQ(read[0].name, "folder/A.nii.gz");
  EXPECT_EQ(read[1].name, "B");
  EXPECT_EQ(read[0].resolution_mm, 4.);
  EXPECT_EQ(read[1].resolution_mm, 3.);
  EXPECT_TRUE(torch::equal(read[0].image, first.image));
  EXPECT_TRUE(torch::equal(read[0].mask, first.mask));
  EXPECT_TRUE(torch::equal(read[0].labels, first.labels));
  EXPECT_TRUE(torch::equal(read[1].image, second.image));
  EXPECT_FALSE(read[1].labels.defined());
  for (const BrainVolume& volume : read) EXPECT_NO_THROW(check(volume));
}

TEST_F(VolumePack, NamesTheFileAndWhatIsWrongWithIt) {
  EXPECT_NE(message(folder_ / "none.pt").find("none.pt"), std::string::npos);
  std::ofstream(folder_ / "text.pt") << "not a pack";
  EXPECT_NE(message(folder_ / "text.pt").find("text.pt"), std::string::npos);

  EXPECT_EQ(message(pack_with("same.pt", "nothing", {})), "nothing was thrown");
  const auto says_file = [&](const std::string& name, const std::string& key, const torch::Tensor& value) {
    const std::string said = message(pack_with(name, key, value));
    EXPECT_NE(said.find(name), std::string::npos) << said;
  };
  says_file("no_mask.pt", "mask_0", {});
  says_file("other_mask.pt", "mask_0", torch::ones({2, 2, 2}, torch::kBool));
  says_file("no_format.pt", "format", {});
  says_file("more.pt", "count", torch::tensor(std::int64_t{2}));
  says_file("dark.pt", "image_0", torch::zeros_like(phantom("A", 4., 1).image));

  std::ifstream file(folder_ / "same.pt", std::ios::binary);
  std::string bytes((std::istreambuf_iterator<char>(file)), std::istreambuf_iterator<char>());
  bytes.resize(bytes.size() / 2);
  std::ofstream(folder_ / "cut.pt", std::ios::binary) << bytes;
  EXPECT_NE(message(folder_ / "cut.pt").find("cut.pt"), std::string::npos);
}

}  // namespace
}  // namespace svort
