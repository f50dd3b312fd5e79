#include "training_files.h"

#include <algorithm>
#include <cmath>
#include <fstream>
#include <map>
#include <sstream>
#include <utility>

#include "svort_ros/io/brain_volume_file.h"
#include "svort_ros/io/plots.h"

namespace svort {
namespace {

// The log's rows of one kind: numbers by column; an empty field is NaN.
std::map<std::string, std::vector<double>> read_log(const std::filesystem::path& path) {
  std::ifstream file(path);
  std::string line, field;
  std::vector<std::string> header;
  std::map<std::string, std::vector<double>> columns;
  std::getline(file, line);
  for (std::istringstream fields(line); std::getline(fields, field, ',');) header.push_back(field);
  while (std::getline(file, line)) {
    std::istringstream fields(line);
    for (const std::string& name : header) {
      field.clear();
      std::getline(fields, field, ',');
      columns[name].push_back(field.empty() ? std::nan("") : std::stod(field));
    }
  }
  return columns;
}

}  // namespace

std::vector<BrainVolume> read_training_volumes(const std::vector<std::string>& files) {
  return read_brain_volumes(files);
}

void plot_training(const std::filesystem::path& folder, const std::vector<std::string>& parts) {
  auto training = read_log(folder / "training.csv");
  std::vector<Curve> losses;
  for (const std::string& part : parts) {
    Curve curve{part, {}};
    const std::vector<double>& values = training[part];
    for (std::size_t i = 0; i < values.size(); ++i) curve.points.emplace_back(training["scans"][i], values[i]);
    losses.push_back(std::move(curve));
  }
  plot_curves(folder / "training.png", "Training losses", "scans", "loss", losses);

  auto validation = read_log(folder / "validation.csv");
  if (validation.empty()) return;
  std::map<double, std::pair<Curve, Curve>> by_iteration;
  for (std::size_t i = 0; i < validation["scans"].size(); ++i) {
    const double iteration = validation["iteration"][i];
    auto& [absolute, relative] = by_iteration[iteration];
    const std::string name = "iteration " + std::to_string(static_cast<int>(iteration));
    absolute.name = name;
    relative.name = name + ", relative";
    absolute.points.emplace_back(validation["scans"][i], validation["ed_mm"][i]);
    relative.points.emplace_back(validation["scans"][i], validation["relative_ed_mm"][i]);
  }
  std::vector<Curve> errors;
  for (const auto& [iteration, curves] : by_iteration) {
    errors.push_back(curves.first);
    errors.push_back(curves.second);
  }
  plot_curves(folder / "validation.png", "Held-out scans: distance of the anchor points", "scans seen", "ED / mm",
              errors);
}

}  // namespace svort
