#include "svort_ros/io/calibration.h"

#include <gtest/gtest.h>

#include <cmath>

#include "io/scratch.h"
#include "svort_ros/simulation/random_stream.h"

namespace svort {
namespace {

class Calibration : public Scratch {};

TEST(Roc, OfKnownScores) {
  // Of 2 x 2 pairs of a bad and a good slice, three are in order.
  const Roc known = roc({0.1, 0.4, 0.35, 0.8}, {true, true, false, false});
  EXPECT_DOUBLE_EQ(known.auc, 0.75);
  EXPECT_EQ(known.bad, 2U);
  EXPECT_DOUBLE_EQ(known.found_at_10, 0.5);
  EXPECT_DOUBLE_EQ(roc({0.1, 0.2, 0.8, 0.9}, {true, true, false, false}).auc, 1.);
  EXPECT_DOUBLE_EQ(roc({0.1, 0.2, 0.8, 0.9}, {true, true, false, false}).found_at_10, 1.);
  EXPECT_DOUBLE_EQ(roc({0.5, 0.5, 0.5, 0.5}, {true, false, true, false}).auc, 0.5);  // all alike: chance
  EXPECT_DOUBLE_EQ(roc({0.5, 0.5}, {true, false}).found_at_20, 0.2);
  EXPECT_TRUE(std::isnan(roc({0.5, 0.6}, {true, true}).auc));
}

TEST(Logistic, RecoversWhatTheDataWereMadeOf) {
  RandomStream random(1);
  constexpr int kCount = 20000;
  Eigen::MatrixXd x(kCount, 2);
  std::vector<bool> y;
  for (int i = 0; i < kCount; ++i) {
    x.row(i) << random.normal(2.), 3. + random.normal();
    const double logit = 0.5 + 1.2 * x(i, 0) - 0.8 * x(i, 1);
    y.push_back(random.chance(1. / (1. + std::exp(-logit))));
  }
  const Eigen::VectorXd b = fit_logistic(x, y, 1e-6);
  // Standard errors are about 0.02 for the slopes and 0.07 for the intercept.
  EXPECT_NEAR(b[0], 0.5, 0.25);
  EXPECT_NEAR(b[1], 1.2, 0.08);
  EXPECT_NEAR(b[2], -0.8, 0.08);
  EXPECT_LT(fit_logistic(x, y, 1e5).tail(2).norm(), 0.3);  // a strong ridge holds the slopes near 0
  EXPECT_THROW(fit_logistic(x, std::vector<bool>(kCount, true), 1.), std::invalid_argument);
  EXPECT_THROW(fit_logistic(x, {true, false}, 1.), std::invalid_argument);
}

TEST(Calibrate, PutsTenPerCentOfTheUndamagedBelowTheLimit) {
  RandomStream random(2);
  std::vector<LabelledSlice> slices;
  for (int i = 0; i < 2000; ++i) {
    LabelledSlice slice;
    slice.voided = i % 5 == 0;
    slice.features.void_volume = slice.features.void_image = random.uniform(0., slice.voided ? 0.5 : 0.15);
    slice.features.similarity = 2.5 + random.normal(0.3) - (slice.voided ? 0.8 : 0.);
    slices.push_back(slice);
  }
  const SliceQualityOptions options = calibrate_quality(slices, SliceQualityOptions());
  EXPECT_LT(options.void_volume, 0.);
  EXPECT_GT(options.similarity, 0.);
  int below = 0, found = 0, good = 0;
  for (const LabelledSlice& slice : slices) {
    const bool low = quality_score(slice.features, options) < options.accept;
    good += slice.voided ? 0 : 1;
    below += low && !slice.voided ? 1 : 0;
    found += low && slice.voided ? 1 : 0;
  }
  EXPECT_NEAR(static_cast<double>(below) / good, 0.1, 0.02);
  EXPECT_GT(found, 300);  // of 400
}

TEST_F(Calibration, ErrorsNameTheFile) {
  write("poses.csv", "scan_id,stack,slice,stamp,tx,ty,tz,qx,qy,qz,qw\na,0,1,1.0,0,0,0,0,0,0,1\n");
  write("truth.csv", "scan_id,stack,slice,stamp,tx,ty,tz,qx,qy,qz,qw\na,0,1,1.0,0,0,0,0,0,0,1\n");
  const auto read = [&] { read_labelled_slices(path(""), path("truth.csv"), 4.); };
  EXPECT_NE(message_of(read).find("quality.csv: cannot be read"), std::string::npos) << message_of(read);
  write("quality.csv", "stack,slice\n0,1\n");
  EXPECT_NE(message_of(read).find("quality.csv, line 2: column 'weight' is missing"), std::string::npos)
      << message_of(read);
  write("quality.csv", "stack,slice\n0,x\n");
  EXPECT_NE(message_of(read).find("'x' is not a number"), std::string::npos) << message_of(read);
}

}  // namespace
}  // namespace svort
