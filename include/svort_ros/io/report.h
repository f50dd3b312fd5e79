#pragma once

#include <filesystem>
#include <string>

#include "svort_ros/decision/decision_engine.h"
#include "svort_ros/io/results.h"
#include "svort_ros/live/live_pipeline.h"

namespace svort {

/// One self-contained HTML page about a scan: motion, slice quality, coverage, volume, decisions, timings, versions.
///
/// Pictures are taken from the results folder (volume.png, coverage.png), so write those first; one that is not there
/// is left out with a note. No scripts, nothing is loaded from elsewhere.
/// @throws std::runtime_error naming the file and the reason
void write_report(const std::filesystem::path& directory, const LivePipeline& pipeline, const RunInfo& run,
                  const DecisionEngine& engine);

/// Text for HTML: & < > " become entities, control characters and broken UTF-8 question marks.
std::string escape_html(const std::string& text);
/// RFC 4648, with padding.
std::string base64(const std::string& bytes);

}  // namespace svort
