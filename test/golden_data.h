#pragma once

#include <gtest/gtest.h>
#include <torch/ordered_dict.h>
#include <torch/serialize.h>
#include <torch/types.h>

#include <algorithm>
#include <cstdio>
#include <cstdlib>
#include <fstream>
#include <iterator>
#include <limits>
#include <stdexcept>
#include <string>
#include <utility>
#include <vector>

namespace svort {

/// One file of golden numbers: a dictionary of tensors, see test/golden/README.md.
class GoldenData {
 public:
  /// Loads `name` from the folder that SVORT_GOLDEN_DIR names, else from test/golden.
  /// @throws std::runtime_error if the file cannot be read
  explicit GoldenData(const std::string& name) {
    const char* folder = std::getenv("SVORT_GOLDEN_DIR");
    path_ = std::string(folder != nullptr ? folder : SVORT_TEST_DIR "/golden") + "/" + name;
    std::ifstream file(path_, std::ios::binary);
    if (!file) throw std::runtime_error(path_ + ": cannot be opened");
    const std::vector<char> bytes((std::istreambuf_iterator<char>(file)), std::istreambuf_iterator<char>());
    const auto entries = torch::pickle_load(bytes).toGenericDict();
    for (const auto& entry : entries) tensors_.insert(entry.key().toStringRef(), entry.value().toTensor());
  }

  bool has(const std::string& key) const { return tensors_.contains(key); }

  /// @throws std::runtime_error naming the file if the key is missing
  torch::Tensor at(const std::string& key) const {
    if (!has(key)) throw std::runtime_error(path_ + ": no key " + key);
    return tensors_[key];
  }

  /// All keys that begin with `prefix`.
  std::vector<std::string> keys(const std::string& prefix) const {
    std::vector<std::string> found;
    for (const std::string& key : tensors_.keys()) {
      if (key.compare(0, prefix.size(), prefix) == 0) found.push_back(key);
    }
    return found;
  }

 private:
  std::string path_;
  torch::OrderedDict<std::string, torch::Tensor> tensors_;
};

/// How far two tensors of one shape are apart.
struct Deviation {
  double maximum = 0.;      ///< largest absolute difference
  double relative_l2 = 0.;  ///< |a - b| / |b|
};

/// Deviation of `actual` from `expected`; infinite if shapes differ or `actual` is not finite.
inline Deviation deviation(const torch::Tensor& actual, const torch::Tensor& expected) {
  const double infinity = std::numeric_limits<double>::infinity();
  if (actual.sizes() != expected.sizes()) {
    ADD_FAILURE() << "shape " << actual.sizes() << ", expected " << expected.sizes();
    return {infinity, infinity};
  }
  if (actual.numel() == 0) return {};
  const torch::Tensor a = actual.detach().to(torch::kFloat64), b = expected.to(torch::kFloat64);
  if (!torch::isfinite(a).all().item<bool>()) return {infinity, infinity};
  const double norm = b.norm().item<double>();
  return {(a - b).abs().max().item<double>(), (a - b).norm().item<double>() / (norm > 0. ? norm : 1.)};
}

/// Records the largest deviation of one kind and prints it at the end of the test.
class WorstDeviation {
 public:
  WorstDeviation(std::string what, double tolerance) : what_(std::move(what)), tolerance_(tolerance) {}
  ~WorstDeviation() {
    std::printf("[  GOLDEN  ] %-42s worst %9.3g  tolerance %9.3g  (%d keys)\n", what_.c_str(), worst_, tolerance_,
                count_);
  }
  WorstDeviation(const WorstDeviation&) = delete;
  WorstDeviation& operator=(const WorstDeviation&) = delete;

  void check(double value, const std::string& key) {
    EXPECT_LE(value, tolerance_) << what_ << ", key " << key;
    worst_ = std::max(worst_, value);
    ++count_;
  }
  int count() const { return count_; }

 private:
  std::string what_;
  double tolerance_;
  double worst_ = 0.;
  int count_ = 0;
};

}  // namespace svort
