#pragma once

#include <Eigen/Core>
#include <filesystem>
#include <string>
#include <vector>

#include "svort_ros/decision/slice_quality.h"

namespace svort {

/// A slice whose damage is known.
struct LabelledSlice {
  QualityFeatures features;
  double score = 0., first_score = 0., image_score = 0.;  ///< as they were given
  bool voided = false;
  bool noisy = false;
  /// Its pose is wrong by a limit more than that of the scan's median slice, after one rigid transform over the scan.
  bool misplaced = false;
  double scan_error_mm = 0.;  ///< that median: above the limit, registration has failed, and `misplaced` says nothing
  bool displaced = false;     ///< the head had moved since the stack was planned; no damage by itself
  bool damaged() const { return voided || noisy || misplaced; }
};

/// Slices of one replayed scan: quality.csv and poses.csv of `results`, and the simulator's truth.csv.
/// @throws std::runtime_error naming the file and what is wrong with it
std::vector<LabelledSlice> read_labelled_slices(const std::filesystem::path& results,
                                                const std::filesystem::path& truth, double misplaced_mm);

/// How well low scores find bad slices.
struct Roc {
  std::size_t bad = 0, good = 0;
  double auc = 0.;          ///< area under the curve; NaN without slices of both kinds
  double found_at_10 = 0.;  ///< share of the bad ones that are found where 10 % of the good ones are taken for bad
  double found_at_20 = 0.;
  std::vector<std::pair<double, double>> curve;  ///< false positives, true positives
};
Roc roc(const std::vector<double>& scores, const std::vector<bool>& bad);

/// Logistic regression by Newton's method.
/// @param x n x p features; @param y n, true where the outcome is 1
/// @param ridge penalty on the squares of the coefficients of standardised features, the intercept's left out
/// @return p + 1: intercept, coefficients
/// @throws std::invalid_argument if the sizes do not fit, or y has one value only
Eigen::VectorXd fit_logistic(const Eigen::MatrixXd& x, const std::vector<bool>& y, double ridge);

/// Coefficients from labelled slices; intercepts such that 10 % of the undamaged slices are below `accept`.
SliceQualityOptions calibrate_quality(const std::vector<LabelledSlice>& slices, const SliceQualityOptions& start);

/// The program svort_calibrate. @return 0, or 2 with a message on standard error if something is wrong with the input
int run_svort_calibrate(int argc, char** argv);

}  // namespace svort
