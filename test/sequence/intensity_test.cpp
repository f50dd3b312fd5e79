#include "svort_ros/sequence/intensity.h"

#include <gtest/gtest.h>

#include <algorithm>
#include <random>
#include <stdexcept>

namespace svort {
namespace {

/// Brain pixels: normal around 100 * gain, sigma 20 * gain; their 0.99 quantile is 146.5 * gain.
std::vector<float> brain(std::mt19937& random, std::size_t count, double gain = 1.) {
  std::normal_distribution<double> distribution(100. * gain, 20. * gain);
  std::vector<float> values(count);
  for (float& value : values) value = static_cast<float>(distribution(random));
  return values;
}

TEST(IntensityScale, IsTheQuantile) {
  IntensityScale scale;
  EXPECT_EQ(scale.scale(), 1.);
  std::mt19937 random(1);
  EXPECT_TRUE(scale.add(brain(random, 20000)));
  EXPECT_NEAR(scale.scale(), 146.5, 2.);  // standard error of this quantile from 20,000 values: 0.5
  scale.clear();
  EXPECT_EQ(scale.scale(), 1.);
}

TEST(IntensityScale, HomogeneousScanKeepsItsFirstScale) {
  IntensityScale scale;
  std::mt19937 random(2);
  EXPECT_TRUE(scale.add(brain(random, 3000)));
  const double first = scale.scale();
  for (int i = 0; i < 60; ++i) EXPECT_FALSE(scale.add(brain(random, 200 + 100 * static_cast<std::size_t>(i))));
  EXPECT_EQ(scale.scale(), first);
}

TEST(IntensityScale, FollowsAChangeOfGain) {
  IntensityScale scale;
  std::mt19937 random(3);
  for (int i = 0; i < 10; ++i) scale.add(brain(random, 4000));
  int changes = 0;
  for (int i = 0; i < 30; ++i) changes += scale.add(brain(random, 4000, 2.)) ? 1 : 0;
  // Three quarters of all pixels are now twice as bright: the 0.99 quantile of the mixture is 289.
  EXPECT_NEAR(scale.scale(), 289., 29.);
  EXPECT_GE(changes, 1);
  EXPECT_LE(changes, 8);  // in steps of the tolerance, not with every slice
}

TEST(IntensityScale, OrderOfSlicesMattersWithinTheToleranceOnly) {
  std::mt19937 random(4);
  std::vector<std::vector<float>> slices;
  for (int i = 0; i < 40; ++i) slices.push_back(brain(random, 100 + 90 * static_cast<std::size_t>(i), 1. + 0.02 * i));
  IntensityOptions exact;
  exact.hold_fraction = 0.;
  double reference = 0.;
  for (int trial = 0; trial < 10; ++trial) {
    std::shuffle(slices.begin(), slices.end(), random);
    IntensityScale held, followed(exact);
    for (const auto& slice : slices) {
      held.add(slice);
      followed.add(slice);
    }
    if (trial == 0) reference = followed.scale();
    EXPECT_EQ(followed.scale(), reference);
    EXPECT_LE(std::abs(reference - held.scale()), 0.1 * held.scale() + 1e-9);
  }
}

TEST(IntensityScale, SlicesWeighByTheirArea) {
  IntensityOptions options;
  options.quantile = 0.5;
  options.hold_fraction = 0.;
  IntensityScale scale(options);
  for (int i = 0; i < 9; ++i) scale.add(std::vector<float>(100, 10.F));
  scale.add(std::vector<float>(9000, 50.F));
  EXPECT_EQ(scale.scale(), 50.);
}

TEST(IntensityScale, DarknessDoesNotCount) {
  IntensityScale scale;
  EXPECT_FALSE(scale.add({0.F, 0.F, -5.F}));
  EXPECT_EQ(scale.scale(), 1.);
  EXPECT_TRUE(scale.add({0.F, 7.F}));
  EXPECT_EQ(scale.scale(), 7.);
  EXPECT_FALSE(scale.add({0.F}));
}

TEST(IntensityScale, RejectsBadOptions) {
  IntensityOptions options;
  options.quantile = 0.;
  EXPECT_THROW(IntensityScale{options}, std::invalid_argument);
  options = {};
  options.hold_fraction = -0.1;
  EXPECT_THROW(IntensityScale{options}, std::invalid_argument);
}

}  // namespace
}  // namespace svort
