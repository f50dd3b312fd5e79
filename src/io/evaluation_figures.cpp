// Pictures of a table of methods.

#include <torch/types.h>

#include <algorithm>
#include <cctype>
#include <cmath>
#include <map>

#include "drawing.h"
#include "svort_ros/io/plots.h"
#include "table_rows.h"

namespace svort {
namespace {

/// Means of the values that fell on each x, by ascending x.
class Means {
 public:
  void add(double x, double y) {
    if (!std::isfinite(y)) return;
    sums_[x].first += y;
    sums_[x].second += 1.;
  }
  Curve curve(const std::string& name) const {
    Curve result{name, {}};
    for (const auto& [x, sum] : sums_) result.points.emplace_back(x, sum.first / sum.second);
    return result;
  }

 private:
  std::map<double, std::pair<double, double>> sums_;
};

/// One curve per row of the plan. @param x of an entry, after rounding @param y of an entry
template <class Entry, class X, class Y>
std::vector<Curve> curves_of(const TablePlan& plan, const TableRows& rows, const std::vector<Entry>& entries,
                             const std::vector<int>& stacks, const X& x, const Y& y) {
  std::vector<Curve> curves;
  for (const TableRow& row : rows.rows) {
    Means means;
    for (const Entry& entry : entries)
      for (const int count : stacks)
        if (belongs(entry, plan, row, count)) means.add(x(entry), y(entry));
    curves.push_back(means.curve(row.method.name));
  }
  // A method without such an error (no frame, say) needs no place in the legend.
  curves.erase(std::remove_if(curves.begin(), curves.end(), [](const Curve& c) { return c.points.empty(); }),
               curves.end());
  return curves;
}

/// For a file's name: letters and digits, with "_" between words.
std::string file_name(const std::string& name) {
  std::string result;
  bool gap = false;
  for (const char c : name) {
    if (!std::isalnum(static_cast<unsigned char>(c))) {
      gap = !result.empty();
      continue;
    }
    if (gap) result += '_';
    gap = false;
    result += static_cast<char>(std::tolower(static_cast<unsigned char>(c)));
  }
  return result;
}

/// A plane of a volume as a grey picture, `size` pixels high and wide. @param plane rows x columns
cv::Mat grey_picture(const torch::Tensor& plane, double white, int size) {
  const torch::Tensor bytes = (plane * (255. / white)).clamp(0., 255.).to(torch::kUInt8).contiguous();
  const cv::Mat grey(static_cast<int>(bytes.size(0)), static_cast<int>(bytes.size(1)), CV_8U, bytes.data_ptr());
  cv::Mat large, colour;
  cv::resize(grey, large, cv::Size(size, size), 0., 0., cv::INTER_CUBIC);
  cv::cvtColor(large, colour, cv::COLOR_GRAY2BGR);
  return colour;
}

void plot_volumes(const std::filesystem::path& path, const TableScore& score, const TablePictures& pictures) {
  struct Column {
    std::string name;
    torch::Tensor volume;
    const VolumeScore* score;
  };
  const std::vector<Column> columns = {{"truth", pictures.truth, nullptr},
                                       {"PSF reconstruction", pictures.psf, &score.psf},
                                       {"w = 1", pictures.unweighted, &score.unweighted},
                                       {"weighted", pictures.weighted, &score.weighted}};
  constexpr int kPanel = 300, kGap = 8, kTop = 90;
  cv::Mat image(kTop + 3 * (kPanel + kGap), kGap + 4 * (kPanel + kGap), CV_8UC3, cv::Scalar(28, 28, 28));
  put_text(image, ascii(score.method + ": volumes of " + score.brain + ", " + score.motion + " motion", 90),
           {kGap + 2, 34}, 0.75, kWhite);
  int left = kGap;
  for (const Column& column : columns) {
    // The brain fills the picture; every volume with the gain that fits the truth.
    const torch::Tensor truth = pictures.truth, volume = column.volume;
    const torch::Tensor brain = truth > 0;
    const double gain =
        ((volume * truth * brain).sum() / (volume.square() * brain).sum().clamp_min(1e-12)).item<double>();
    const double white = truth.max().item<double>();
    const std::int64_t size = truth.size(0), edge = size / 8;
    const auto plane = [&](int dimension) {
      torch::Tensor cut = volume.select(dimension, size / 2).slice(0, edge, size - edge).slice(1, edge, size - edge);
      // Arrays grow to superior, posterior, left: rows of the axial plane already go down to the back of the head.
      return (dimension == 0 ? cut : cut.flip({0})) * gain;
    };
    std::string caption = column.name;
    if (column.score != nullptr)
      caption += ": " + fixed(column.score->psnr_db, 1) + " dB, " + fixed(column.score->ssim, 3);
    put_text(image, caption, {left + 2, kTop - 14}, 0.5, cv::Scalar(190, 190, 190));
    for (int dimension = 0; dimension < 3; ++dimension)
      grey_picture(plane(dimension), white, kPanel)
          .copyTo(image(cv::Rect(left, kTop + dimension * (kPanel + kGap), kPanel, kPanel)));
    left += kPanel + kGap;
  }
  write_png(path, image);
}

void plot_attention(const std::filesystem::path& path, const TableScore& score, const TablePictures& pictures) {
  const torch::Tensor mean = pictures.attention.to(torch::kFloat32).mean(0);  // rows sum to 1
  const std::int64_t n = mean.size(0);
  constexpr int kLeft = 70, kTop = 100, kSize = 720;
  cv::Mat image(kTop + kSize + 60, kLeft + kSize + 30, CV_8UC3, kWhite);
  put_text(image, ascii(score.method + ": attention, mean over heads, last layer", 70), {20, 34}, 0.65, kInk);
  put_text(image,
           ascii("row: the slice that looks; column: the slice it looks at; brightest: " +
                     fixed(mean.max().item<double>(), 3) + " (even: " + fixed(1. / static_cast<double>(n), 3) + ")",
                 90),
           {20, 62}, 0.48, kInk);
  const torch::Tensor bytes =
      (mean * (255. / mean.max().clamp_min(1e-12))).clamp(0., 255.).to(torch::kUInt8).contiguous();
  const cv::Mat grey(static_cast<int>(n), static_cast<int>(n), CV_8U, bytes.data_ptr());
  cv::Mat large, colour;
  cv::resize(grey, large, cv::Size(kSize, kSize), 0., 0., cv::INTER_NEAREST);
  cv::applyColorMap(large, colour, cv::COLORMAP_VIRIDIS);
  const auto at = [&](std::size_t slice) {
    return static_cast<int>(std::lround(static_cast<double>(slice) * kSize / static_cast<double>(n)));
  };
  for (std::size_t i = 0, begin = 0; i <= pictures.stacks.size(); ++i) {
    if (i < pictures.stacks.size() && pictures.stacks[i] == pictures.stacks[begin]) continue;
    const std::string name = "stack " + std::to_string(pictures.stacks[begin]);
    put_text(image, name, {kLeft + (at(begin) + at(i)) / 2, kTop - 10}, 0.5, kInk, Align::centre);
    put_text(image, name, {kLeft - 6, kTop + (at(begin) + at(i)) / 2}, 0.4, kInk, Align::right);
    if (i < pictures.stacks.size()) {
      cv::line(colour, {at(i), 0}, {at(i), kSize - 1}, kWhite, 1);
      cv::line(colour, {0, at(i)}, {kSize - 1, at(i)}, kWhite, 1);
    }
    begin = i;
  }
  colour.copyTo(image(cv::Rect(kLeft, kTop, kSize, kSize)));
  put_text(image, "slices in acquisition order", {kLeft + kSize / 2, kTop + kSize + 34}, 0.55, kInk, Align::centre);
  write_png(path, image);
}

}  // namespace

void plot_table(const std::filesystem::path& folder, const TablePlan& plan, const TableRows& rows,
                const std::vector<TableScore>& scores, const std::vector<TableSlice>& slices,
                const std::vector<TablePrefix>& prefixes) {
  constexpr double kBin = 5.;  // mm
  const std::vector<int> whole{plan.stacks};
  std::vector<int> any;
  for (int stacks = 1; stacks <= plan.stacks; ++stacks) any.push_back(stacks);
  const auto by_distance = [](const TableSlice& slice) { return (std::floor(slice.distance_mm / kBin) + 0.5) * kBin; };
  const auto by_stacks = [](const TableScore& score) { return static_cast<double>(score.stacks); };
  const auto by_seen = [](const TablePrefix& prefix) { return static_cast<double>(prefix.seen); };
  const char* const absolute = "ED / mm";
  const char* const relative = "relative ED / mm";

  const char* title = "Error by distance of the slice from the brain's centre";
  const char* axis = "distance from the centre, mm";
  plot_curves(folder / "error_by_distance.png", title, axis, absolute,
              curves_of(plan, rows, slices, whole, by_distance, [](const TableSlice& s) { return s.ed_mm; }));
  plot_curves(folder / "relative_error_by_distance.png", title, axis, relative,
              curves_of(plan, rows, slices, whole, by_distance, [](const TableSlice& s) { return s.relative_ed_mm; }));

  title = "Error by number of stacks";
  axis = "stacks";
  plot_curves(folder / "error_by_stacks.png", title, axis, absolute,
              curves_of(plan, rows, scores, any, by_stacks, [](const TableScore& s) { return s.own.ed_mm; }));
  plot_curves(folder / "relative_error_by_stacks.png", title, axis, relative,
              curves_of(plan, rows, scores, any, by_stacks, [](const TableScore& s) { return s.own.relative_ed_mm; }));

  title = "Error while the scan goes on, of the slices so far";
  axis = "slices seen";
  plot_curves(folder / "error_by_slices_seen.png", title, axis, absolute,
              curves_of(plan, rows, prefixes, whole, by_seen, [](const TablePrefix& p) { return p.ed_mm; }));
  plot_curves(folder / "relative_error_by_slices_seen.png", title, axis, relative,
              curves_of(plan, rows, prefixes, whole, by_seen, [](const TablePrefix& p) { return p.relative_ed_mm; }));
}

void plot_table_pictures(const std::filesystem::path& folder, const TableScore& score, const TablePictures& pictures) {
  if (!pictures.truth.defined()) return;  // no slice was kept
  const std::string name = file_name(score.method) + ".png";
  plot_volumes(folder / ("volumes_" + name), score, pictures);
  if (pictures.attention.defined()) plot_attention(folder / ("attention_" + name), score, pictures);
}

}  // namespace svort
