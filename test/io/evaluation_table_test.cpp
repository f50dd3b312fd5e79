#include "svort_ros/io/evaluation_table.h"

#include <torch/types.h>

#include <cmath>

#include "io/scratch.h"
#include "svort_ros/network/checkpoint.h"

namespace svort {
namespace {

class EvaluationTable : public Scratch {
 protected:
  /// A file of random weights of a tiny live network.
  std::string weights(const std::string& name, const Provenance& provenance, bool embedding = true) const {
    torch::manual_seed(1);
    const NetworkInstance network = make_network("live", {{"width", std::int64_t{8}},
                                                          {"dim", std::int64_t{12}},
                                                          {"heads", std::int64_t{2}},
                                                          {"layers", std::int64_t{1}},
                                                          {"hidden", std::int64_t{8}},
                                                          {"positional_embedding", embedding}});
    save_network(path(name), network, provenance);
    return path(name).string();
  }
  std::string phantom() const {
    PhantomOptions options;
    options.length_mm = 60.;
    BrainVolume brain = make_phantom(options);
    brain.name = "folder/P40.nii.gz";
    save_brain_volumes(path("phantom.pt"), {brain});
    return path("phantom.pt").string();
  }
  TablePlan plan(const std::string& rows) const {
    return read_table_plan(write("plan.yaml", "volumes: [atlas/P40.nii.gz]\nrows:\n" + rows));
  }
  std::string error(const std::string& content) const {
    return message_of([&] { read_table_plan(write("plan.yaml", content)); });
  }
};

TEST_F(EvaluationTable, TheShippedTableHasThePapersRows) {
  const TablePlan shipped =
      read_table_plan(std::filesystem::path(SVORT_SOURCE_DIR) / "config" / "evaluation" / "table1.yaml");
  std::vector<std::string> names;
  for (const TableRowPlan& row : shipped.rows) names.push_back(row.name);
  EXPECT_EQ(names, (std::vector<std::string>{"SVoRT (live)", "SVRnet", "PlaneInVol", "without PE", "without Vol",
                                             "K = 1", "K = 2", "SVR only", "SVR with searches",
                                             "SVR guided by SVoRT (live)", "nominal"}));
  EXPECT_EQ(shipped.seeds.size(), 4U);
  EXPECT_EQ(shipped.volumes.size(), 4U);
  EXPECT_EQ(shipped.rows[5].iterations, 1);
  EXPECT_EQ(shipped.rows[3].ablation, "positional_embedding");
}

TEST_F(EvaluationTable, ErrorsNameTheFileAndTheKey) {
  const std::string volumes = "volumes: [A.nii.gz]\n", row = "rows: [{name: n, poses: nominal}]\n";
  EXPECT_EQ(error(volumes + row), "nothing was thrown");
  EXPECT_TRUE(contains(error(row), "plan.yaml: volumes is missing"));
  EXPECT_TRUE(contains(error(volumes), "rows must be a list"));
  EXPECT_TRUE(contains(error(volumes + "rows: [{poses: nominal}]"), "rows[0] has no name"));
  EXPECT_TRUE(contains(error(volumes + "rows: [{name: 'a,b'}]"), "must have no comma"));
  EXPECT_TRUE(contains(error(volumes + "rows: [{name: a, poses: guess}]"), "poses is 'guess'"));
  EXPECT_TRUE(contains(error(volumes + "rows: [{name: a, ablation: x}]"), "ablation is 'x'"));
  EXPECT_TRUE(contains(error(volumes + "rows: [{name: a, poses: nominal, weights: w}]"), "belong to rows with poses"));
  EXPECT_TRUE(
      contains(error(volumes + "rows: [{name: a, poses: search, iterations: 2}]"), "belong to rows with poses"));
  EXPECT_TRUE(contains(error(volumes + "rows: [{name: a, wieghts: w}]"), "unknown key 'rows[0].wieghts'"));
  EXPECT_TRUE(contains(error(volumes + "rows: [{name: a}, {name: a}]"), "there are two rows 'a'"));
  EXPECT_TRUE(contains(error(volumes + row + "stacks: 4\n"), "stacks must be 1 to 3"));
  EXPECT_TRUE(contains(error(volumes + row + "protocol: any\n"), "protocol is 'any'"));
}

TEST_F(EvaluationTable, RowsThatCannotBeMeasuredAreRefusedByName) {
  const std::string usual = weights("usual.pt", {{"scans", "4000"}, {"trained on", "a/X1.nii.gz, a/X2.nii.gz"}});
  const std::string blind = weights("blind.pt", {{"scans", "1000"}}, false);
  const std::string untrained = weights("untrained.pt", {{"untrained", "yes"}});
  const std::string cheating = weights("cheating.pt", {{"scans", "9"}, {"trained on", "X1.nii, elsewhere/P40.nii"}});
  const TableRows rows =
      load_table_rows(plan("  - {name: good, weights: " + usual + ", network: live, iterations: 2}\n" +          //
                           "  - {name: without PE, weights: " + blind + ", ablation: positional_embedding}\n" +  //
                           "  - {name: absent, weights: " + path("none.pt").string() + "}\n" +                   //
                           "  - {name: nothing}\n" +                                                             //
                           "  - {name: random, weights: " + untrained + "}\n" +                                  //
                           "  - {name: cheat, weights: " + cheating + "}\n" +                                    //
                           "  - {name: other network, weights: " + usual + ", network: svrnet}\n" +              //
                           "  - {name: not ablated, weights: " + usual + ", ablation: volume}\n" +               //
                           "  - {name: secretly ablated, weights: " + blind + "}\n" +                            //
                           "  - {name: nominal, poses: nominal}\n" +                                             //
                           "  - {name: SVR, poses: registration}\n  - {name: searches, poses: search}\n" +       //
                           "  - {name: guided, poses: search, weights: " + usual + "}\n"),
                      {"cpu"});
  ASSERT_EQ(rows.rows.size(), 6U);
  EXPECT_EQ(rows.rows[5].method.source, PoseSource::registration);
  EXPECT_TRUE(rows.rows[5].method.search);
  EXPECT_EQ(rows.rows[5].method.guide, usual);
  EXPECT_EQ(rows.rows[5].scans_seen, 4000);
  EXPECT_EQ(rows.rows[5].method.weights_sha256.size(), 64U);
  EXPECT_TRUE(rows.rows[4].method.guide.empty());
  EXPECT_EQ(rows.rows[3].method.source, PoseSource::registration);
  EXPECT_FALSE(rows.rows[3].method.search);
  EXPECT_EQ(rows.rows[4].method.source, PoseSource::registration);
  EXPECT_TRUE(rows.rows[4].method.search);
  EXPECT_EQ(rows.rows[0].method.name, "good");
  EXPECT_EQ(rows.rows[0].method.iterations, 2);
  EXPECT_EQ(rows.rows[0].method.weights_sha256.size(), 64U);
  EXPECT_EQ(rows.rows[0].scans_seen, 4000);
  EXPECT_EQ(rows.rows[1].method.name, "without PE");
  EXPECT_EQ(rows.rows[2].method.source, PoseSource::nominal);
  const std::vector<std::pair<std::string, std::string>> expected = {
      {"absent", "none.pt"},
      {"nothing", "names no weights"},
      {"random", "untrained"},
      {"cheat", "was trained on P40"},
      {"other network", "holds network 'live', not 'svrnet'"},
      {"not ablated", "was trained without an ablation"},
      {"secretly ablated", "was trained without positional_embedding"}};
  ASSERT_EQ(rows.refused.size(), expected.size());
  for (std::size_t i = 0; i < expected.size(); ++i) {
    EXPECT_EQ(rows.refused[i].first, expected[i].first);
    EXPECT_TRUE(contains(rows.refused[i].second, expected[i].second)) << rows.refused[i].second;
  }
}

TEST_F(EvaluationTable, TheTableHoldsMeansDeviationsAndWhoWasTrainedLess) {
  const TablePlan table = plan("  - {name: much}\n  - {name: little}\n  - {name: nominal, poses: nominal}\n");
  torch::manual_seed(1);
  TableRows rows;
  for (const auto& [name, scans] : {std::pair<const char*, std::int64_t>{"much", 8000}, {"little", 2000}}) {
    TableRow row;
    row.method.name = name;
    row.method.weights_sha256 = std::string(64, 'a');
    row.method.network = std::make_shared<NetworkRunner>(
        make_network("svrnet", {{"width", std::int64_t{8}}, {"dim", std::int64_t{4}}}), RunnerOptions{"cpu"});
    row.scans_seen = scans;
    rows.rows.push_back(row);
  }
  rows.refused.emplace_back("SVRnet", "svrnet.pt: cannot be read");
  const auto score = [](const std::string& method, std::uint64_t seed, double ed) {
    TableScore result;
    result.method = method;
    result.weights = "aaaaaaaaaaaa";
    result.protocol = "scanner";
    result.brain = "P40";
    result.motion = "moderate";
    result.seed = seed;
    result.stacks = 3;
    result.own.ed_mm = ed;
    result.refined.ed_mm = 1.;
    result.weighted.psnr_db = 20.;
    return result;
  };
  TableScore other_weights = score("much", 3, 1000.), fewer_stacks = score("much", 3, 1000.);
  other_weights.weights = "bbbbbbbbbbbb";
  fewer_stacks.stacks = 1;
  const std::string text = table_markdown(
      table, rows, {score("much", 1, 4.), score("much", 2, 6.), score("little", 1, 9.), other_weights, fewer_stacks});
  EXPECT_TRUE(contains(text, "| much | 2 | 5.00 (1.41) | - | - | - | 20.00 (0.00) |")) << text;
  EXPECT_TRUE(contains(text, "| much | 2 | 1.00 (0.00) | -4.00 (1.41) |")) << text;
  EXPECT_TRUE(contains(text, "| little | 1 | 9.00 |")) << text;
  EXPECT_TRUE(contains(text, "* much was trained on 8000 scans.")) << text;
  EXPECT_TRUE(contains(text, "* little was **trained less**: 2000 scans, 25 % of the 8000 of much.")) << text;
  EXPECT_TRUE(contains(text, "Not measured:\n\n* SVRnet: svrnet.pt: cannot be read")) << text;
}

TEST_F(EvaluationTable, IsMeasuredAndGoesOnWhereItStopped) {
  const std::string content = "volumes: [" + phantom() +
                              "]\nseeds: [1]\nstacks: 1\nmotions: [mild]\nrows:\n  - {name: net, weights: " +
                              weights("net.pt", {{"scans", "10"}}) +
                              "}\n  - {name: SVR only, poses: registration}\n  - {name: nominal, poses: nominal}\n"
                              "  - {name: lost, weights: none.pt}\n";
  TableRun run;
  run.plan = write("plan.yaml", content);
  run.output = path("results");
  run.threads = 1;
  EstimatorOptions& estimator = run.pipeline.estimator;
  run.pipeline.sequence.size_px = 64;
  run.pipeline.sequence.resolution_mm = 2.;
  estimator.registration.finest_mm = 2.;
  estimator.volume_resolution_mm = estimator.final_volume.resolution_mm = 2.;
  estimator.final_volume.passes = 1;
  EXPECT_MESSAGE(measure_table(run), "lost: none.pt");
  EXPECT_FALSE(std::filesystem::exists(run.output)) << "nothing is measured before all is known to be there";

  run.available = true;
  run.rows = {"net", "SVR only", "lost"};
  measure_table(run);
  const std::string first = read(run.output / "table.csv");
  EXPECT_EQ(std::count(first.begin(), first.end(), '\n'), 3);  // head, two methods on one scan
  run.rows.clear();
  measure_table(run);
  const std::string whole = read(run.output / "table.csv");
  EXPECT_EQ(std::count(whole.begin(), whole.end(), '\n'), 4);
  EXPECT_EQ(whole.substr(0, first.size()), first) << "what was there was not measured again: its times are the same";
  const auto unchanged = std::filesystem::last_write_time(run.output / "table.csv");
  measure_table(run);
  EXPECT_EQ(std::filesystem::last_write_time(run.output / "table.csv"), unchanged);
  const std::string markdown = read(run.output / "table.md");
  EXPECT_TRUE(contains(markdown, "| nominal | 1 |")) << markdown;
  EXPECT_TRUE(contains(markdown, "* lost: none.pt")) << markdown;
  for (const char* file :
       {"error_by_distance.png", "relative_error_by_distance.png", "error_by_stacks.png",
        "relative_error_by_stacks.png", "error_by_slices_seen.png", "relative_error_by_slices_seen.png",
        "volumes_net.png", "volumes_svr_only.png", "attention_net.png", "slices.csv", "prefixes.csv"})
    EXPECT_GT(std::filesystem::file_size(run.output / file), 200U) << file;
  run.rows = {"no such row"};
  EXPECT_MESSAGE(measure_table(run), "plan.yaml: has no row 'no such row'");
}

}  // namespace
}  // namespace svort
