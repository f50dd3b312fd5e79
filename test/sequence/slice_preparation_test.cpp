// What a kept slice looks like: crop window, resampling, mask.

#include <gtest/gtest.h>

#include <cmath>
#include <random>

#include "sequence/slice_fixture.h"
#include "svort_ros/sequence/slice_sequence.h"

namespace svort {
namespace {

/// A slice of the given size and spacing without content.
Slice blank(int columns, int rows, double sx, double sy) {
  Slice slice = make_slice(0, 0);
  slice.info.columns = columns;
  slice.info.rows = rows;
  slice.info.pixel_spacing = {sx, sy};
  return slice;
}

std::shared_ptr<const PreparedSlice> prepare(const Slice& slice, const SliceSequenceOptions& options = {}) {
  SliceSequence sequence(options);
  const Arrival arrival = sequence.add(slice);
  EXPECT_EQ(arrival.status, ArrivalStatus::accepted) << arrival.reason;
  return sequence.newest_arrival();
}

/// Position of a crop pixel in slice coordinates, mm.
Eigen::Vector2d crop_position(const PreparedSlice& slice, int u, int v) {
  const double centre = 0.5 * (slice.size - 1);
  const Eigen::Vector3d in_crop((u - centre) * slice.resolution, (v - centre) * slice.resolution, 0.);
  return (slice.T_slice_crop * in_crop).head<2>();
}

struct Case {
  int columns, rows;
  double sx, sy;
  int size_px;
  double resolution;
};

std::ostream& operator<<(std::ostream& stream, const Case& c) {
  return stream << c.columns << " x " << c.rows << " pixels of " << c.sx << " x " << c.sy << " mm to " << c.size_px
                << " px of " << c.resolution << " mm";
}

// Even and odd sizes, shrinking, enlarging and mixed.
const Case kCases[] = {{120, 100, 1.125, 1.125, 128, 1.}, {121, 101, 0.8, 1.3, 128, 1.}, {200, 151, 0.5, 0.7, 127, 1.},
                       {90, 91, 1., 1., 128, 1.},         {91, 90, 1., 1., 127, 1.},     {75, 80, 1.7, 1.7, 64, 2.},
                       {160, 160, 0.6, 0.6, 61, 1.7}};

class SlicePreparation : public testing::TestWithParam<Case> {
 protected:
  SliceSequenceOptions options() const {
    SliceSequenceOptions options;
    options.size_px = GetParam().size_px;
    options.resolution_mm = GetParam().resolution;
    return options;
  }
  Slice slice() const { return blank(GetParam().columns, GetParam().rows, GetParam().sx, GetParam().sy); }
};

/// A ramp that runs through the pixels must run through the crop at the very same millimetres.
TEST_P(SlicePreparation, RampsKeepTheirPlace) {
  for (const bool along_x : {true, false}) {
    Slice ramp = slice();
    paint(
        ramp, [&](double x, double y) { return along_x ? x : y; },
        [](double x, double y) { return std::abs(x - 3.3) < 17.1 && std::abs(y + 2.1) < 13.2; });
    const auto prepared = prepare(ramp, options());
    double sum = 0., sum_p = 0., sum_pp = 0., worst = 0.;
    int count = 0;
    for (int v = 0; v < prepared->size; ++v)
      for (int u = 0; u < prepared->size; ++u) {
        const auto i = static_cast<std::size_t>(v * prepared->size + u);
        if (!prepared->mask[i]) continue;
        const Eigen::Vector2d at = crop_position(*prepared, u, v);
        const double p = along_x ? at.x() : at.y();
        const double error = static_cast<double>(prepared->pixels[i]) - p;
        worst = std::max(worst, std::abs(error));
        sum += error;
        sum_p += error * p;
        sum_pp += p * p;
        ++count;
      }
    ASSERT_GT(count, 100);
    EXPECT_LT(worst, 4e-6);                     // float32 at 20 mm: 1e-6 per rounding
    EXPECT_LT(std::abs(sum / count), 1e-6);     // shift, mm
    EXPECT_LT(std::abs(sum_p / sum_pp), 1e-6);  // stretch, mm per mm
  }
}

TEST_P(SlicePreparation, BlobsKeepTheirPlace) {
  Slice blob = slice();
  const Eigen::Vector2d centre(4.21, -3.37);
  paint(
      blob,
      [&](double x, double y) {
        return std::exp(-0.5 * (std::pow((x - centre.x()) / 3., 2) + std::pow((y - centre.y()) / 4., 2)));
      },
      [&](double x, double y) { return std::abs(x - 4.) < 24. && std::abs(y + 3.) < 26.; });
  const auto prepared = prepare(blob, options());
  Eigen::Vector2d moment = Eigen::Vector2d::Zero();
  double total = 0.;
  for (int v = 0; v < prepared->size; ++v)
    for (int u = 0; u < prepared->size; ++u) {
      const double value = static_cast<double>(prepared->pixels[static_cast<std::size_t>(v * prepared->size + u)]);
      moment += value * crop_position(*prepared, u, v);
      total += value;
    }
  // Linear interpolation of pixels of up to 1.7 mm moves the centroid of such a blob by up to 0.01 mm; a grid that is
  // off by half a pixel would move it by 0.25 mm or more.
  EXPECT_LT((moment / total - centre).norm(), 0.015);
}

TEST_P(SlicePreparation, WindowIsCentredOnTheMask) {
  Slice image = slice();
  paint(
      image, [](double, double) { return 1.; },
      [](double x, double y) { return std::abs(x - 3.3) < 17.1 && std::abs(y + 2.1) < 13.2; });
  Eigen::Vector2d lower = {1e9, 1e9}, upper = {-1e9, -1e9};
  for (int row = 0; row < image.info.rows; ++row)
    for (int column = 0; column < image.info.columns; ++column)
      if (image.mask[static_cast<std::size_t>(row * image.info.columns + column)]) {
        lower = lower.cwiseMin(pixel_position(image.info, column, row));
        upper = upper.cwiseMax(pixel_position(image.info, column, row));
      }
  const auto prepared = prepare(image, options());
  const Eigen::Vector3d shift = prepared->T_slice_crop.translation();
  const Eigen::Vector2d expected = 0.5 * (lower + upper);
  for (int axis = 0; axis < 2; ++axis) {
    const bool copied = image.info.pixel_spacing[axis] == prepared->resolution;
    EXPECT_LE(std::abs(shift[axis] - expected[axis]), copied ? 0.5 * prepared->resolution : 1e-12);
  }
  EXPECT_EQ(shift.z(), 0.);
  EXPECT_TRUE(prepared->T_slice_crop.linear().isIdentity(0.));
}

/// The brain's area is kept, and so is the number that says so.
TEST_P(SlicePreparation, MasksKeepTheirArea) {
  Slice image = slice();
  const auto disc = [](double x, double y) { return std::hypot(x - 1.3, y + 0.7) < 22.; };
  paint(
      image, [](double, double) { return 1.; }, disc);
  const auto prepared = prepare(image, options());
  const auto ones = std::count(prepared->mask.begin(), prepared->mask.end(), 1);
  EXPECT_EQ(static_cast<std::size_t>(ones), prepared->brain_pixels);
  const double area = static_cast<double>(ones) * prepared->resolution * prepared->resolution;
  const double truth = std::acos(-1.) * 22. * 22.;
  EXPECT_NEAR(area / truth, 1., 0.03);  // the border is 138 mm long, and each pixel on it may be off by half
}

INSTANTIATE_TEST_SUITE_P(Grids, SlicePreparation, testing::ValuesIn(kCases));

TEST(SliceResampling, CopiesPixelsOfTheRightSize) {
  for (const int columns : {64, 65}) {
    Slice slice = blank(columns, 70, 1., 1.);
    std::mt19937 random(5);
    paint(
        slice, [&](double, double) { return 1. + static_cast<double>(random() % 1000); },
        [](double x, double y) { return std::abs(x - 2.) < 11.7 && std::abs(y - 3.) < 8.2; });
    const auto prepared = prepare(slice);
    const Eigen::Vector3d shift = prepared->T_slice_crop.translation();
    std::size_t compared = 0;
    for (int row = 0; row < 70; ++row)
      for (int column = 0; column < columns; ++column) {
        const auto from = static_cast<std::size_t>(row * columns + column);
        if (!slice.mask[from]) continue;
        const Eigen::Vector2d at = pixel_position(slice.info, column, row) - shift.head<2>();
        const int u = static_cast<int>(std::lround(at.x() + 63.5));
        const int v = static_cast<int>(std::lround(at.y() + 63.5));
        EXPECT_EQ(prepared->pixels[static_cast<std::size_t>(v * 128 + u)], slice.pixels[from]);
        ++compared;
      }
    EXPECT_EQ(compared, prepared->brain_pixels);
  }
}

TEST(SliceResampling, NoDarkRimAtTheBrainsBorder) {
  Slice slice = blank(150, 140, 0.7, 0.9);
  paint(
      slice, [](double, double) { return 100.; }, [](double x, double y) { return std::hypot(x, y) < 25.; });
  const auto prepared = prepare(slice);
  for (std::size_t i = 0; i < prepared->mask.size(); ++i)
    EXPECT_NEAR(prepared->pixels[i], prepared->mask[i] ? 100.F : 0.F, 1e-3F);
}

/// Stripes finer than the new pixels must vanish, not turn into wider stripes.
TEST(SliceResampling, DoesNotAlias) {
  Slice slice = blank(180, 180, 0.55, 0.55);
  paint(
      slice, [](double x, double) { return std::lround(x / 0.55 + 89.5) % 2 ? 150. : 50.; },
      [](double x, double y) { return std::hypot(x, y) < 30.; });
  const auto prepared = prepare(slice);
  for (std::size_t i = 0; i < prepared->mask.size(); ++i)
    if (prepared->mask[i]) {
      EXPECT_NEAR(prepared->pixels[i], 100.F, 5.5F);  // the prefilter passes 10 % at the finest frequency there is
    }
}

TEST(SliceResampling, OffTheImageThereIsNothing) {
  Slice slice = blank(60, 50, 1.25, 1.25);  // 75 x 62.5 mm in a field of 128 mm, the brain in a corner
  paint(
      slice, [](double, double) { return 100.; }, [](double x, double y) { return x < -10. && y < -8.; });
  const auto prepared = prepare(slice);
  for (int v = 0; v < 128; ++v)
    for (int u = 0; u < 128; ++u) {
      const Eigen::Vector2d at = crop_position(*prepared, u, v);
      if (std::abs(at.x()) > 37.5 || std::abs(at.y()) > 31.25) {
        EXPECT_EQ(prepared->pixels[static_cast<std::size_t>(v * 128 + u)], 0.F);
      }
    }
  EXPECT_GT(prepared->brain_pixels, 0U);
}

TEST(SliceResampling, OnePixelWideImages) {
  Slice slice = blank(1, 40, 8., 1.);
  paint(
      slice, [](double, double y) { return 100. + y; }, [](double, double) { return true; });
  const auto prepared = prepare(slice);
  EXPECT_EQ(prepared->brain_pixels, 8U * 40U);
}

}  // namespace
}  // namespace svort
