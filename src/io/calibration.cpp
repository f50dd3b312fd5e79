#include "svort_ros/io/calibration.h"

#include <torch/types.h>

#include <CLI/CLI.hpp>
#include <Eigen/Cholesky>
#include <algorithm>
#include <charconv>
#include <cmath>
#include <cstdio>
#include <fstream>
#include <limits>
#include <map>
#include <sstream>
#include <stdexcept>

#include "csv_text.h"
#include "svort_ros/geometry/rigid_transform.h"
#include "svort_ros/io/atomic_file.h"
#include "svort_ros/io/options_file.h"
#include "svort_ros/io/plots.h"
#include "svort_ros/io/tables.h"
#include "svort_ros/metrics/pose_error.h"

namespace svort {
namespace {

namespace fs = std::filesystem;

constexpr int kBadInput = 2;
constexpr double kFalsePositives = 0.1;

std::string fixed(double value, int decimals) {
  if (!std::isfinite(value)) return "-";
  char text[64];
  std::snprintf(text, sizeof text, "%.*f", decimals, value);
  return text;
}

double read_number(const fs::path& path, std::size_t line, const std::string& text) {
  if (text == "nan") return std::numeric_limits<double>::quiet_NaN();
  double value = 0.;
  const auto [end, error] = std::from_chars(text.data(), text.data() + text.size(), value);
  if (error != std::errc() || end != text.data() + text.size()) fail(path, line, "'" + text + "' is not a number");
  return value;
}

using SliceKey = std::pair<int, int>;

/// Distance of each slice from its true place, mm, after the one rigid transform that fits best.
std::map<SliceKey, double> pose_errors_of(const std::vector<PoseRow>& poses, const std::map<SliceKey, PoseRow>& truth,
                                          const fs::path& truth_path) {
  std::vector<Pose> estimated, known;
  for (const PoseRow& row : poses) {
    const auto found = truth.find({row.stack, row.slice});
    if (found == truth.end())
      throw std::runtime_error(truth_path.string() + ": slice " + std::to_string(row.slice) + " of stack " +
                               std::to_string(row.stack) + " is not there");
    estimated.push_back(row.T_brain_slice);
    known.push_back(found->second.T_brain_slice);
  }
  if (estimated.empty()) return {};
  const torch::Tensor errors =
      relative_pose_errors(tensor_from_poses(estimated), tensor_from_poses(known), AnchorFrame()).ed;
  std::map<SliceKey, double> result;
  for (std::size_t i = 0; i < poses.size(); ++i)
    result[{poses[i].stack, poses[i].slice}] = errors[static_cast<std::int64_t>(i)].item<double>();
  return result;
}

/// Intercept that puts `share` of the logits below that of `accept`.
double shifted(std::vector<double> logits, double share, double accept) {
  const auto rank = logits.begin() + static_cast<std::ptrdiff_t>(share * static_cast<double>(logits.size() - 1));
  std::nth_element(logits.begin(), rank, logits.end());
  const double wanted = std::log(accept / (1. - accept));
  return wanted - *rank;
}

double rounded(double value) { return std::round(value * 100.) / 100.; }

std::array<double, QualityFeatures::kCount> filled(const QualityFeatures& features) {
  auto values = features.values();
  const auto typical = typical_quality().values();
  for (std::size_t i = 0; i < values.size(); ++i)
    if (!std::isfinite(values[i])) values[i] = typical[i];
  return values;
}

struct DamageClass {
  const char* name;
  bool (*is)(const LabelledSlice&);
};
constexpr DamageClass kClasses[] = {
    {"void", [](const LabelledSlice& s) { return s.voided; }},
    {"noisy", [](const LabelledSlice& s) { return s.noisy; }},
    {"misplaced", [](const LabelledSlice& s) { return s.misplaced; }},
    {"any of these", [](const LabelledSlice& s) { return s.damaged(); }},
    {"displaced only", [](const LabelledSlice& s) { return s.displaced && !s.damaged(); }},
};

struct ScoreKind {
  const char* name;
  double (*of)(const LabelledSlice&);
};
constexpr ScoreKind kKinds[] = {
    {"final score", [](const LabelledSlice& s) { return s.score; }},
    {"first score", [](const LabelledSlice& s) { return s.first_score; }},
    {"image score", [](const LabelledSlice& s) { return s.image_score; }},
};

/// Bad are the slices of the class, good those without any damage or displacement.
Roc roc_of(const std::vector<LabelledSlice>& slices, const DamageClass& damage, const ScoreKind& kind) {
  std::vector<double> scores;
  std::vector<bool> bad;
  for (const LabelledSlice& slice : slices) {
    const bool is = damage.is(slice);
    if (!is && (slice.damaged() || slice.displaced)) continue;
    scores.push_back(kind.of(slice));
    bad.push_back(is);
  }
  return roc(scores, bad);
}

std::string table_of(const std::vector<LabelledSlice>& slices) {
  std::ostringstream text;
  text << "| damage | slices | score | AUC | found at 10 % | found at 20 % |\n|---|---|---|---|---|---|\n";
  for (const DamageClass& damage : kClasses)
    for (const ScoreKind& kind : kKinds) {
      const Roc result = roc_of(slices, damage, kind);
      text << "| " << damage.name << " | " << result.bad << " | " << kind.name << " | " << fixed(result.auc, 3) << " | "
           << fixed(result.found_at_10, 2) << " | " << fixed(result.found_at_20, 2) << " |\n";
    }
  const auto good =
      std::count_if(slices.begin(), slices.end(), [](const LabelledSlice& s) { return !s.damaged() && !s.displaced; });
  text << "\n" << slices.size() << " slices, " << good << " of them without damage or displacement.\n";
  return text.str();
}

}  // namespace

std::vector<LabelledSlice> read_labelled_slices(const fs::path& results, const fs::path& truth_path,
                                                double misplaced_mm) {
  std::map<SliceKey, PoseRow> truth;
  for (const PoseRow& row : read_pose_table(truth_path)) truth[{row.stack, row.slice}] = row;
  const auto errors = pose_errors_of(read_pose_table(results / "poses.csv"), truth, truth_path);

  std::vector<double> sorted;
  for (const auto& error : errors) sorted.push_back(error.second);
  std::sort(sorted.begin(), sorted.end());
  const double scan_error = sorted.empty() ? 0. : sorted[sorted.size() / 2];

  const fs::path path = results / "quality.csv";
  std::ifstream file(path, std::ios::binary);
  if (!file) throw std::runtime_error(path.string() + ": cannot be read");
  std::ostringstream content;
  content << file.rdbuf();
  const std::vector<Record> records = parse_csv(path, content.str());
  if (records.empty()) throw std::runtime_error(path.string() + ": is empty");
  std::map<std::string, std::size_t> columns;
  for (std::size_t i = 0; i < records.front().fields.size(); ++i) columns[records.front().fields[i]] = i;

  std::vector<LabelledSlice> slices;
  for (std::size_t r = 1; r < records.size(); ++r) {
    const Record& record = records[r];
    const auto value = [&](const std::string& name) {
      const auto column = columns.find(name);
      if (column == columns.end() || column->second >= record.fields.size())
        fail(path, record.line, "column '" + name + "' is missing");
      return read_number(path, record.line, record.fields[column->second]);
    };
    const SliceKey key(static_cast<int>(value("stack")), static_cast<int>(value("slice")));
    const auto known = truth.find(key);
    const auto error = errors.find(key);
    if (known == truth.end() || error == errors.end())
      fail(path, record.line, "this slice is not in " + truth_path.string() + " and poses.csv");
    LabelledSlice slice;
    QualityFeatures& f = slice.features;
    f = {value("weight"),     value("similarity"), value("void_volume"), value("dark_volume"),
         value("void_image"), value("dark_image"), value("noise"),       value("jump")};
    slice.score = value("score");
    slice.first_score = value("first_score");
    slice.image_score = value("image_score");
    slice.voided = known->second.voided;
    slice.noisy = known->second.noisy;
    slice.displaced = known->second.displaced;
    slice.misplaced = error->second > scan_error + misplaced_mm;
    slice.scan_error_mm = scan_error;
    slices.push_back(slice);
  }
  return slices;
}

Roc roc(const std::vector<double>& scores, const std::vector<bool>& bad) {
  Roc result;
  std::vector<std::pair<double, bool>> sorted;
  for (std::size_t i = 0; i < scores.size(); ++i) {
    sorted.emplace_back(scores[i], bad[i]);
    ++(bad[i] ? result.bad : result.good);
  }
  std::sort(sorted.begin(), sorted.end());
  if (result.bad == 0 || result.good == 0) {
    result.auc = result.found_at_10 = result.found_at_20 = std::numeric_limits<double>::quiet_NaN();
    return result;
  }
  result.curve.emplace_back(0., 0.);
  std::size_t found = 0, wrong = 0;
  for (std::size_t i = 0; i < sorted.size();) {
    const std::size_t begin = i;
    for (; i < sorted.size() && sorted[i].first == sorted[begin].first; ++i) ++(sorted[i].second ? found : wrong);
    const double x = static_cast<double>(wrong) / static_cast<double>(result.good);
    const double y = static_cast<double>(found) / static_cast<double>(result.bad);
    result.auc += 0.5 * (x - result.curve.back().first) * (y + result.curve.back().second);  // equal scores: a slope
    result.curve.emplace_back(x, y);
  }
  const auto at = [&result](double limit) {
    for (std::size_t i = 1; i < result.curve.size(); ++i) {
      const auto& [x0, y0] = result.curve[i - 1];
      const auto& [x1, y1] = result.curve[i];
      if (x1 > limit) return y0 + (y1 - y0) * (limit - x0) / (x1 - x0);
    }
    return 1.;
  };
  result.found_at_10 = at(0.1);
  result.found_at_20 = at(0.2);
  return result;
}

Eigen::VectorXd fit_logistic(const Eigen::MatrixXd& x, const std::vector<bool>& y, double ridge) {
  const Eigen::Index n = x.rows(), p = x.cols();
  const auto ones = std::count(y.begin(), y.end(), true);
  if (n != static_cast<Eigen::Index>(y.size()) || ones == 0 || ones == n)
    throw std::invalid_argument("fit_logistic: " + std::to_string(y.size()) + " outcomes, " + std::to_string(ones) +
                                " of them 1, for " + std::to_string(n) + " rows; both outcomes are needed");
  const Eigen::RowVectorXd mean = x.colwise().mean();
  Eigen::RowVectorXd deviation =
      ((x.rowwise() - mean).array().square().colwise().sum() / static_cast<double>(n)).sqrt();
  deviation = deviation.array().max(1e-9);
  Eigen::MatrixXd z(n, p + 1);
  z.col(0).setOnes();
  z.rightCols(p) = (x.rowwise() - mean).array().rowwise() / deviation.array();
  Eigen::VectorXd outcome(n);
  for (Eigen::Index i = 0; i < n; ++i) outcome[i] = y[static_cast<std::size_t>(i)] ? 1. : 0.;
  Eigen::VectorXd penalty = Eigen::VectorXd::Constant(p + 1, ridge);
  penalty[0] = 0.;
  Eigen::VectorXd b = Eigen::VectorXd::Zero(p + 1);
  for (int step = 0; step < 50; ++step) {
    const Eigen::VectorXd q = 1. / (1. + (-(z * b).array()).exp());
    const Eigen::VectorXd slope = z.transpose() * (outcome - q) - penalty.cwiseProduct(b);
    const Eigen::VectorXd weight = (q.array() * (1. - q.array())).max(1e-9);
    Eigen::MatrixXd curvature = z.transpose() * weight.asDiagonal() * z;
    curvature.diagonal() += penalty;
    const Eigen::VectorXd change = curvature.ldlt().solve(slope);
    b += change;
    if (change.norm() < 1e-10) break;
  }
  Eigen::VectorXd result(p + 1);
  result.tail(p) = b.tail(p).array() / deviation.transpose().array();
  result[0] = b[0] - mean.dot(result.tail(p));
  return result;
}

SliceQualityOptions calibrate_quality(const std::vector<LabelledSlice>& slices, const SliceQualityOptions& start) {
  const auto n = static_cast<Eigen::Index>(slices.size());
  Eigen::MatrixXd all(n, static_cast<Eigen::Index>(QualityFeatures::kCount)), image(n, 3);
  std::vector<bool> good, good_image;
  for (Eigen::Index i = 0; i < n; ++i) {
    const LabelledSlice& slice = slices[static_cast<std::size_t>(i)];
    const auto values = filled(slice.features);
    for (std::size_t k = 0; k < values.size(); ++k) all(i, static_cast<Eigen::Index>(k)) = values[k];
    image.row(i) << values[4], values[5], values[6];
    good.push_back(!slice.damaged());
    good_image.push_back(!slice.voided && !slice.noisy);  // where a slice lies its image does not show
  }
  // Two slices' worth of doubt for every hundred: keeps coefficients of features that say little near 0.
  const double ridge = 0.02 * static_cast<double>(n);
  SliceQualityOptions result = start;
  const auto undamaged = [&](const Eigen::VectorXd& logits) {
    std::vector<double> kept;
    for (Eigen::Index i = 0; i < n; ++i)
      if (!slices[static_cast<std::size_t>(i)].damaged()) kept.push_back(logits[i]);
    return kept;
  };
  Eigen::VectorXd b = fit_logistic(all, good, ridge).unaryExpr([](double v) { return rounded(v); });
  result.weight = b[1];
  result.similarity = b[2];
  result.void_volume = b[3];
  result.dark_volume = b[4];
  result.void_image = b[5];
  result.dark_image = b[6];
  result.noise = b[7];
  result.jump = b[8];
  result.intercept = rounded(shifted(undamaged(all * b.tail(b.size() - 1)), kFalsePositives, start.accept));
  b = fit_logistic(image, good_image, ridge).unaryExpr([](double v) { return rounded(v); });
  result.image_void = b[1];
  result.image_dark = b[2];
  result.image_noise = b[3];
  result.image_intercept = rounded(shifted(undamaged(image * b.tail(3)), kFalsePositives, start.accept));
  return result;
}

int run_svort_calibrate(int argc, char** argv) {
  CLI::App app("Says how well slice quality finds simulated damage, and fits its coefficients.", "svort_calibrate");
  std::vector<std::string> results, truth;
  std::string output, fit;
  double misplaced_mm = 4.;
  app.add_option("--results", results, "folders of svort_replay")->required();
  app.add_option("--truth", truth, "truth.csv of svort_simulate, one per folder")->required();
  app.add_option("--output", output, "folder for quality_roc.md and quality_roc.png; made if needed")->required();
  app.add_option("--fit", fit, "fit the coefficients, and write them into this YAML file");
  app.add_option("--misplaced-mm", misplaced_mm,
                 "a slice whose anchor points are off by so much more than the scan's median is misplaced, mm")
      ->capture_default_str()
      ->check(CLI::PositiveNumber);
  try {
    app.parse(argc, argv);
    if (results.size() != truth.size())
      throw std::invalid_argument("--truth: " + std::to_string(truth.size()) + " files for " +
                                  std::to_string(results.size()) + " folders");
    std::vector<LabelledSlice> slices;
    for (std::size_t i = 0; i < results.size(); ++i) {
      const auto scan = read_labelled_slices(results[i], truth[i], misplaced_mm);
      if (!scan.empty() && scan.front().scan_error_mm > misplaced_mm) {
        std::printf("%s is left out: its poses are wrong by %.1f mm, registration has failed\n", results[i].c_str(),
                    scan.front().scan_error_mm);
        continue;
      }
      slices.insert(slices.end(), scan.begin(), scan.end());
    }
    if (!fit.empty()) {
      SliceQualityOptions options = calibrate_quality(slices, SliceQualityOptions());
      std::ostringstream yaml;
      yaml << "decision:\n  quality:\n";
      options.visit([&yaml](const std::string& key, double value, const char*) {
        yaml << "    " << key << ": " << number(value) << '\n';
      });
      write_file(fit, yaml.str());
      std::printf("%s: coefficients\n", fit.c_str());
    }
    fs::create_directories(output);
    const std::string table = table_of(slices);
    write_file(fs::path(output) / "quality_roc.md", table);
    std::vector<Curve> curves;
    for (const DamageClass& damage : kClasses) curves.push_back({damage.name, roc_of(slices, damage, kKinds[0]).curve});
    curves.push_back({"any, image score", roc_of(slices, kClasses[3], kKinds[2]).curve});
    plot_curves(fs::path(output) / "quality_roc.png", "Damaged slices found by the final score",
                "share of undamaged slices taken for damaged", "share found", curves);
    std::fputs(table.c_str(), stdout);
    return 0;
  } catch (const CLI::ParseError& error) {
    return app.exit(error) == 0 ? 0 : kBadInput;  // 0: help was asked for
  } catch (const std::exception& error) {
    std::fprintf(stderr, "%s: %s\n", app.get_name().c_str(), error.what());
    return kBadInput;
  }
}

}  // namespace svort
