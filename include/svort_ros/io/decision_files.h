#pragma once

#include <filesystem>
#include <nlohmann/json_fwd.hpp>
#include <string>

#include "svort_ros/decision/decision_engine.h"

namespace svort {

// Files of decisions; docs/files.md describes their columns. All are whole or not there; errors are std::runtime_error
// and name the file and the reason.

/// motion.csv: a row per kept slice.
void write_motion_table(const std::filesystem::path& path, const std::string& scan_id, const MotionReport& motion);
/// quality.csv: a row per kept slice, with the features that the score is made of.
void write_quality_table(const std::filesystem::path& path, const std::string& scan_id, const DecisionEngine& engine);
/// reacquisition.csv: the audit log, a row per event.
void write_reacquisition_table(const std::filesystem::path& path, const std::string& scan_id,
                               const std::vector<PlannerEvent>& events);
/// decisions.jsonl: a JSON object per update, with the inputs that its decisions were made from.
void write_decision_log(const std::filesystem::path& path, const DecisionEngine& engine);

/// Bytes of a PNG with displacement, rotation and framewise displacement over time.
std::string motion_png(const MotionReport& motion);

/// What run.json says about decisions.
nlohmann::ordered_json decisions_to_json(const DecisionEngine& engine);

/// motion.csv, quality.csv, reacquisition.csv, decisions.jsonl, coverage.nii.gz, orientations.nii.gz, motion.png and
/// coverage.png. Files without content (no slice yet) are removed if an earlier run left them.
void write_decisions(const std::filesystem::path& directory, const std::string& scan_id, const DecisionEngine& engine);

/// What other thresholds would have decided, beside what was decided: what_if.json and the files above in
/// `directory`/what_if.
void write_what_if(const std::filesystem::path& directory, const std::string& scan_id, const DecisionEngine& engine,
                   const DecisionEngine& what_if);

}  // namespace svort
