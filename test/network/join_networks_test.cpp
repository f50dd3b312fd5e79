#include "svort_ros/network/join_networks.h"

#include <gtest/gtest.h>

#include <map>
#include <string>

#include "io/scratch.h"
#include "network/small_networks.h"

namespace svort {
namespace {

class JoinNetworksTest : public Scratch {
 protected:
  std::filesystem::path save(const std::string& name, std::uint64_t seed, const Provenance& provenance,
                             std::int64_t dim = 24, const std::string& network = "live",
                             std::int64_t frame_width = 0) const {
    torch::manual_seed(seed);
    const OptionValues live = {
        {"input_px", std::int64_t{16}}, {"width", std::int64_t{8}},  {"dim", dim},
        {"heads", std::int64_t{2}},     {"layers", std::int64_t{1}}, {"hidden", std::int64_t{16}},
        {"frame_width", frame_width}};
    const NetworkInstance instance = make_network(network, network == "live" ? live : small_svort_options());
    for (torch::Tensor& parameter : instance.module->parameters()) parameter.data().normal_();
    save_network(path(name), instance, provenance);
    return path(name);
  }
};

TEST_F(JoinNetworksTest, EachPartComesFromItsFile) {
  const auto first = save("first.pt", 1, {{"scans", "140"}, {"scans before", "100"}, {"seed", "7"}, {"note", "mine"}});
  const auto shared = save("shared.pt", 2, {{"scans", "125"}, {"scans before", "100"}, {"seed", "8"}});
  const auto frame = save("frame.pt", 3, {{"scans", "111"}, {"scans before", "100"}}, 24, "live", 8);
  const JoinedNetwork joined = join_live_networks(first, {{"shared", shared}, {"frame", frame}});
  const std::map<std::string, Checkpoint> files = {
      {"first", read_checkpoint(first)}, {"shared", read_checkpoint(shared)}, {"frame", read_checkpoint(frame)}};
  std::map<std::string, int> count;
  for (const auto& entry : joined.network.module->named_parameters()) {
    const std::string part = entry.key().substr(0, entry.key().find('_'));
    ++count[part];
    for (const auto& [name, file] : files) {
      const auto found = file.parameters.find(entry.key());
      EXPECT_EQ(found != file.parameters.end() && torch::equal(entry.value(), found->second), name == part)
          << name << " " << entry.key();
    }
  }
  for (const auto& [name, file] : files) EXPECT_GT(count[name], 5) << name;
  EXPECT_EQ(to_string(joined.network.options.at("frame_width")), "8");
  // 100 before, 40 of the first network, 25 of the shared one, 11 of the frame network.
  EXPECT_EQ(joined.provenance.at("scans"), "176");
  EXPECT_EQ(joined.provenance.at("note"), "mine");
  const auto origin = [&](const char* part, const char* rest) {
    EXPECT_EQ(joined.provenance.at(std::string(part) + " network"), "weights " + files.at(part).sha256 + rest);
  };
  origin("first", ", after 140 scans, seed 7");
  origin("shared", ", after 125 scans, seed 8");
  origin("frame", ", after 111 scans");

  // Joined again: what stays says where it came from.
  save_network(path("joined.pt"), joined.network, joined.provenance);
  const auto later = save("later.pt", 4, {{"scans", "230"}, {"scans before", "200"}});
  const JoinedNetwork again = join_live_networks(path("joined.pt"), {{"first", later}});
  EXPECT_EQ(again.provenance.at("scans"), "206");
  EXPECT_EQ(again.provenance.at("first network"), "weights " + read_checkpoint(later).sha256 + ", after 230 scans");
  EXPECT_EQ(again.provenance.at("shared network"), joined.provenance.at("shared network"));
  EXPECT_EQ(to_string(again.network.options.at("frame_width")), "8");
}

TEST_F(JoinNetworksTest, RefusesWhatDoesNotFit) {
  const auto first = save("first.pt", 1, {{"scans", "140"}});
  const auto wide = save("wide.pt", 2, {}, 32), v2 = save("v2.pt", 2, {}, 24, "v2"),
             odd = save("odd.pt", 2, {{"scans", "many"}});
  EXPECT_MESSAGE(join_live_networks(first, {{"shared", wide}}), "wide.pt: option 'dim' is 32, but 24 in ");
  EXPECT_MESSAGE(join_live_networks(first, {{"shared", v2}}), "v2.pt: holds the network 'v2'");
  EXPECT_MESSAGE(join_live_networks(first, {{"shared", odd}}),
                 "odd.pt: its provenance gives 'many' under 'scans', which is no number of scans");
  EXPECT_MESSAGE(join_live_networks(path("none.pt"), {{"shared", first}}), "none.pt");
  EXPECT_MESSAGE(join_live_networks(first, {{"frame", first}}), "first.pt: has no frame network");
  for (const auto& file : {wide, v2, odd, path("none.pt")})
    EXPECT_THROW(join_live_networks(first, {{"shared", file}}), std::runtime_error) << file;
  EXPECT_THROW(join_live_networks(first, {{"frame", first}}), std::runtime_error);
  EXPECT_MESSAGE(join_live_networks(first, {{"second", first}}), "no part 'second'");
}

}  // namespace
}  // namespace svort
