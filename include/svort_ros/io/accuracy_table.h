#pragma once

#include <filesystem>
#include <string>
#include <vector>

#include "svort_ros/evaluation/accuracy.h"

namespace svort {

/// Name of the method that the others are compared with.
constexpr const char* kNominalMethod = "nominal";

/// Rows of scans that were measured already; none if the file is not there.
/// @throws std::runtime_error naming the file and the line that is not one of write_accuracy_rows()
std::vector<AccuracyRow> read_accuracy_rows(const std::filesystem::path& path);

/// CSV, a row per scan and method; docs/accuracy.md describes the columns. The file is replaced as a whole.
/// @throws std::runtime_error naming the file and the reason
void write_accuracy_rows(const std::filesystem::path& path, const std::vector<AccuracyRow>& rows);

/// Tables over motion class and method: mean and median over scans.
std::string accuracy_markdown(const std::vector<AccuracyRow>& rows);

/// PNG: relative ED of each scan against that of its nominal poses, a colour per method. Needs rows of method
/// "nominal".
/// @throws std::runtime_error naming the file
void plot_accuracy(const std::filesystem::path& path, const std::vector<AccuracyRow>& rows);

/// The program svort_accuracy. @return 0, or 2 with a message on standard error if something is wrong with the input
int run_svort_accuracy(int argc, char** argv);

}  // namespace svort
