#include "svort_ros/network/join_networks.h"

#include <gtest/gtest.h>

#include "io/scratch.h"
#include "network/small_networks.h"

namespace svort {
namespace {

class JoinNetworksTest : public Scratch {
 protected:
  std::filesystem::path save(const std::string& name, std::uint64_t seed, const Provenance& provenance,
                             std::int64_t dim = 24, const std::string& network = "live") const {
    torch::manual_seed(seed);
    const OptionValues live = {
        {"input_px", std::int64_t{16}}, {"width", std::int64_t{8}},  {"dim", dim},
        {"heads", std::int64_t{2}},     {"layers", std::int64_t{1}}, {"hidden", std::int64_t{16}}};
    const NetworkInstance instance = make_network(network, network == "live" ? live : small_svort_options());
    for (torch::Tensor& parameter : instance.module->parameters()) parameter.data().normal_();
    save_network(path(name), instance, provenance);
    return path(name);
  }
};

TEST_F(JoinNetworksTest, EachPartComesFromItsFile) {
  const auto first = save("first.pt", 1, {{"scans", "140"}, {"scans before", "100"}, {"seed", "7"}, {"note", "mine"}});
  const auto shared = save("shared.pt", 2, {{"scans", "125"}, {"scans before", "100"}, {"seed", "8"}});
  const JoinedNetwork joined = join_live_networks(first, shared);
  const Checkpoint a = read_checkpoint(first), b = read_checkpoint(shared);
  int of_first = 0, of_shared = 0;
  for (const auto& entry : joined.network.module->named_parameters()) {
    const bool is_shared = entry.key().rfind("shared_", 0) == 0;
    (is_shared ? of_shared : of_first) += 1;
    EXPECT_TRUE(torch::equal(entry.value(), (is_shared ? b : a).parameters.at(entry.key()))) << entry.key();
    EXPECT_FALSE(torch::equal(entry.value(), (is_shared ? a : b).parameters.at(entry.key()))) << entry.key();
  }
  EXPECT_GT(of_first, 10);
  EXPECT_GT(of_shared, 10);
  // 100 before, 40 of the first network, 25 of the shared one.
  EXPECT_EQ(joined.provenance.at("scans"), "165");
  EXPECT_EQ(joined.provenance.at("note"), "mine");
  EXPECT_EQ(joined.provenance.at("first network"), "weights " + a.sha256 + ", after 140 scans, seed 7");
  EXPECT_EQ(joined.provenance.at("shared network"), "weights " + b.sha256 + ", after 125 scans, seed 8");
}

TEST_F(JoinNetworksTest, RefusesWhatDoesNotFit) {
  const auto first = save("first.pt", 1, {{"scans", "140"}});
  const auto wide = save("wide.pt", 2, {}, 32), v2 = save("v2.pt", 2, {}, 24, "v2"),
             odd = save("odd.pt", 2, {{"scans", "many"}});
  EXPECT_MESSAGE(join_live_networks(first, wide), "wide.pt: option 'dim' is 32, but 24 in ");
  EXPECT_MESSAGE(join_live_networks(first, v2), "v2.pt: holds the network 'v2'");
  EXPECT_MESSAGE(join_live_networks(first, odd),
                 "odd.pt: its provenance gives 'many' under 'scans', which is no number of scans");
  EXPECT_MESSAGE(join_live_networks(path("none.pt"), first), "none.pt");
  for (const auto& file : {wide, v2, odd, path("none.pt")})
    EXPECT_THROW(join_live_networks(first, file), std::runtime_error) << file;
}

}  // namespace
}  // namespace svort
