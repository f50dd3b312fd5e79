// The shipped files of options for networks and training, and svort_train's own structs.

#include <gtest/gtest.h>

#include <algorithm>
#include <filesystem>

#include "svort_ros/io/options_file.h"
#include "svort_ros/training/training_config.h"

namespace svort {
namespace {

const std::filesystem::path kConfigs = std::filesystem::path(SVORT_SOURCE_DIR) / "config";

TEST(TrainingConfigs, TheLiveNetworksFileListsEveryOptionWithItsDefault) {
  LiveNetworkOptions options;
  options.dim = 1;  // what the file does not name would stay
  options.consensus.robust_mm = 1.;
  load_options(kConfigs / "network" / "live.yaml", options);
  EXPECT_EQ(options_to_json(options), options_to_json(LiveNetworkOptions()));
  const YAML::Node file = YAML::LoadFile((kConfigs / "network" / "live.yaml").string());
  const auto expected = options_to_json(LiveNetworkOptions());
  EXPECT_EQ(file.size(), expected.size());
  EXPECT_EQ(file["consensus"].size(), expected["consensus"].size());
}

TEST(TrainingConfigs, TheLiveTrainingIsOneThatTheTrainerTakes) {
  TrainingConfig config;
  load_options(kConfigs / "training" / "live.yaml", config);
  EXPECT_EQ(config.kind, "live");
  EXPECT_FALSE(config.volumes.empty());
  EXPECT_FALSE(config.note.empty());
  for (const std::string& held_out : config.held_out)
    EXPECT_EQ(std::count(config.volumes.begin(), config.volumes.end(), held_out), 0) << held_out;
  for (const std::string& protocol : config.protocols) {
    config.simulator.scanner.protocol = protocol;
    EXPECT_NO_THROW(check(config.simulator.scanner)) << protocol;
  }
  EXPECT_NO_THROW(LiveRecipe(std::make_shared<LiveNetwork>(config.network), config.recipe, 1));
}

TEST(TrainingConfigs, ThePapersTrainingsAreOnesThatTheTrainerTakes) {
  for (const auto& [file, kind] :
       {std::pair{"v1.yaml", "v1"}, std::pair{"svrnet.yaml", "svrnet"}, std::pair{"plane_in_vol.yaml", "planeinvol"}}) {
    TrainingConfig config;
    load_options(kConfigs / "training" / file, config);
    EXPECT_EQ(config.kind, kind);
    EXPECT_FALSE(config.volumes.empty()) << file;
    EXPECT_FALSE(config.note.empty()) << file;
    for (const std::string& held_out : config.held_out)
      EXPECT_EQ(std::count(config.volumes.begin(), config.volumes.end(), held_out), 0) << held_out;
    // The paper's schedule: 200,000 scans, linear to 0.
    EXPECT_EQ(config.trainer.total_steps * config.trainer.scans_per_step, 200000) << file;
    EXPECT_EQ(config.trainer.schedule, "linear") << file;
    EXPECT_EQ(config.trainer.learning_rate, 2e-4) << file;
    for (const std::string& protocol : config.protocols) {
      config.simulator.scanner.protocol = protocol;
      EXPECT_NO_THROW(check(config.simulator.scanner)) << protocol;
    }
  }
}

}  // namespace
}  // namespace svort
