#pragma once

#include <cstdint>
#include <filesystem>
#include <optional>
#include <string>
#include <utility>
#include <vector>

#include "svort_ros/evaluation/method_table.h"

namespace svort {

/// One row of a table of methods, as its file describes it.
struct TableRowPlan {
  std::string name;  ///< in the table; no comma, quote or line break
  /// network; registration (refinement from the scanner's poses); search (registration of the whole scan, with what is
  /// searched for at its end); or nominal (the scanner's poses)
  std::string poses = "network";
  std::string weights;  ///< of a network: its file; of a search: the live network that guides it
  std::string network;  ///< if not empty, the network that the file must hold
  /// What the network was trained without: "", "positional_embedding" or "volume". The file must say the same.
  std::string ablation;
  int iterations = 0;  ///< K; 0: as many as the network was made for

  template <class Visitor>
  void visit(Visitor&& v) {
    v("name", name, "of the row");
    v("poses", poses, "network, registration, search or nominal");
    v("weights", weights, "file of the network's weights; of a search: of the live network that guides it");
    v("network", network, "if not empty, the network that the file must hold");
    v("ablation", ablation, "what the network was trained without: positional_embedding or volume");
    v("iterations", iterations, "transformation updates; 0: as many as the network was made for");
  }
};

/// A table of methods: which scans, which rows.
struct TablePlan {
  std::vector<std::string> volumes;                 ///< files of brains that no row's network was trained on
  std::string templates;                            ///< folder of brains; those of `volumes` in it are left out
  std::vector<std::string> motions = {"moderate"};  ///< motion classes
  std::vector<std::uint64_t> seeds = {1, 2, 3, 4};  ///< of the simulation
  int scans = 1;                                    ///< of each brain, motion class and seed
  int stacks = 3;                                   ///< of the table; fewer are measured for a figure
  std::string protocol = "scanner";                 ///< see ScannerOptions
  std::vector<TableRowPlan> rows;

  /// All but the rows.
  template <class Visitor>
  void visit(Visitor&& v) {
    v("volumes", volumes, "files of brain volumes to simulate scans of; none that a network was trained on");
    v("templates", templates, "folder of brains for rows without a canonical frame; those of volumes are left out");
    v("motions", motions, "motion classes");
    v("seeds", seeds, "of the simulation");
    v("scans", scans, "scans of each volume, motion class and seed");
    v("stacks", stacks, "stacks of a scan, 1 to 3");
    v("protocol", protocol, "scanner (stacks share the scanner's axes) or uniform (each stack in any orientation)");
  }
};

/// @throws std::runtime_error naming the file and the key: what load_options() throws for, a row without a name or with
///         one that is there already, an unknown kind of poses, weights of a row that has no network, values out of
///         range
TablePlan read_table_plan(const std::filesystem::path& file);

/// A row that can be measured.
struct TableRow {
  TableMethod method;
  std::optional<std::int64_t> scans_seen;  ///< in training, as the weights say; unknown for others' weights
};

/// The rows of a plan.
struct TableRows {
  std::vector<TableRow> rows;
  std::vector<std::pair<std::string, std::string>> refused;  ///< name, and why it cannot be measured
};

/// Loads the networks. A row is refused, never filled by another network, if its weights are missing or broken, hold
/// another network or another ablation than the row says, have not been trained, or were trained on one of the volumes
/// that the table tests.
TableRows load_table_rows(const TablePlan& plan, const RunnerOptions& runner);

/// The tables: Markdown for people. Scores of other tables are left out. Mean (standard deviation) over scans.
std::string table_markdown(const TablePlan& plan, const TableRows& rows, const std::vector<TableScore>& scores);

/// PNG files in `folder`: errors by the slice's distance from the brain's centre, by number of stacks, and by number
/// of slices seen so far; each absolute and relative. @throws std::runtime_error naming the file
void plot_table(const std::filesystem::path& folder, const TablePlan& plan, const TableRows& rows,
                const std::vector<TableScore>& scores, const std::vector<TableSlice>& slices,
                const std::vector<TablePrefix>& prefixes);

/// PNG files in `folder`: volumes_ROW.png and, of a network with attention, attention_ROW.png.
/// @throws std::runtime_error naming the file
void plot_table_pictures(const std::filesystem::path& folder, const TableScore& score, const TablePictures& pictures);

/// How a table is measured.
struct TableRun {
  std::filesystem::path plan, output;
  std::vector<std::string> rows;  ///< only these; empty: all
  bool available = false;         ///< leave out refused rows, and say so, instead of throwing
  int threads = 0;
  PipelineOptions pipeline;
};

/// Measures a table into a folder: table.csv, slices.csv, prefixes.csv, table.md and pictures. Scans that are in
/// table.csv already are kept. Says on standard error how far it is.
/// @throws std::runtime_error naming the file, the row and what is wrong
void measure_table(const TableRun& run);

}  // namespace svort
