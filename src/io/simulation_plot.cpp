#include "svort_ros/io/simulation_plot.h"

#include <torch/types.h>

#include <algorithm>
#include <array>
#include <cmath>
#include <cstdio>
#include <opencv2/imgcodecs.hpp>
#include <opencv2/imgproc.hpp>
#include <stdexcept>
#include <vector>

#include "svort_ros/io/atomic_file.h"

namespace svort {
namespace {

const cv::Scalar kInk(40, 40, 40);
const cv::Scalar kGrey(120, 120, 120);
const cv::Scalar kGrid(225, 225, 225);
// Blue, orange and green that stay apart for colour-blind readers (BGR).
const std::array<cv::Scalar, 3> kColours = {cv::Scalar(178, 114, 0), cv::Scalar(0, 140, 230), cv::Scalar(115, 158, 0)};

void put_text(cv::Mat& image, const std::string& text, cv::Point at, double scale, const cv::Scalar& colour) {
  cv::putText(image, text, at, cv::FONT_HERSHEY_SIMPLEX, scale, colour, 1, cv::LINE_AA);
}

std::string rounded(double value) {
  char buffer[32];
  std::snprintf(buffer, sizeof buffer, "%.3g", value);
  return buffer;
}

/// Three curves over time in one frame.
void draw_traces(cv::Mat& image, const cv::Rect& frame, const std::string& name,
                 const std::vector<PlannedSlice>& slices, const std::vector<Eigen::Vector3d>& values) {
  double most = 1.;
  for (const Eigen::Vector3d& value : values) most = std::max(most, value.cwiseAbs().maxCoeff());
  const double begin = slices.front().time_s, span = std::max(1., slices.back().time_s - begin);
  const auto at = [&](double time, double value) {
    return cv::Point(frame.x + static_cast<int>(std::lround((time - begin) / span * frame.width)),
                     frame.y + static_cast<int>(std::lround((0.5 - 0.47 * value / most) * frame.height)));
  };
  for (const double level : {-most, -0.5 * most, 0., 0.5 * most, most}) {
    cv::line(image, at(begin, level), at(begin + span, level), kGrid, 1);
    put_text(image, rounded(level), {frame.x - 62, at(begin, level).y + 5}, 0.42, kInk);
  }
  for (std::size_t i = 1; i < slices.size(); ++i) {
    if (slices[i].stack == slices[i - 1].stack) continue;
    const int x = at(0.5 * (slices[i].time_s + slices[i - 1].time_s), 0.).x;
    cv::line(image, {x, frame.y}, {x, frame.y + frame.height}, cv::Scalar(170, 170, 170), 1);
  }
  for (int axis = 0; axis < 3; ++axis)
    for (std::size_t i = 0; i < slices.size(); ++i) {
      const cv::Point point = at(slices[i].time_s, values[i][axis]);
      const cv::Scalar& colour = kColours[static_cast<std::size_t>(axis)];
      if (i > 0) cv::line(image, at(slices[i - 1].time_s, values[i - 1][axis]), point, colour, 1, cv::LINE_AA);
      cv::circle(image, point, 3, colour, cv::FILLED, cv::LINE_AA);
    }
  cv::rectangle(image, frame, kInk, 1);
  put_text(image, name, {frame.x, frame.y - 8}, 0.55, kInk);
  const std::array<const char*, 3> axes = {"left", "posterior", "superior"};
  for (int axis = 0; axis < 3; ++axis)
    put_text(image, axes[static_cast<std::size_t>(axis)], {frame.x + frame.width - 270 + 90 * axis, frame.y - 8}, 0.5,
             kColours[static_cast<std::size_t>(axis)]);
}

}  // namespace

void plot_simulated_scan(const std::filesystem::path& path, const SimulatedScan& scan, const std::string& title) {
  const std::vector<PlannedSlice>& slices = scan.plan.acquired;
  if (slices.empty()) throw std::runtime_error(path.string() + ": there is no slice to draw");
  constexpr int kColumns = 10, kRows = 3, kTile = 140, kGap = 6, kLabel = 20, kLeft = 80, kTop = 64;
  constexpr int kTrace = 200;
  const int width = kLeft + kColumns * (kTile + kGap) + 20;
  const int mosaic = kRows * (kTile + kLabel + kGap);
  cv::Mat image(kTop + mosaic + 2 * (kTrace + 60) + 20, width, CV_8UC3, cv::Scalar(255, 255, 255));
  put_text(image, title, {kLeft, 34}, 0.75, kInk);

  const torch::Tensor pixels = scan.input.slices.to(torch::kCPU).contiguous();
  const auto size = static_cast<int>(pixels.size(2));
  const int shown = std::min<int>(kColumns * kRows, static_cast<int>(slices.size()));
  for (int tile = 0; tile < shown; ++tile) {
    // Evenly over the scan.
    const auto i = static_cast<std::size_t>(tile) * slices.size() / static_cast<std::size_t>(shown);
    const auto row = static_cast<std::int64_t>(i);
    const cv::Mat values(size, size, CV_32F, pixels[row].data_ptr<float>());
    cv::Mat grey, large, colour;
    values.convertTo(grey, CV_8U, 210.);
    cv::resize(grey, large, cv::Size(kTile, kTile), 0., 0., cv::INTER_LINEAR);
    cv::cvtColor(large, colour, cv::COLOR_GRAY2BGR);
    const cv::Point corner(kLeft + (tile % kColumns) * (kTile + kGap),
                           kTop + (tile / kColumns) * (kTile + kLabel + kGap));
    colour.copyTo(image(cv::Rect(corner.x, corner.y + kLabel, kTile, kTile)));
    std::string label = std::to_string(slices[i].stack) + "/" + std::to_string(slices[i].index);
    if (scan.displaced[row].item<bool>()) label += " moved";
    if (scan.voided[row].item<bool>()) label += " void";
    if (scan.noisy[row].item<bool>()) label += " noisy";
    if (!scan.dropped.empty() && scan.dropped[i]) label += " lost";
    put_text(image, label, {corner.x + 2, corner.y + 14}, 0.4, kInk);
  }

  std::vector<Eigen::Vector3d> rotations, translations;
  const Pose T_first_scanner = slices.front().T_scanner_brain.inverse();
  for (const PlannedSlice& slice : slices) {
    const Pose moved = T_first_scanner * slice.T_scanner_brain;  // in the brain's own axes
    const Eigen::AngleAxisd turn(moved.linear());
    rotations.emplace_back(turn.angle() * 180. / M_PI * turn.axis());
    translations.emplace_back(moved.translation());
  }
  const int top = kTop + mosaic + 40;
  const cv::Rect frame(kLeft, top, width - kLeft - 30, kTrace);
  draw_traces(image, frame, "head rotation, degrees", slices, rotations);
  draw_traces(image, frame + cv::Point(0, kTrace + 60), "head translation, mm", slices, translations);
  put_text(image,
           "stack/slice; " + rounded(slices.back().time_s - slices.front().time_s) +
               " s; axes of the brain, against its pose at the first slice",
           {kLeft, top + 2 * kTrace + 84}, 0.48, kGrey);
  std::vector<unsigned char> png;
  if (!cv::imencode(".png", image, png)) throw std::runtime_error(path.string() + ": cannot encode the picture");
  write_file(path, std::string(png.begin(), png.end()));
}

}  // namespace svort
