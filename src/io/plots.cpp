#include "svort_ros/io/plots.h"

#include <algorithm>
#include <array>
#include <cmath>
#include <cstdio>
#include <map>
#include <stdexcept>
#include <vector>

#include "drawing.h"

namespace svort {
namespace {

// ---- volume ---------------------------------------------------------------------------------------------------------

/// Trilinear value at a position in the volume's frame; 0 outside.
float sample(const Volume& volume, const Eigen::Affine3d& index_from_frame, const Eigen::Vector3d& position) {
  const Eigen::Vector3d index = index_from_frame * position;
  const Eigen::Vector3d floor = index.array().floor();
  double value = 0.;
  for (int corner = 0; corner < 8; ++corner) {
    const Eigen::Vector3i offset(corner & 1, (corner >> 1) & 1, (corner >> 2) & 1);
    const Eigen::Vector3i voxel = floor.cast<int>() + offset;
    if ((voxel.array() < 0).any() || (voxel.array() >= volume.grid.size.array()).any()) continue;
    double weight = 1.;
    for (int axis = 0; axis < 3; ++axis) {
      const double fraction = index[axis] - floor[axis];
      weight *= offset[axis] ? fraction : 1. - fraction;
    }
    value += weight * static_cast<double>(volume.values[volume.grid.offset(voxel.x(), voxel.y(), voxel.z())]);
  }
  return static_cast<float>(value);
}

/// One orthogonal view: which way the picture's axes point in the frame (LPS), and the letters at its edges.
struct View {
  const char* name;
  Eigen::Vector3d right;
  Eigen::Vector3d down;
  const char* letters;  ///< at the left, right, top and bottom edge
};

/// Radiological conventions: the patient's left is on the right, anterior is up (axial) or left (sagittal).
const std::array<View, 3>& views() {
  static const std::array<View, 3> all = {
      View{"axial", Eigen::Vector3d::UnitX(), Eigen::Vector3d::UnitY(), "RLAP"},
      View{"coronal", Eigen::Vector3d::UnitX(), -Eigen::Vector3d::UnitZ(), "RLSI"},
      View{"sagittal", Eigen::Vector3d::UnitY(), -Eigen::Vector3d::UnitZ(), "APSI"},
  };
  return all;
}

struct DisplayWindow {
  double half_mm = 0.;  ///< half the edge of the square that is shown
  float white = 1.F;    ///< value that is shown white; black is 0
};

/// The smallest square around the centre that holds everything but faint voxels, the same for all views.
DisplayWindow display_window(const Volume& volume) {
  const ImageGrid& grid = volume.grid;
  std::vector<float> positive;
  std::copy_if(volume.values.begin(), volume.values.end(), std::back_inserter(positive),
               [](float value) { return value > 0.F && std::isfinite(value); });
  DisplayWindow window;
  const Eigen::Vector3d centre = grid.T_frame_grid.translation();
  const Eigen::Vector3d extent =
      grid.T_frame_grid.linear().cwiseAbs() * (0.5 * grid.size.cast<double>().cwiseProduct(grid.spacing));
  window.half_mm = extent.maxCoeff();
  if (positive.empty()) return window;

  const auto rank = static_cast<std::ptrdiff_t>(0.995 * static_cast<double>(positive.size() - 1));
  std::nth_element(positive.begin(), positive.begin() + rank, positive.end());
  window.white = positive[static_cast<std::size_t>(rank)];

  double reach = 0.;
  for (int k = 0; k < grid.size.z(); ++k)
    for (int j = 0; j < grid.size.y(); ++j)
      for (int i = 0; i < grid.size.x(); ++i)
        if (volume.values[grid.offset(i, j, k)] > 0.05F * window.white)
          reach = std::max(reach, (grid.position(Eigen::Vector3d(i, j, k)) - centre).cwiseAbs().maxCoeff());
  constexpr double kMargin_mm = 8.;  // leaves room for the letters
  window.half_mm = std::min(window.half_mm, reach + kMargin_mm);
  return window;
}

/// 8-bit colour picture of `size` x `size` pixels.
cv::Mat render_view(const Volume& volume, const View& view, const DisplayWindow& window, int size) {
  Eigen::Affine3d frame_from_index(volume.grid.T_frame_grid.matrix());
  frame_from_index.scale(volume.grid.spacing);
  frame_from_index.translate(-0.5 * (volume.grid.size.cast<double>() - Eigen::Vector3d::Ones()));
  const Eigen::Affine3d index_from_frame = frame_from_index.inverse();

  // Sampled about once per voxel, then enlarged smoothly: direct sampling would show the trilinear facets.
  const double step = volume.grid.spacing.minCoeff();
  const int count = std::clamp(static_cast<int>(std::lround(2. * window.half_mm / step)), 2, size);
  cv::Mat plane(count, count, CV_32F);
  for (int row = 0; row < count; ++row)
    for (int column = 0; column < count; ++column) {
      const double u = ((column + 0.5) / count - 0.5) * 2. * window.half_mm;
      const double v = ((row + 0.5) / count - 0.5) * 2. * window.half_mm;
      const Eigen::Vector3d position = volume.grid.T_frame_grid.translation() + u * view.right + v * view.down;
      const float value = sample(volume, index_from_frame, position);
      plane.at<float>(row, column) = std::isfinite(value) ? value : 0.F;
    }
  cv::Mat large;
  cv::resize(plane, large, cv::Size(size, size), 0., 0., cv::INTER_CUBIC);
  cv::Mat grey;
  large.convertTo(grey, CV_8U, 255. / static_cast<double>(window.white));
  cv::Mat colour;
  cv::cvtColor(grey, colour, cv::COLOR_GRAY2BGR);
  return colour;
}

void annotate_view(cv::Mat& picture, const View& view, double half_mm) {
  const int size = picture.cols;
  const cv::Scalar letter_colour(120, 220, 255);
  const auto letter = [&view](int i) { return std::string(1, view.letters[i]); };
  put_text(picture, letter(0), {10, size / 2 + 8}, 0.8, letter_colour, Align::left, 2);
  put_text(picture, letter(1), {size - 10, size / 2 + 8}, 0.8, letter_colour, Align::right, 2);
  put_text(picture, letter(2), {size / 2, 28}, 0.8, letter_colour, Align::centre, 2);
  put_text(picture, letter(3), {size / 2, size - 12}, 0.8, letter_colour, Align::centre, 2);

  constexpr double kBar_mm = 20.;
  const int length = static_cast<int>(std::lround(kBar_mm * size / (2. * half_mm)));
  const cv::Point end(size - 16, size - 18);
  if (length > size / 2) return;  // a tiny volume: the bar would cover it
  cv::line(picture, {end.x - length, end.y}, end, kWhite, 2);
  for (const int x : {end.x - length, end.x}) cv::line(picture, {x, end.y - 5}, {x, end.y + 5}, kWhite, 2);
  put_text(picture, "20 mm", {end.x - length / 2, end.y - 10}, 0.5, kWhite, Align::centre);
}

// ---- latency --------------------------------------------------------------------------------------------------------

/// Median time between consecutive acquisitions of kept slices, ms; 0 if there are fewer than two times.
double repetition_time_ms(const Journal& journal) {
  std::vector<std::int64_t> stamps;
  for (const JournalEntry& entry : journal.entries())
    if (is_kept(entry.status)) stamps.push_back(entry.info.stamp_ns);
  std::sort(stamps.begin(), stamps.end());
  stamps.erase(std::unique(stamps.begin(), stamps.end()), stamps.end());
  if (stamps.size() < 2) return 0.;
  std::vector<std::int64_t> steps;
  for (std::size_t i = 1; i < stamps.size(); ++i) steps.push_back(stamps[i] - stamps[i - 1]);
  const auto middle = steps.begin() + static_cast<std::ptrdiff_t>(steps.size() / 2);
  std::nth_element(steps.begin(), middle, steps.end());
  return 1e-6 * static_cast<double>(*middle);
}

/// "0.5", "20", "1000"
std::string tick_label(double value) {
  std::array<char, 32> buffer{};
  std::snprintf(buffer.data(), buffer.size(), "%g", value);
  return buffer.data();
}

/// Maps arrivals and milliseconds (logarithmic: poses take a few, volumes hundreds) to pixels.
struct LatencyAxes {
  cv::Rect frame;
  double lower = 0.1;  ///< ms at the bottom
  double upper = 10.;  ///< ms at the top
  std::size_t count = 1;

  int x(std::size_t arrival) const {  // half a step of space at both ends
    return frame.x + static_cast<int>(
                         std::lround((static_cast<double>(arrival) + 0.5) / static_cast<double>(count) * frame.width));
  }
  int y(double ms) const {
    const double position = std::log(std::clamp(ms, lower, upper) / lower) / std::log(upper / lower);
    return frame.y + frame.height - static_cast<int>(std::lround(position * frame.height));
  }
};

LatencyAxes latency_axes(const Journal& journal, double tr_ms, const cv::Rect& frame) {
  double smallest = 1.;
  double largest = std::max(10., tr_ms);
  for (const JournalEntry& entry : journal.entries()) {
    for (const double ms : {entry.latency_ms, entry.volume_latency_ms}) {
      if (!std::isfinite(ms)) continue;
      largest = std::max(largest, ms);
      if (ms > 0.) smallest = std::min(smallest, ms);
    }
  }
  LatencyAxes axes;
  axes.frame = frame;
  // Whole decades below; above, as much room as the highest point needs.
  axes.lower = std::pow(10., std::floor(std::log10(std::max(smallest, 1e-3))));
  axes.upper = largest * 1.6;
  axes.count = std::max<std::size_t>(1, journal.entries().size());
  return axes;
}

void draw_axes(cv::Mat& image, const LatencyAxes& axes, const Journal& journal) {
  const cv::Rect& frame = axes.frame;
  const int right = frame.x + frame.width;
  const int bottom = frame.y + frame.height;
  for (double decade = axes.lower; decade <= axes.upper; decade *= 10.)
    for (const double factor : {1., 2., 5.}) {
      const double ms = decade * factor;
      if (ms > axes.upper) break;
      cv::line(image, {frame.x, axes.y(ms)}, {right, axes.y(ms)}, factor == 1. ? cv::Scalar(195, 195, 195) : kGrid, 1);
      put_text(image, tick_label(ms), {frame.x - 10, axes.y(ms) + 6}, 0.5, kInk, Align::right);
    }

  // Ticks of 1, 2 or 5 times a power of ten, at most about 20 of them.
  std::size_t step = 1;
  for (const std::size_t factor : {2U, 5U, 10U, 20U, 50U, 100U, 200U, 500U, 1000U})
    if (axes.count / step > 20) step = factor;
  for (std::size_t arrival = 0; arrival < axes.count; ++arrival) {
    if ((arrival + 1) % step != 0 && arrival != 0) continue;
    cv::line(image, {axes.x(arrival), bottom}, {axes.x(arrival), bottom + 6}, kInk, 1);
    put_text(image, std::to_string(arrival + 1), {axes.x(arrival), bottom + 26}, 0.5, kInk, Align::centre);
  }

  const auto& entries = journal.entries();
  for (std::size_t i = 0; i < entries.size(); ++i) {
    if (i > 0 && entries[i].info.stack == entries[i - 1].info.stack) continue;
    const int x = (i == 0) ? frame.x : (axes.x(i - 1) + axes.x(i)) / 2;
    std::size_t end = i;
    while (end < entries.size() && entries[end].info.stack == entries[i].info.stack) ++end;
    if (i > 0) cv::line(image, {x, frame.y}, {x, bottom}, cv::Scalar(150, 150, 150), 1);
    if (end - i >= axes.count / 12)  // else the name does not fit
      put_text(image, "stack " + std::to_string(entries[i].info.stack), {x + 8, bottom - 10}, 0.5,
               cv::Scalar(110, 110, 110));
  }
  cv::rectangle(image, frame, kInk, 1);

  put_text(image, "arrival", {frame.x + frame.width / 2, bottom + 54}, 0.6, kInk, Align::centre);
  cv::Mat label(30, 240, CV_8UC3, kWhite);
  put_text(label, "latency / ms", {120, 20}, 0.6, kInk, Align::centre);
  cv::rotate(label, label, cv::ROTATE_90_COUNTERCLOCKWISE);
  label.copyTo(image(cv::Rect(14, frame.y + frame.height / 2 - 120, label.cols, label.rows)));
}

void draw_dot(cv::Mat& image, cv::Point at, const cv::Scalar& colour) {
  cv::circle(image, at, 5, colour, cv::FILLED, cv::LINE_AA);
}
void draw_square(cv::Mat& image, cv::Point at, const cv::Scalar& colour) {
  cv::rectangle(image, at - cv::Point(4, 4), at + cv::Point(4, 4), colour, cv::FILLED);
}
void draw_cross(cv::Mat& image, cv::Point at, const cv::Scalar& colour) {
  cv::drawMarker(image, at, colour, cv::MARKER_TILTED_CROSS, 12, 2, cv::LINE_AA);
}
/// Dashes along a line of any shape; they go on around its corners.
void draw_dashes(cv::Mat& image, const std::vector<cv::Point>& points, const cv::Scalar& colour,
                 int type = cv::LINE_8) {
  constexpr double kDash = 9., kPeriod = 16.;  // pixels along the line
  double gone = 0.;
  for (std::size_t i = 0; i + 1 < points.size(); ++i) {
    const cv::Point2d from = points[i], way = cv::Point2d(points[i + 1]) - from;
    const double length = cv::norm(way);
    for (double begin = -std::fmod(gone, kPeriod); begin < length; begin += kPeriod) {
      const double first = std::max(begin, 0.), last = std::min(begin + kDash, length);
      if (last > first) cv::line(image, from + way * (first / length), from + way * (last / length), colour, 2, type);
    }
    gone += length;
  }
}
void draw_curve(cv::Mat& image, const std::vector<cv::Point>& points, const cv::Scalar& colour, bool dashed) {
  if (dashed)
    draw_dashes(image, points, colour, cv::LINE_AA);
  else
    cv::polylines(image, points, false, colour, 2, cv::LINE_AA);
}

}  // namespace

void plot_volume_views(const std::filesystem::path& path, const Volume& volume, const std::string& title) {
  if (volume.empty() || volume.values.size() != volume.grid.voxel_count())
    throw std::runtime_error(path.string() + ": cannot draw a volume of " + std::to_string(volume.values.size()) +
                             " values on a grid of " + std::to_string(volume.grid.voxel_count()) + " voxels");
  constexpr int kPanel = 490;
  constexpr int kGap = 10;
  constexpr int kTop = 84;
  constexpr int kBottom = 44;
  cv::Mat image(kTop + kPanel + kBottom, 3 * kPanel + 4 * kGap, CV_8UC3, cv::Scalar(28, 28, 28));
  put_text(image, ascii(title, 100), {kGap + 2, 34}, 0.75, kWhite);

  const DisplayWindow window = display_window(volume);
  int left = kGap;
  for (const View& view : views()) {
    cv::Mat picture = render_view(volume, view, window, kPanel);
    annotate_view(picture, view, window.half_mm);
    put_text(image, std::string(view.name) + " plane through the centre", {left + 2, kTop - 14}, 0.55,
             cv::Scalar(190, 190, 190));
    picture.copyTo(image(cv::Rect(left, kTop, kPanel, kPanel)));
    left += kPanel + kGap;
  }
  put_text(image,
           "R L A P S I: directions of the volume's frame (LPS). Without network and template these are the scanner's, "
           "that is the mother's.",
           {kGap + 2, kTop + kPanel + 28}, 0.52, cv::Scalar(190, 190, 190));
  write_png(path, image);
}

void plot_latency(const std::filesystem::path& path, const Journal& journal) {
  cv::Mat image(720, 1500, CV_8UC3, kWhite);
  const cv::Rect frame(96, 92, 1374, 550);
  const double tr_ms = repetition_time_ms(journal);
  const LatencyAxes axes = latency_axes(journal, tr_ms, frame);
  draw_axes(image, axes, journal);
  put_text(image, "Latency of each arriving slice", {frame.x, 36}, 0.75, kInk);

  if (tr_ms > 0.) {
    const int y = axes.y(tr_ms);
    draw_dashes(image, {{frame.x, y}, {frame.x + frame.width, y}}, kInk);
  }
  const auto& entries = journal.entries();
  std::map<std::string, std::size_t> drawn;
  for (std::size_t i = 0; i < entries.size(); ++i) {
    const JournalEntry& entry = entries[i];
    if (!is_kept(entry.status)) {
      draw_cross(image, {axes.x(i), axes.y(std::isfinite(entry.latency_ms) ? entry.latency_ms : axes.lower)}, kRed);
      ++drawn["rejected"];
      continue;
    }
    if (std::isfinite(entry.volume_latency_ms)) {
      draw_square(image, {axes.x(i), axes.y(entry.volume_latency_ms)}, kOrange);
      ++drawn["volume"];
    }
    if (std::isfinite(entry.latency_ms)) {
      draw_dot(image, {axes.x(i), axes.y(entry.latency_ms)}, kBlue);
      ++drawn["pose"];
    }
  }

  // Legend: one line above the frame.
  int x = frame.x + 6;
  const int y = 70;
  const auto entry = [&](const std::string& text, const auto& draw_symbol, int symbol_width) {
    draw_symbol(cv::Point(x, y));
    put_text(image, text, {x + symbol_width, y + 6}, 0.52, kInk);
    int baseline = 0;
    x += symbol_width + cv::getTextSize(text, cv::FONT_HERSHEY_SIMPLEX, 0.52, 1, &baseline).width + 44;
  };
  entry(
      "arrival to pose (" + std::to_string(drawn["pose"]) + ")", [&](cv::Point at) { draw_dot(image, at, kBlue); }, 14);
  entry(
      "arrival to volume (" + std::to_string(drawn["volume"]) + ")",
      [&](cv::Point at) { draw_square(image, at, kOrange); }, 14);
  entry(
      "rejected (" + std::to_string(drawn["rejected"]) + ")", [&](cv::Point at) { draw_cross(image, at, kRed); }, 14);
  if (tr_ms > 0.)
    entry(
        "repetition time " + tick_label(tr_ms) + " ms",
        [&](cv::Point at) {
          draw_dashes(image, {at - cv::Point(6, 0), at + cv::Point(35, 0)}, kInk);
        },
        46);
  if (entries.empty()) put_text(image, "no arrivals", {frame.x + frame.width / 2, 360}, 1., kInk, Align::centre);
  write_png(path, image);
}

// ---- curves ---------------------------------------------------------------------------------------------------------

namespace {

/// A step of 1, 2 or 5 times a power of ten that divides 0 .. `largest` into five to ten parts or so.
double tick_step(double largest) {
  const double decade = std::pow(10., std::floor(std::log10(largest)));
  for (const double factor : {0.1, 0.2, 0.5})
    if (largest / (factor * decade) <= 10.) return factor * decade;
  return decade;
}

std::string number_label(double value) {
  char text[32];
  std::snprintf(text, sizeof text, "%.6g", value);
  return text;
}

}  // namespace

void plot_curves(const std::filesystem::path& path, const std::string& title, const std::string& x_label,
                 const std::string& y_label, const std::vector<Curve>& curves) {
  write_file(path, curves_png(title, x_label, y_label, curves));
}

std::string curves_png(const std::string& title, const std::string& x_label, const std::string& y_label,
                       const std::vector<Curve>& curves) {
  std::vector<double> heights;
  double x_end = 0.;
  bool counted = true;
  for (const Curve& curve : curves) {
    for (const auto& [x, y] : curve.points) {
      if (!std::isfinite(x) || !std::isfinite(y)) continue;
      x_end = std::max(x_end, x);
      counted = counted && x == std::round(x);
      heights.push_back(y);
    }
  }
  std::sort(heights.begin(), heights.end());
  double y_end = heights.empty() ? 1. : 1.05 * heights[(heights.size() - 1) * 98 / 100];
  if (!(y_end > 0.)) y_end = 1.;
  if (!(x_end > 0.)) x_end = 1.;

  // Legend: where each name stands, in as many lines as they need.
  constexpr int kLeft = 96, kWidth = 1374, kLine = 24;
  std::vector<cv::Point> places;
  cv::Point place(kLeft + 6, 70);
  for (const Curve& curve : curves) {
    const int width = 38 + text_width(ascii(curve.name, 40), 0.52) + 34;
    if (place.x > kLeft + 6 && place.x + width > kLeft + kWidth) place = {kLeft + 6, place.y + kLine};
    places.push_back(place);
    place.x += width;
  }
  cv::Mat image(650 + place.y, 1500, CV_8UC3, kWhite);
  const cv::Rect frame(kLeft, place.y + 22, kWidth, 550);
  const int right = frame.x + frame.width;
  const int bottom = frame.y + frame.height;
  const auto at = [&](double x, double y) {
    return cv::Point(frame.x + static_cast<int>(std::lround(x / x_end * frame.width)),
                     bottom - static_cast<int>(std::lround(std::clamp(y / y_end, 0., 1.) * frame.height)));
  };
  for (double y = 0.; y <= y_end; y += tick_step(y_end)) {
    cv::line(image, at(0., y), {right, at(0., y).y}, kGrid, 1);
    put_text(image, number_label(y), at(0., y) + cv::Point(-10, 6), 0.5, kInk, Align::right);
  }
  // Things that are counted have no halves.
  const double x_step = counted ? std::max(1., tick_step(x_end)) : tick_step(x_end);
  for (double x = 0.; x <= x_end; x += x_step) {
    cv::line(image, {at(x, 0.).x, bottom}, {at(x, 0.).x, bottom + 6}, kInk, 1);
    put_text(image, number_label(x), {at(x, 0.).x, bottom + 26}, 0.5, kInk, Align::centre);
  }
  cv::rectangle(image, frame, kInk, 1);
  put_text(image, ascii(title, 100), {frame.x, 36}, 0.75, kInk);
  put_text(image, ascii(x_label, 80), {frame.x + frame.width / 2, bottom + 54}, 0.6, kInk, Align::centre);
  cv::Mat label(30, 400, CV_8UC3, kWhite);
  put_text(label, ascii(y_label, 40), {200, 20}, 0.6, kInk, Align::centre);
  cv::rotate(label, label, cv::ROTATE_90_COUNTERCLOCKWISE);
  label.copyTo(image(cv::Rect(8, frame.y + frame.height / 2 - 200, label.cols, label.rows)));

  const std::array<cv::Scalar, 10> colours = {kBlue,
                                              kOrange,
                                              kRed,
                                              cv::Scalar(115, 158, 0),
                                              cv::Scalar(167, 121, 204),
                                              cv::Scalar(100, 100, 100),
                                              cv::Scalar(233, 180, 86),
                                              cv::Scalar(66, 228, 240),
                                              cv::Scalar(40, 40, 110),
                                              cv::Scalar(60, 190, 150)};
  for (std::size_t i = 0; i < curves.size(); ++i) {
    const cv::Scalar& colour = colours[i % colours.size()];
    const bool dashed = i >= colours.size();  // colours come a second time
    std::vector<cv::Point> line;
    for (const auto& [x, y] : curves[i].points)
      if (std::isfinite(x) && std::isfinite(y)) line.push_back(at(x, y));
    if (!curves[i].dots) draw_curve(image, line, colour, dashed);
    if (curves[i].dots || line.size() == 1)
      for (const cv::Point& point : line) draw_dot(image, point, colour);
    draw_curve(image, {places[i], places[i] + cv::Point(30, 0)}, colour, dashed);
    put_text(image, ascii(curves[i].name, 40), places[i] + cv::Point(38, 6), 0.52, kInk);
  }
  return encode_png(image);
}

}  // namespace svort
