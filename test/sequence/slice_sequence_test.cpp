#include "svort_ros/sequence/slice_sequence.h"

#include <gtest/gtest.h>

#include <algorithm>
#include <limits>
#include <numeric>
#include <random>

#include "sequence/slice_fixture.h"

namespace svort {
namespace {

/// The answer, and whether its reason holds every one of `words`.
testing::AssertionResult answers(const Arrival& arrival, ArrivalStatus status, const std::vector<std::string>& words) {
  if (arrival.status != status)
    return testing::AssertionFailure() << to_string(arrival.status) << " instead of " << to_string(status) << ": "
                                       << arrival.reason;
  for (const std::string& word : words)
    if (arrival.reason.find(word) == std::string::npos)
      return testing::AssertionFailure() << "no '" << word << "' in: " << arrival.reason;
  return testing::AssertionSuccess();
}

/// Sends `bad` to a sequence that holds slice 0 of stack 0, and checks that nothing but the count changes.
testing::AssertionResult rejects(const Slice& bad, ArrivalStatus status, std::vector<std::string> words) {
  SliceSequence sequence;
  sequence.add(make_slice(0, 0));
  const double scale = sequence.intensity_scale();
  const Eigen::Vector3d centre = sequence.brain_roi().centre();
  words.push_back("stack " + std::to_string(bad.info.stack) + " slice " + std::to_string(bad.info.index) + " of scan " +
                  bad.info.scan_id);
  const Arrival foreseen = sequence.check(bad);
  const Arrival arrival = sequence.add(bad);
  if (foreseen.status != arrival.status || foreseen.reason != arrival.reason)
    return testing::AssertionFailure() << "check() says " << foreseen.reason << ", add() " << arrival.reason;
  if (sequence.slices().size() != 1 || sequence.intensity_scale() != scale || sequence.brain_roi().centre() != centre ||
      sequence.scan_id() != "a" || arrival.starts_scan)
    return testing::AssertionFailure() << "the sequence changed";
  if (sequence.arrivals().at(status) != 1) return testing::AssertionFailure() << "not counted";
  return answers(arrival, status, words);
}

std::string warnings(const Arrival& arrival) {
  return std::accumulate(arrival.warnings.begin(), arrival.warnings.end(), std::string());
}

// ---- accepted -------------------------------------------------------------------------------------------------------

TEST(SliceSequence, AcceptsGoodSlices) {
  SliceSequence sequence;
  for (int index = 0; index < 10; ++index) {
    const Arrival arrival = sequence.add(make_slice(0, index));
    EXPECT_TRUE(answers(arrival, ArrivalStatus::accepted, {}));
    EXPECT_EQ(arrival.reason, "");
    EXPECT_TRUE(arrival.warnings.empty()) << warnings(arrival);
    EXPECT_FALSE(arrival.starts_scan);
    EXPECT_EQ(sequence.newest_arrival()->info.index, index);
    EXPECT_EQ(sequence.newest_arrival()->arrival, static_cast<std::uint64_t>(index));
  }
  EXPECT_EQ(sequence.slices().size(), 10U);
  EXPECT_EQ(sequence.scan_id(), "a");
  EXPECT_DOUBLE_EQ(sequence.intensity_scale(), 100.);
  EXPECT_EQ(sequence.arrivals().at(ArrivalStatus::accepted), 10U);
}

TEST(SliceSequence, CheckChangesNothing) {
  SliceSequence sequence;
  EXPECT_EQ(sequence.check(make_slice(0, 0)).status, ArrivalStatus::accepted);
  EXPECT_TRUE(sequence.slices().empty());
  EXPECT_TRUE(sequence.arrivals().empty());
  EXPECT_EQ(sequence.newest_arrival(), nullptr);
  EXPECT_TRUE(sequence.brain_roi().empty());
  EXPECT_EQ(sequence.scan_id(), "");
}

TEST(SliceSequence, PointersStayValid) {
  SliceSequence sequence;
  sequence.add(make_slice(0, 5));
  const std::shared_ptr<const PreparedSlice> held = sequence.newest_arrival();
  for (int index = 0; index < 5; ++index) sequence.add(make_slice(0, index));
  EXPECT_EQ(sequence.slices().back(), held);
  sequence.add(make_slice(0, 0, "b"));
  EXPECT_EQ(held->info.index, 5);
  EXPECT_EQ(held->pixels.size(), 128U * 128U);
}

// ---- order ----------------------------------------------------------------------------------------------------------

TEST(SliceSequence, OutOfOrderIsKeptInItsPlace) {
  SliceSequence sequence;
  sequence.add(make_slice(0, 1));
  sequence.add(make_slice(0, 3));
  const Arrival arrival = sequence.add(make_slice(0, 2));
  EXPECT_TRUE(answers(arrival, ArrivalStatus::out_of_order,
                      {"stack 0 slice 2 of scan a", "3.000 s", "1.000 s before stack 0 slice 3"}));
  ASSERT_EQ(sequence.slices().size(), 3U);
  EXPECT_EQ(sequence.slices()[1]->info.index, 2);
  EXPECT_EQ(sequence.newest_arrival(), sequence.slices()[1]);
}

TEST(SliceSequence, LateIsKeptInItsPlace) {
  SliceSequence sequence;
  sequence.add(make_slice(0, 0));
  sequence.add(make_slice(1, 0));
  const Arrival arrival = sequence.add(make_slice(0, 1));
  EXPECT_TRUE(answers(arrival, ArrivalStatus::late,
                      {"stack 0 slice 1 of scan a", "2.000 s", "99.000 s before stack 1 slice 0"}));
  ASSERT_EQ(sequence.slices().size(), 3U);
  EXPECT_EQ(sequence.slices()[1]->info.index, 1);
}

TEST(SliceSequence, OutOfOrderWinsOverLate) {
  SliceSequence sequence;
  sequence.add(make_slice(0, 1));
  sequence.add(make_slice(1, 0));
  EXPECT_EQ(sequence.add(make_slice(0, 0)).status, ArrivalStatus::out_of_order);
}

TEST(SliceSequence, EqualTimesKeepTheOrderOfArrival) {
  SliceSequence sequence;
  for (const int index : {4, 2, 7, 0}) {
    Slice slice = make_slice(0, index);
    slice.info.stamp_ns = kSecond_ns;
    EXPECT_EQ(sequence.add(slice).status, ArrivalStatus::accepted);
  }
  std::vector<int> order;
  for (const auto& slice : sequence.slices()) order.push_back(slice->info.index);
  EXPECT_EQ(order, (std::vector<int>{4, 2, 7, 0}));
}

/// Nothing accepted is lost and nothing rejected gets in, whatever the order of good, repeated and bad slices.
TEST(SliceSequence, HoldsAllValidSlicesWhateverTheOrderOfArrival) {
  std::vector<Slice> good;
  for (int stack = 0; stack < 3; ++stack)
    for (int index = 0; index < 10; ++index) good.push_back(make_slice(stack, index));
  std::mt19937 random(7);
  for (int trial = 0; trial < 15; ++trial) {
    std::vector<Slice> sent = good;
    for (int i = 0; i < 15; ++i) sent.push_back(good[random() % good.size()]);  // repeats
    for (int i = 0; i < 15; ++i) {
      Slice bad = good[random() % good.size()];
      switch (i % 5) {
        case 0:
          bad.pixels[random() % bad.pixels.size()] = std::numeric_limits<float>::quiet_NaN();
          break;
        case 1:
          std::fill(bad.mask.begin(), bad.mask.end(), std::uint8_t{0});
          break;
        case 2:
          bad.info.index += 10;
          break;
        case 3:
          bad.info.pixel_spacing.x() = 0.;
          break;
        default:
          bad.pixels.pop_back();
      }
      sent.push_back(bad);
    }
    std::shuffle(sent.begin(), sent.end(), random);

    SliceSequence sequence;
    std::size_t kept = 0;
    for (const Slice& slice : sent) {
      const ArrivalStatus foreseen = sequence.check(slice).status;
      const Arrival arrival = sequence.add(slice);
      EXPECT_EQ(arrival.status, foreseen);
      if (is_kept(arrival.status)) ++kept;
      EXPECT_EQ(sequence.slices().size(), kept);
    }
    ASSERT_EQ(sequence.slices().size(), good.size());
    std::size_t counted = 0;
    for (const auto& [status, count] : sequence.arrivals()) counted += count;
    EXPECT_EQ(counted, sent.size());
    SliceSequence in_order;
    for (const Slice& slice : good) in_order.add(slice);
    for (std::size_t i = 0; i < good.size(); ++i) {
      const PreparedSlice& a = *sequence.slices()[i];
      const PreparedSlice& b = *in_order.slices()[i];
      EXPECT_EQ(a.info.stack, b.info.stack);
      EXPECT_EQ(a.info.index, b.info.index);
      EXPECT_EQ(a.pixels, b.pixels);
      EXPECT_EQ(a.mask, b.mask);
      EXPECT_EQ(a.T_slice_crop.matrix(), b.T_slice_crop.matrix());
    }
    EXPECT_EQ(sequence.brain_roi().centre(), in_order.brain_roi().centre());
    EXPECT_EQ(sequence.brain_roi().extent(), in_order.brain_roi().extent());
  }
}

// ---- rejected -------------------------------------------------------------------------------------------------------

TEST(SliceSequence, RejectsDuplicate) {
  Slice slice = make_slice(0, 0);
  slice.info.stamp_ns = 17 * kSecond_ns;
  EXPECT_TRUE(rejects(slice, ArrivalStatus::duplicate, {"1.000 s", "17.000 s", "new stack number"}));
}

TEST(SliceSequence, RejectsNegativeNumbers) {
  Slice slice = make_slice(0, 1);
  slice.info.index = -1;
  EXPECT_TRUE(rejects(slice, ArrivalStatus::bad_geometry, {"index -1"}));
  slice = make_slice(0, 1);
  slice.info.stack = -3;
  EXPECT_TRUE(rejects(slice, ArrivalStatus::bad_geometry, {"stack number -3"}));
  slice = make_slice(0, 1);
  slice.info.slices_in_stack = 0;
  EXPECT_TRUE(rejects(slice, ArrivalStatus::bad_geometry, {"slice count is 0", "at least 1"}));
}

TEST(SliceSequence, RejectsSpacingAndThickness) {
  for (const double value : {0., -1.5, std::numeric_limits<double>::quiet_NaN(), HUGE_VAL}) {
    Slice slice = make_slice(0, 1);
    slice.info.pixel_spacing.y() = value;
    EXPECT_TRUE(rejects(slice, ArrivalStatus::bad_geometry, {"pixel spacing 1.25 x ", "positive"}));
    slice = make_slice(0, 1);
    slice.info.thickness = value;
    EXPECT_TRUE(rejects(slice, ArrivalStatus::bad_geometry, {"thickness ", "positive"}));
  }
}

TEST(SliceSequence, RejectsPosesThatAreNotRigid) {
  Slice slice = make_slice(0, 1);
  slice.info.T_scanner_slice.linear() *= 1.01;
  EXPECT_TRUE(rejects(slice, ArrivalStatus::bad_geometry, {"not rigid", "determinant 1.03", "1e-4"}));
  slice = make_slice(0, 1);
  slice.info.T_scanner_slice.linear().col(2) *= -1.;
  EXPECT_TRUE(rejects(slice, ArrivalStatus::bad_geometry, {"not rigid", "determinant -1"}));
  slice = make_slice(0, 1);
  slice.info.T_scanner_slice.translation().z() = std::numeric_limits<double>::quiet_NaN();
  EXPECT_TRUE(rejects(slice, ArrivalStatus::bad_geometry, {"NaN or infinity"}));
}

TEST(SliceSequence, RejectsIndexBeyondThePrescription) {
  Slice slice = make_slice(0, 10);
  EXPECT_TRUE(rejects(slice, ArrivalStatus::excess_slice, {"index 10", "only 10 slices", "0 .. 9"}));
}

TEST(SliceSequence, RejectsImagesOfWrongLength) {
  Slice slice = make_slice(0, 1);
  slice.pixels.pop_back();
  EXPECT_TRUE(rejects(slice, ArrivalStatus::bad_image, {"3839 pixels", "60 columns x 64 rows", "3840"}));
  slice.pixels.clear();
  EXPECT_TRUE(rejects(slice, ArrivalStatus::bad_image, {"0 pixels"}));
  slice = make_slice(0, 1);
  slice.info.columns = 0;
  EXPECT_TRUE(rejects(slice, ArrivalStatus::bad_image, {"0 columns", "64 rows"}));
  slice.info.columns = -60;
  EXPECT_TRUE(rejects(slice, ArrivalStatus::bad_image, {"-60 columns"}));
}

TEST(SliceSequence, RejectsMasksOfWrongLength) {
  Slice slice = make_slice(0, 1);
  slice.mask.resize(100);
  EXPECT_TRUE(rejects(slice, ArrivalStatus::bad_image, {"mask holds 100 pixels", "60 x 64 = 3840"}));
}

TEST(SliceSequence, RejectsNanAndInfinityAnywhere) {
  Slice slice = make_slice(0, 1);
  slice.pixels[0] = std::numeric_limits<float>::quiet_NaN();  // a corner, far from the brain
  EXPECT_TRUE(rejects(slice, ArrivalStatus::bad_image, {"column 0, row 0", "nan"}));
  slice = make_slice(0, 1);
  slice.pixels[5 * 60 + 7] = std::numeric_limits<float>::infinity();
  EXPECT_TRUE(rejects(slice, ArrivalStatus::bad_image, {"column 7, row 5", "inf"}));
}

TEST(SliceSequence, RejectsEmptyMasks) {
  Slice slice = make_slice(0, 1);
  std::fill(slice.mask.begin(), slice.mask.end(), std::uint8_t{0});
  EXPECT_TRUE(rejects(slice, ArrivalStatus::empty_mask, {"no brain pixel"}));
  for (int column = 20; column < 26; ++column) slice.mask[static_cast<std::size_t>(30 * 60 + column)] = 1;
  EXPECT_TRUE(rejects(slice, ArrivalStatus::empty_mask, {" brain pixels of 1 mm", "at least 16"}));
}

TEST(SliceSequence, RejectsDarkImages) {
  Slice slice = make_slice(0, 1);
  std::fill(slice.pixels.begin(), slice.pixels.end(), 0.F);
  EXPECT_TRUE(rejects(slice, ArrivalStatus::empty_mask, {"0 brain pixels", "positive", "at least 16"}));
  slice.mask.clear();
  EXPECT_TRUE(rejects(slice, ArrivalStatus::empty_mask, {"0 brain pixels", "positive", "at least 16"}));
}

TEST(SliceSequence, RejectsSlicesThatDifferFromTheirStack) {
  const auto rejects_stack = [](const Slice& slice, const std::vector<std::string>& words) {
    return rejects(slice, ArrivalStatus::inconsistent_stack, words);
  };
  Slice slice = make_slice(0, 1);
  slice.info.slices_in_stack = 12;
  EXPECT_TRUE(rejects_stack(slice, {"slice count 12", "has 10"}));

  slice = make_slice(0, 1);
  std::swap(slice.info.columns, slice.info.rows);
  EXPECT_TRUE(rejects_stack(slice, {"size 64 x 60", "60 x 64"}));

  slice = make_slice(0, 1);
  slice.info.pixel_spacing.x() = 1.26;
  EXPECT_TRUE(rejects_stack(slice, {"spacing 1.26 x 1.1 mm", "1.25 x 1.1 mm", "tolerance 0.001 mm"}));

  slice = make_slice(0, 1);
  slice.info.thickness = 3.5;
  EXPECT_TRUE(rejects_stack(slice, {"thickness 3.5 mm", "3 mm", "tolerance 0.001 mm"}));

  slice = make_slice(0, 1);
  slice.info.T_scanner_slice.rotate(Eigen::AngleAxisd(2. * 3.14159265358979 / 180., Eigen::Vector3d::UnitX()));
  EXPECT_TRUE(rejects_stack(slice, {"orientation differs by 2 degrees", "tolerance 1 degrees"}));

  slice = make_slice(0, 1);
  slice.info.T_scanner_slice.translate(Eigen::Vector3d(0.6, 0.8, 0.));
  EXPECT_TRUE(rejects_stack(slice, {"1 mm in plane", "tolerance 0.5 mm"}));
}

TEST(SliceSequence, ToleratesRoundingWithinAStack) {
  SliceSequence sequence;
  sequence.add(make_slice(0, 0));
  Slice slice = make_slice(0, 1);
  slice.info.pixel_spacing.x() += 1e-4;
  slice.info.thickness -= 1e-4;
  slice.info.T_scanner_slice.rotate(Eigen::AngleAxisd(0.5 * 3.14159265358979 / 180., Eigen::Vector3d::UnitX()));
  slice.info.T_scanner_slice.translate(Eigen::Vector3d(0.2, 0.2, 5.));
  EXPECT_TRUE(answers(sequence.add(slice), ArrivalStatus::accepted, {}));
}

TEST(SliceSequence, OtherStacksMayDiffer) {
  SliceSequence sequence;
  sequence.add(make_slice(0, 0));
  Slice slice = make_slice(1, 0);
  slice.info.thickness = 4.;
  slice.info.slices_in_stack = 30;
  EXPECT_TRUE(answers(sequence.add(slice), ArrivalStatus::accepted, {}));
}

// ---- scans ----------------------------------------------------------------------------------------------------------

TEST(SliceSequence, NewScanStartsAfresh) {
  SliceSequence sequence;
  sequence.add(make_slice(0, 0));
  sequence.add(make_slice(0, 1));
  Slice slice = make_slice(0, 0, "b");
  std::fill(slice.pixels.begin(), slice.pixels.end(), 10.F);
  slice.info.thickness = 5.;  // the old scan's stacks do not bind the new one
  const Arrival foreseen = sequence.check(slice);
  EXPECT_TRUE(foreseen.starts_scan);
  EXPECT_EQ(sequence.slices().size(), 2U);
  const Arrival arrival = sequence.add(slice);
  EXPECT_TRUE(answers(arrival, ArrivalStatus::accepted, {}));
  EXPECT_TRUE(arrival.starts_scan);
  ASSERT_EQ(sequence.slices().size(), 1U);
  EXPECT_EQ(sequence.scan_id(), "b");
  EXPECT_DOUBLE_EQ(sequence.intensity_scale(), 10.);
  EXPECT_EQ(sequence.slices()[0]->arrival, 0U);
  EXPECT_EQ(sequence.arrivals().at(ArrivalStatus::accepted), 1U);
}

TEST(SliceSequence, RejectsSlicesOfEndedScans) {
  SliceSequence sequence;
  sequence.add(make_slice(0, 0));
  sequence.add(make_slice(0, 0, "b"));
  sequence.add(make_slice(0, 0, "c"));
  EXPECT_TRUE(answers(sequence.add(make_slice(0, 1)), ArrivalStatus::ended_scan, {"of scan a", "ended by scan c"}));
  EXPECT_TRUE(answers(sequence.add(make_slice(0, 1, "b")), ArrivalStatus::ended_scan, {"of scan b"}));
  EXPECT_EQ(sequence.slices().size(), 1U);
  EXPECT_EQ(sequence.arrivals().at(ArrivalStatus::ended_scan), 2U);
  sequence.reset();
  EXPECT_TRUE(answers(sequence.add(make_slice(0, 1)), ArrivalStatus::accepted, {}));
}

TEST(SliceSequence, InvalidSliceDoesNotStartAScan) {
  Slice slice = make_slice(0, 1, "b");
  slice.pixels[3] = std::numeric_limits<float>::quiet_NaN();
  EXPECT_TRUE(rejects(slice, ArrivalStatus::bad_image, {"column 3"}));
}

// ---- warnings -------------------------------------------------------------------------------------------------------

TEST(SliceSequence, WarnsAboutBrainsLargerThanTheField) {
  SliceSequenceOptions options;
  options.size_px = 30;
  SliceSequence sequence(options);
  const Slice slice = make_slice(0, 0);  // a disc of 20 mm radius: 32 x 1.25 mm and 36 x 1.1 mm
  const Arrival arrival = sequence.add(slice);
  EXPECT_EQ(arrival.status, ArrivalStatus::accepted);
  ASSERT_EQ(arrival.warnings.size(), 1U);
  const auto brain = std::count(slice.mask.begin(), slice.mask.end(), 1);
  std::size_t cut = 0;
  for (int row = 0; row < 64; ++row)
    for (int column = 0; column < 60; ++column)
      if (slice.mask[static_cast<std::size_t>(row * 60 + column)] &&
          pixel_position(slice.info, column, row).cwiseAbs().maxCoeff() > 15.)
        ++cut;
  ASSERT_GT(cut, 100U);
  for (const std::string& word : {std::string("40 x 39.6 mm"), std::string("margin of 3 mm"), std::string("30 x 30 mm"),
                                  std::to_string(cut) + " of " + std::to_string(brain) + " brain pixels are cut"})
    EXPECT_NE(arrival.warnings[0].find(word), std::string::npos) << word << " in " << arrival.warnings[0];
}

TEST(SliceSequence, MarginAloneWarnsThatNothingIsCut) {
  SliceSequenceOptions options;
  options.size_px = 42;
  SliceSequence sequence(options);
  const Arrival arrival = sequence.add(make_slice(0, 0));
  ASSERT_EQ(arrival.warnings.size(), 1U);
  EXPECT_NE(arrival.warnings[0].find("; 0 of "), std::string::npos) << arrival.warnings[0];
  options.margin_mm = 1.;
  EXPECT_TRUE(SliceSequence(options).add(make_slice(0, 0)).warnings.empty());
}

TEST(SliceSequence, KeepsTheWholeImageWithoutAMask) {
  SliceSequence sequence;
  Slice slice = make_slice(0, 0);
  slice.mask.clear();
  const Arrival arrival = sequence.add(slice);
  EXPECT_TRUE(answers(arrival, ArrivalStatus::accepted, {}));
  ASSERT_EQ(arrival.warnings.size(), 1U);
  EXPECT_NE(arrival.warnings[0].find("no mask"), std::string::npos);
  EXPECT_NE(arrival.warnings[0].find("image's centre"), std::string::npos);
  const PreparedSlice& prepared = *sequence.newest_arrival();
  // 60 x 1.25 = 75 mm wide, 64 x 1.1 = 70.4 mm high: pixel centres at -37.5 .. 37.5 and -34.5 .. 34.5 mm.
  EXPECT_EQ(prepared.brain_pixels, 76U * 70U);
  EXPECT_TRUE(prepared.T_slice_crop.isApprox(Pose::Identity()));
  EXPECT_FALSE(sequence.brain_roi().from_masks());
}

TEST(SliceSequence, LooksForTheBrainWhereMasksHaveShownIt) {
  SliceSequence sequence;
  Slice masked = make_slice(0, 0);
  paint(
      masked, [](double, double) { return 100.; },
      [](double x, double y) { return std::abs(x - 10.) < 8. && std::abs(y + 12.) < 6.; });
  sequence.add(masked);
  const Eigen::Vector3d centre = sequence.brain_roi().centre();
  Slice slice = make_slice(1, 4);
  slice.mask.clear();
  const Arrival arrival = sequence.add(slice);
  ASSERT_EQ(arrival.warnings.size(), 1U);
  EXPECT_NE(arrival.warnings[0].find("brain's centre so far"), std::string::npos);
  const Eigen::Vector3d in_crop =
      (slice.info.T_scanner_slice * sequence.newest_arrival()->T_slice_crop).inverse() * centre;
  EXPECT_NEAR(in_crop.x(), 0., 1e-9);
  EXPECT_NEAR(in_crop.y(), 0., 1e-9);
  EXPECT_EQ(sequence.brain_roi().centre(), centre);  // it does not tell where the brain is
}

// ---- options and names ----------------------------------------------------------------------------------------------

TEST(SliceSequence, NamesOptionsThatAreOutOfRange) {
  const auto message = [](const auto& change) -> std::string {
    SliceSequenceOptions options;
    change(options);
    try {
      SliceSequence sequence(options);
    } catch (const std::invalid_argument& error) {
      return error.what();
    }
    return "accepted";
  };
  using Options = SliceSequenceOptions;
  EXPECT_EQ(message([](Options& o) { o.size_px = 0; }), "sequence.size_px is 0, must be in 1 .. 4096");
  EXPECT_EQ(message([](Options& o) { o.resolution_mm = -1.; }),
            "sequence.resolution_mm is -1, must be finite and positive");
  EXPECT_EQ(message([](Options& o) { o.margin_mm = -2.; }), "sequence.margin_mm is -2, must be finite and at least 0");
  EXPECT_EQ(message([](Options& o) { o.min_brain_pixels = 0; }), "sequence.min_brain_pixels is 0, must be at least 1");
  EXPECT_EQ(message([](Options& o) { o.stack_angle_tolerance_deg = NAN; }),
            "sequence.stack_angle_tolerance_deg is nan, must be finite and at least 0");
  EXPECT_EQ(message([](Options& o) { o.stack_offset_tolerance_mm = -1.; }),
            "sequence.stack_offset_tolerance_mm is -1, must be finite and at least 0");
  EXPECT_EQ(message([](Options& o) { o.intensity.quantile = 1.5; }),
            "sequence.intensity.quantile is 1.5, must be in (0, 1]");
}

TEST(ArrivalStatus, EveryStatusHasAName) {
  EXPECT_STREQ(to_string(ArrivalStatus::accepted), "accepted");
  EXPECT_STREQ(to_string(ArrivalStatus::ended_scan), "ended_scan");
  std::set<std::string> names;
  for (int i = 0; i <= static_cast<int>(ArrivalStatus::ended_scan); ++i)
    names.insert(to_string(static_cast<ArrivalStatus>(i)));
  EXPECT_EQ(names.size(), 10U);
  EXPECT_THROW(to_string(static_cast<ArrivalStatus>(10)), std::invalid_argument);
}

}  // namespace
}  // namespace svort
