// What a table of methods consists of: its file, its networks.

#include <algorithm>
#include <memory>
#include <set>
#include <sstream>
#include <stdexcept>

#include "svort_ros/io/brain_volume_file.h"
#include "svort_ros/io/evaluation_table.h"
#include "svort_ros/io/options_file.h"
#include "svort_ros/network/checkpoint.h"

namespace svort {
namespace {

/// The file: the plan's own options and its rows.
struct PlanFile {
  TablePlan plan;
  YAML::Node rows;

  template <class Visitor>
  void visit(Visitor&& v) {
    plan.visit(v);
    v("rows", rows, "the methods");
  }
};

[[noreturn]] void fail(const std::filesystem::path& file, const std::string& what) {
  throw std::runtime_error(file.string() + ": " + what);
}

template <class Values>
bool holds(const Values& values, const std::string& value) {
  return std::find(values.begin(), values.end(), value) != values.end();
}

void check_row(const std::filesystem::path& file, const std::string& where, const TableRowPlan& row) {
  if (row.name.empty()) fail(file, where + " has no name");
  if (row.name.find_first_of(",\"\r\n|") != std::string::npos)
    fail(file, where + ".name '" + row.name + "' must have no comma, quote, bar or line break");
  const std::string name = where + " ('" + row.name + "')";
  if (!holds(std::vector<std::string>{"network", "registration", "search", "nominal"}, row.poses))
    fail(file, name + ": poses is '" + row.poses + "'; it must be network, registration, search or nominal");
  if (!holds(std::vector<std::string>{"", "positional_embedding", "volume"}, row.ablation))
    fail(file, name + ": ablation is '" + row.ablation + "'; it must be positional_embedding or volume");
  if (row.iterations < 0 || row.iterations > 100) fail(file, name + ": iterations must be 0 to 100");
  if (row.poses != "network" && row.poses != "search" && !(row.weights.empty() && row.network.empty()))
    fail(file, name + ": weights and network belong to rows with poses: network or search");
  if (row.poses != "network" && !(row.ablation.empty() && row.iterations == 0))
    fail(file, name + ": ablation and iterations belong to rows with poses: network");
}

std::vector<std::string> split_names(const std::string& text) {
  std::vector<std::string> names;
  std::istringstream stream(text);
  for (std::string name; std::getline(stream, name, ',');) {
    const std::size_t first = name.find_first_not_of(' ');
    if (first != std::string::npos) names.push_back(volume_name(name.substr(first)));
  }
  return names;
}

/// The ablation that a network was trained with, in the words of the plan; several joined by "+".
std::string ablation_of(const OptionValues& options) {
  std::string ablation;
  for (const auto& [key, word] :
       {std::pair{"positional_embedding", "positional_embedding"}, std::pair{"volume_conditioned", "volume"}}) {
    const auto found = options.find(key);
    if (found != options.end() && !std::get<bool>(found->second))
      ablation += (ablation.empty() ? "" : "+") + std::string(word);
  }
  return ablation;
}

TableRow load_row(const TablePlan& plan, const TableRowPlan& row, const RunnerOptions& runner) {
  TableRow result;
  result.method.name = row.name;
  const bool guided = row.poses == "search" && !row.weights.empty();
  if (row.poses != "network") {
    result.method.source = row.poses == "nominal" ? PoseSource::nominal : PoseSource::registration;
    result.method.search = row.poses == "search";
    if (!guided) return result;
  }
  if (row.weights.empty()) throw std::runtime_error("names no weights");
  Checkpoint about;
  NetworkInstance network = load_network(row.weights, &about);
  if (is_untrained(about.provenance)) throw std::runtime_error(row.weights + ": the weights are untrained");
  if (!row.network.empty() && row.network != network.name)
    throw std::runtime_error(row.weights + ": holds network '" + network.name + "', not '" + row.network + "'");
  if (const std::string ablation = ablation_of(network.options); ablation != row.ablation)
    throw std::runtime_error(row.weights + ": was trained " +
                             (ablation.empty() ? "without an ablation" : "without " + ablation) +
                             "; the row's ablation is '" + row.ablation + "'");
  for (const std::string& trained : split_names(about.provenance["trained on"]))
    for (const std::string& tested : plan.volumes)
      if (volume_name(tested) == trained)
        throw std::runtime_error(row.weights + ": was trained on " + trained + ", which the table tests");
  result.scans_seen = scans_seen(about.provenance, row.weights);
  result.method.weights_sha256 = about.sha256;
  if (guided) {
    if (network.name != "live")
      throw std::runtime_error(row.weights + ": holds network '" + network.name + "'; only 'live' guides registration");
    result.method.guide = row.weights;
    return result;
  }
  result.method.source = PoseSource::network;
  result.method.iterations = row.iterations;
  result.method.network = std::make_shared<NetworkRunner>(std::move(network), runner);
  return result;
}

}  // namespace

TablePlan read_table_plan(const std::filesystem::path& file) {
  PlanFile content;
  load_options(file, content);
  TablePlan plan = content.plan;
  if (plan.volumes.empty()) fail(file, "volumes is missing: files of brains to simulate scans of");
  std::set<std::string> names;
  for (const std::string& volume : plan.volumes)
    if (const std::string name = volume_name(volume); name.find(',') != std::string::npos || !names.insert(name).second)
      fail(file, "volumes: '" + name + "' is there twice, or has a comma in its name");
  if (plan.motions.empty() || plan.seeds.empty()) fail(file, "motions and seeds must each name at least one");
  if (plan.scans < 1) fail(file, "scans must be positive");
  if (plan.stacks < 1 || plan.stacks > 3) fail(file, "stacks must be 1 to 3");
  if (plan.protocol != "scanner" && plan.protocol != "uniform")
    fail(file, "protocol is '" + plan.protocol + "'; it must be scanner or uniform");
  if (!content.rows.IsSequence() || content.rows.size() == 0) fail(file, "rows must be a list of at least one row");
  names.clear();
  for (std::size_t i = 0; i < content.rows.size(); ++i) {
    const std::string where = "rows[" + std::to_string(i) + "]";
    TableRowPlan row;
    options_detail::YamlReader reader(content.rows[i], file.string(), where + ".");
    row.visit(reader);
    reader.reject_unknown();
    check_row(file, where, row);
    if (!names.insert(row.name).second) fail(file, where + ": there are two rows '" + row.name + "'");
    plan.rows.push_back(row);
  }
  return plan;
}

TableRows load_table_rows(const TablePlan& plan, const RunnerOptions& runner) {
  TableRows result;
  for (const TableRowPlan& row : plan.rows) {
    try {
      result.rows.push_back(load_row(plan, row, runner));
    } catch (const std::runtime_error& error) {
      result.refused.emplace_back(row.name, error.what());
    }
  }
  return result;
}

}  // namespace svort
