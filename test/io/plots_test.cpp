#include "svort_ros/io/plots.h"

#include <cmath>
#include <limits>
#include <opencv2/imgcodecs.hpp>

#include "io/scratch.h"

namespace svort {
namespace {

using Plots = Scratch;

/// Mean grey value around a point given as fractions of the panel `index` (0 axial, 1 coronal, 2 sagittal).
double panel_value(const cv::Mat& image, int index, double x, double y) {
  constexpr int kPanel = 490, kGap = 10, kTop = 84;
  const cv::Rect patch(kGap + index * (kPanel + kGap) + static_cast<int>(x * kPanel) - 8,
                       kTop + static_cast<int>(y * kPanel) - 8, 16, 16);
  return cv::mean(image(patch))[0];
}

/// A cube of 48 mm with one bright ball of 7 mm radius at `centre` (mm, in the volume's frame), on a dim background.
Volume ball(const Eigen::Vector3d& centre) {
  Volume volume;
  volume.grid.size = {48, 48, 48};
  volume.grid.T_frame_grid = Pose(Eigen::AngleAxisd(0.5, Eigen::Vector3d(1., 1., 0.).normalized()));
  for (int k = 0; k < 48; ++k)
    for (int j = 0; j < 48; ++j)
      for (int i = 0; i < 48; ++i)
        volume.values.push_back((volume.grid.position(Eigen::Vector3d(i, j, k)) - centre).norm() < 7. ? 10.F : 1.F);
  return volume;
}

/// Left is right, posterior is down (axial) or right (sagittal), superior is up; also on a rotated grid.
TEST_F(Plots, ViewsFollowThePatientsDirections) {
  // The window is the grid's own box along the frame's axes: half of it in mm.
  const Volume grid_only = ball(Eigen::Vector3d::Zero());
  const double half = (grid_only.grid.T_frame_grid.linear().cwiseAbs() * Eigen::Vector3d::Constant(24.)).maxCoeff();
  const auto value_at = [&](const Eigen::Vector3d& centre, int panel, double right_mm, double down_mm) {
    plot_volume_views(path("v.png"), ball(centre), "title");
    const cv::Mat image = cv::imread(path("v.png").string());
    EXPECT_GE(image.cols, 1400);
    return panel_value(image, panel, 0.5 + 0.5 * right_mm / half, 0.5 + 0.5 * down_mm / half);
  };
  constexpr double kBright = 200., kDim = 60.;
  const Eigen::Vector3d left(12., 0., 0.), posterior(0., 12., 0.), superior(0., 0., 12.);
  EXPECT_GT(value_at(left, 0, 12., 0.), kBright);
  EXPECT_LT(value_at(left, 0, -12., 0.), kDim);
  EXPECT_GT(value_at(left, 1, 12., 0.), kBright);
  EXPECT_LT(value_at(left, 2, 12., 0.), kDim);
  EXPECT_GT(value_at(posterior, 0, 0., 12.), kBright);
  EXPECT_GT(value_at(posterior, 2, 12., 0.), kBright);
  EXPECT_LT(value_at(posterior, 1, 0., 12.), kDim);
  EXPECT_GT(value_at(superior, 1, 0., -12.), kBright);
  EXPECT_GT(value_at(superior, 2, 0., -12.), kBright);
  EXPECT_LT(value_at(superior, 0, 0., -12.), kDim);
}

TEST_F(Plots, OddVolumesAreDrawnToo) {
  Volume volume = ball(Eigen::Vector3d::Zero());
  std::fill(volume.values.begin(), volume.values.end(), 0.F);
  plot_volume_views(path("zero.png"), volume, "");
  volume.values[100] = std::numeric_limits<float>::quiet_NaN();
  plot_volume_views(path("nan.png"), volume, std::string(300, 'x') + "\n\xff");
  Volume tiny;
  tiny.grid.size = {1, 1, 1};
  tiny.values = {1.F};
  plot_volume_views(path("tiny.png"), tiny, "one voxel");
  for (const std::string name : {"zero.png", "nan.png", "tiny.png"})
    EXPECT_FALSE(cv::imread(path(name).string()).empty()) << name;
  EXPECT_MESSAGE(plot_volume_views(path("a.png"), Volume(), "x"), path("a.png").string() + ": cannot draw");
  EXPECT_MESSAGE(plot_volume_views(path("none/a.png"), tiny, "x"), path("none/a.png").string());
}

Journal journal(int count) {
  Journal journal;
  for (int i = 0; i < count; ++i) {
    JournalEntry entry;
    entry.info.stack = i / 20;
    entry.info.stamp_ns = 1200000000 * static_cast<std::int64_t>(i);
    entry.latency_ms = 4. + i % 3;
    entry.volume_latency_ms = i % 7 == 3 ? std::numeric_limits<double>::quiet_NaN() : 200. + 3. * i;
    if (i % 20 == 19) entry.status = ArrivalStatus::empty_mask;
    journal.add(entry);
  }
  return journal;
}

/// Pixels of a colour (BGR) in the area of the curves, without the legend.
int count_colour(const cv::Mat& image, const cv::Scalar& colour) {
  cv::Mat match;
  cv::inRange(image(cv::Rect(97, 93, 1372, 548)), colour, colour, match);
  return cv::countNonZero(match);
}

TEST_F(Plots, LatencyShowsEveryKindOfPoint) {
  plot_latency(path("l.png"), journal(60));
  const cv::Mat image = cv::imread(path("l.png").string());
  ASSERT_FALSE(image.empty());
  EXPECT_GT(count_colour(image, {178, 114, 0}), 50 * 40);  // poses: discs of 10 pixels across
  EXPECT_GT(count_colour(image, {0, 159, 230}), 45 * 60);  // volumes: squares of 9 pixels
  EXPECT_GT(count_colour(image, {0, 60, 200}), 3 * 10);    // three rejected
  EXPECT_GT(count_colour(image, {40, 40, 40}), 1000);      // the repetition time
  Journal kept_only;
  const Journal all = journal(60);
  for (const JournalEntry& entry : all.entries())
    if (is_kept(entry.status)) kept_only.add(entry);
  plot_latency(path("k.png"), kept_only);
  EXPECT_EQ(count_colour(cv::imread(path("k.png").string()), {0, 60, 200}), 0);
}

TEST_F(Plots, LatencyOfFewOrStrangeArrivals) {
  plot_latency(path("none.png"), Journal());
  plot_latency(path("one.png"), journal(1));
  plot_latency(path("many.png"), journal(3000));
  std::vector<JournalEntry> entries = journal(4).entries();
  entries[0].latency_ms = 0.;
  entries[1].latency_ms = std::numeric_limits<double>::quiet_NaN();
  entries[2].volume_latency_ms = 1e7;
  Journal strange;
  for (const JournalEntry& entry : entries) strange.add(entry);
  plot_latency(path("strange.png"), strange);
  for (const std::string name : {"none.png", "one.png", "many.png", "strange.png"})
    EXPECT_FALSE(cv::imread(path(name).string()).empty()) << name;
  EXPECT_MESSAGE(plot_latency(path("none/a.png"), strange), path("none/a.png").string());
}

TEST_F(Plots, SameBytesForTheSameInput) {
  plot_latency(path("a.png"), journal(30));
  plot_latency(path("b.png"), journal(30));
  EXPECT_EQ(read(path("a.png")), read(path("b.png")));
  plot_volume_views(path("c.png"), ball({3., 2., 1.}), "x");
  plot_volume_views(path("d.png"), ball({3., 2., 1.}), "x");
  EXPECT_EQ(read(path("c.png")), read(path("d.png")));
}

TEST_F(Plots, CurvesOfTheSameColourAreToldApart) {
  std::vector<Curve> curves;
  for (int i = 0; i < 11; ++i) curves.push_back({"c", {{0., 11. - i}, {10., 11. - i}}});
  plot_curves(path("c.png"), "title", "step", "loss", curves);
  const cv::Mat image = cv::imread(path("c.png").string());
  ASSERT_EQ(image.size(), cv::Size(1500, 720));
  const auto blue_share = [&image](double value) {
    const int y = 92 + 550 - static_cast<int>(std::lround(550. * value / (1.05 * 11.)));
    int blue = 0;
    for (int x = 200; x < 1400; ++x) {
      const cv::Vec3b pixel = image.at<cv::Vec3b>(y, x);
      blue += pixel[0] - pixel[2] > 100 ? 1 : 0;
    }
    return blue / 1200.;
  };
  EXPECT_GT(blue_share(11.), 0.99);  // the first
  EXPECT_GT(blue_share(1.), 0.5);    // the eleventh has its colour, dashed
  EXPECT_LT(blue_share(1.), 0.9);
}

TEST_F(Plots, CurvesLieWhereTheirValuesSay) {
  const double nan = std::numeric_limits<double>::quiet_NaN();
  plot_curves(path("c.png"), "title", "step", "loss", {{"flat", {{0., 2.}, {5., nan}, {10., 2.}}}, {"empty", {}}});
  const cv::Mat image = cv::imread(path("c.png").string());
  ASSERT_EQ(image.size(), cv::Size(1500, 720));
  // One value, so the axis ends 5 % above it: the line is 1 / 1.05 of the frame's height above its lower edge.
  const int y = 92 + 550 - static_cast<int>(std::lround(550. / 1.05));
  const cv::Vec3b on = image.at<cv::Vec3b>(y, 700), off = image.at<cv::Vec3b>(y + 12, 700);
  EXPECT_GT(on[0] - on[2], 100);  // blue
  EXPECT_LT(std::abs(off[0] - off[2]), 20);
  EXPECT_THROW(plot_curves(path("missing/c.png"), "", "", "", {}), std::runtime_error);
}

}  // namespace
}  // namespace svort
