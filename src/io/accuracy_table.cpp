#include "svort_ros/io/accuracy_table.h"

#include <algorithm>
#include <cmath>
#include <limits>
#include <map>
#include <numeric>
#include <sstream>
#include <tuple>
#include <utility>

#include "accuracy_columns.h"
#include "svort_ros/io/plots.h"

namespace svort {
namespace {

/// Rows of one method in one motion class; NaN is left out.
class Group {
 public:
  void add(const AccuracyRow& row) { rows_.push_back(&row); }
  std::size_t size() const { return rows_.size(); }

  template <class Value>
  std::vector<double> values(const Value& value) const {
    std::vector<double> result;
    for (const AccuracyRow* row : rows_)
      if (std::isfinite(value(*row))) result.push_back(value(*row));
    std::sort(result.begin(), result.end());
    return result;
  }
  template <class Value>
  double mean(const Value& value) const {
    const std::vector<double> all = values(value);
    if (all.empty()) return std::numeric_limits<double>::quiet_NaN();
    return std::accumulate(all.begin(), all.end(), 0.) / static_cast<double>(all.size());
  }
  template <class Value>
  double median(const Value& value) const {
    const std::vector<double> all = values(value);
    if (all.empty()) return std::numeric_limits<double>::quiet_NaN();
    return 0.5 * (all[(all.size() - 1) / 2] + all[all.size() / 2]);
  }
  /// "mean / median"
  template <class Value>
  std::string cell(const Value& value, int decimals) const {
    if (values(value).empty()) return "-";
    return fixed(mean(value), decimals) + " / " + fixed(median(value), decimals);
  }
  template <class Value>
  std::size_t sum(const Value& value) const {
    std::size_t result = 0;
    for (const AccuracyRow* row : rows_) result += value(*row);
    return result;
  }
  /// "percent (of how many)"
  std::string warned(std::size_t AgreementScore::*all, std::size_t AgreementScore::*warned) const {
    const std::size_t slices = sum([&](const AccuracyRow& row) { return row.agreement.*all; });
    if (slices == 0) return "-";
    const std::size_t told = sum([&](const AccuracyRow& row) { return row.agreement.*warned; });
    return fixed(100. * static_cast<double>(told) / static_cast<double>(slices), 0) + " (" + std::to_string(slices) +
           ")";
  }
  /// "percent within (of how many; ratio)"
  std::string coverage(RadiusScore AccuracyRow::*radius) const {
    const std::size_t slices = sum([&](const AccuracyRow& row) { return (row.*radius).slices; });
    if (slices == 0) return "-";
    const std::size_t within = sum([&](const AccuracyRow& row) { return (row.*radius).within; });
    return fixed(100. * static_cast<double>(within) / static_cast<double>(slices), 1) + " (" + std::to_string(slices) +
           "; " + fixed(median([&](const AccuracyRow& row) { return (row.*radius).ratio_95; }), 2) + ")";
  }
  /// How many frames are turned by more than 45 degrees, and how many of those the match took for sure.
  std::string turned(FrameScore AccuracyRow::*frame) const {
    int known = 0, count = 0, sure = 0;
    for (const AccuracyRow* row : rows_) {
      const FrameScore& score = row->*frame;
      if (!std::isfinite(score.frame_rad)) continue;
      ++known;
      if (score.frame_rad < 0.25 * M_PI) continue;
      ++count;
      sure += score.sure ? 1 : 0;
    }
    if (known == 0) return "-";
    return std::to_string(count) + (count > 0 ? " (" + std::to_string(sure) + " sure)" : "");
  }

 private:
  std::vector<const AccuracyRow*> rows_;
};

}  // namespace

const std::vector<CsvColumn<AccuracyRow>>& accuracy_columns() {
  static const std::vector<CsvColumn<AccuracyRow>> all = [] {
    std::vector<CsvColumn<AccuracyRow>> list;
    const auto add = [&list](const char* name, auto access, bool key = false) {
      list.push_back(csv_column<AccuracyRow>(name, access, key));
    };
    add(
        "brain", [](AccuracyRow & r) -> auto& { return r.brain; }, true);
    add(
        "motion", [](AccuracyRow & r) -> auto& { return r.motion; }, true);
    add(
        "scan", [](AccuracyRow & r) -> auto& { return r.number; }, true);
    add(
        "masks", [](AccuracyRow & r) -> auto& { return r.masks; }, true);
    add(
        "stacks", [](AccuracyRow & r) -> auto& { return r.stacks; }, true);
    add(
        "method", [](AccuracyRow & r) -> auto& { return r.method; }, true);
    add(
        "slices", [](AccuracyRow & r) -> auto& { return r.slices; });
    add(
        "relative_ed_mm", [](AccuracyRow & r) -> auto& { return r.relative_ed_mm; });
    add(
        "relative_median_ed_mm", [](AccuracyRow & r) -> auto& { return r.relative_median_ed_mm; });
    add(
        "relative_gd_rad", [](AccuracyRow & r) -> auto& { return r.relative_gd_rad; });
    add(
        "atlas_ed_mm", [](AccuracyRow & r) -> auto& { return r.atlas.ed_mm; });
    add(
        "atlas_median_ed_mm", [](AccuracyRow & r) -> auto& { return r.atlas.median_ed_mm; });
    add(
        "atlas_gd_rad", [](AccuracyRow & r) -> auto& { return r.atlas.gd_rad; });
    add(
        "atlas_frame_rad", [](AccuracyRow & r) -> auto& { return r.atlas.frame_rad; });
    add(
        "atlas_sure", [](AccuracyRow & r) -> auto& { return r.atlas.sure; });
    add(
        "shipped_ed_mm", [](AccuracyRow & r) -> auto& { return r.shipped.ed_mm; });
    add(
        "shipped_median_ed_mm", [](AccuracyRow & r) -> auto& { return r.shipped.median_ed_mm; });
    add(
        "shipped_gd_rad", [](AccuracyRow & r) -> auto& { return r.shipped.gd_rad; });
    add(
        "shipped_frame_rad", [](AccuracyRow & r) -> auto& { return r.shipped.frame_rad; });
    add(
        "shipped_sure", [](AccuracyRow & r) -> auto& { return r.shipped.sure; });
    add(
        "guide_ed_mm", [](AccuracyRow & r) -> auto& { return r.guide.ed_mm; });
    add(
        "guide_median_ed_mm", [](AccuracyRow & r) -> auto& { return r.guide.median_ed_mm; });
    add(
        "guide_gd_rad", [](AccuracyRow & r) -> auto& { return r.guide.gd_rad; });
    add(
        "guide_frame_rad", [](AccuracyRow & r) -> auto& { return r.guide.frame_rad; });
    add(
        "guide_sure", [](AccuracyRow & r) -> auto& { return r.guide.sure; });
    add(
        "psf_psnr_db", [](AccuracyRow & r) -> auto& { return r.psf.psnr_db; });
    add(
        "psf_ssim", [](AccuracyRow & r) -> auto& { return r.psf.ssim; });
    add(
        "final_psnr_db", [](AccuracyRow & r) -> auto& { return r.final.psnr_db; });
    add(
        "final_ssim", [](AccuracyRow & r) -> auto& { return r.final.ssim; });
    add(
        "converged", [](AccuracyRow & r) -> auto& { return r.converged; });
    add(
        "seconds", [](AccuracyRow & r) -> auto& { return r.seconds; });
    add(
        "p95_ms", [](AccuracyRow & r) -> auto& { return r.p95_ms; });
    add(
        "radius_slices", [](AccuracyRow & r) -> auto& { return r.radius.slices; });
    add(
        "radius_within", [](AccuracyRow & r) -> auto& { return r.radius.within; });
    add(
        "radius_ratio_95", [](AccuracyRow & r) -> auto& { return r.radius.ratio_95; });
    add(
        "far_slices", [](AccuracyRow & r) -> auto& { return r.agreement.far; });
    add(
        "far_warned", [](AccuracyRow & r) -> auto& { return r.agreement.far_warned; });
    add(
        "near_slices", [](AccuracyRow & r) -> auto& { return r.agreement.near; });
    add(
        "near_warned", [](AccuracyRow & r) -> auto& { return r.agreement.near_warned; });
    add(
        "radius_slices_one_stack", [](AccuracyRow & r) -> auto& { return r.radius_one_stack.slices; });
    add(
        "radius_within_one_stack", [](AccuracyRow & r) -> auto& { return r.radius_one_stack.within; });
    add(
        "radius_ratio_95_one_stack", [](AccuracyRow & r) -> auto& { return r.radius_one_stack.ratio_95; });
    add(
        "network_starts", [](AccuracyRow & r) -> auto& { return r.network_starts; });
    add(
        "search_starts", [](AccuracyRow & r) -> auto& { return r.search_starts; });
    add(
        "followed_ed_mm", [](AccuracyRow & r) -> auto& { return r.followed_ed_mm; });
    return list;
  }();
  return all;
}

std::vector<AccuracyRow> read_accuracy_rows(const std::filesystem::path& path) {
  return read_csv_rows(path, accuracy_columns());
}

void write_accuracy_rows(const std::filesystem::path& path, const std::vector<AccuracyRow>& rows) {
  write_csv_rows(path, accuracy_columns(), rows);
}

std::string accuracy_markdown(const std::vector<AccuracyRow>& rows) {
  std::vector<std::string> motions, methods;
  std::map<std::pair<std::string, std::string>, Group> groups;
  for (const AccuracyRow& row : rows) {
    if (std::find(motions.begin(), motions.end(), row.motion) == motions.end()) motions.push_back(row.motion);
    if (std::find(methods.begin(), methods.end(), row.method) == methods.end()) methods.push_back(row.method);
    groups[{row.motion, row.method}].add(row);
  }
  const auto for_groups = [&](const auto& body) {
    for (const std::string& motion : motions)
      for (const std::string& method : methods)
        if (const auto found = groups.find({motion, method}); found != groups.end())
          body(motion, method, found->second);
  };
  std::ostringstream text;
  text << "| motion | poses | scans | relative ED, mm | relative GD, rad | ED, mm | GD, rad | turned | ED, shipped "
          "template, mm | turned | ED, network's frame, mm | GD, rad | turned | s "
          "|\n|---|---|---|---|---|---|---|---|---|---|---|---|---|---|\n";
  for_groups([&](const std::string& motion, const std::string& method, const Group& group) {
    text << "| " << motion << " | " << method << " | " << group.size() << " | "
         << group.cell([](const AccuracyRow& r) { return r.relative_ed_mm; }, 2) << " | "
         << group.cell([](const AccuracyRow& r) { return r.relative_gd_rad; }, 3) << " | "
         << group.cell([](const AccuracyRow& r) { return r.atlas.ed_mm; }, 2) << " | "
         << group.cell([](const AccuracyRow& r) { return r.atlas.gd_rad; }, 3) << " | "
         << group.turned(&AccuracyRow::atlas) << " | "
         << group.cell([](const AccuracyRow& r) { return r.shipped.ed_mm; }, 2) << " | "
         << group.turned(&AccuracyRow::shipped) << " | "
         << group.cell([](const AccuracyRow& r) { return r.guide.ed_mm; }, 2) << " | "
         << group.cell([](const AccuracyRow& r) { return r.guide.gd_rad; }, 3) << " | "
         << group.turned(&AccuracyRow::guide) << " | "
         << fixed(group.mean([](const AccuracyRow& r) { return r.seconds; }), 1) << " |\n";
  });
  text << "\nMean / median over scans of each scan's mean over slices. Relative: after the one rigid transform that "
          "fits "
          "best. Turned: scans whose canonical frame is off by more than 45 degrees.\n\n";
  text << "| motion | poses | PSNR, PSF, dB | PSNR, final, dB | SSIM, PSF | SSIM, final |\n|---|---|---|---|---|---|\n";
  for_groups([&](const std::string& motion, const std::string& method, const Group& group) {
    const auto psnr = [](const AccuracyRow& r) { return r.psf.psnr_db; };
    if (group.values(psnr).empty()) return;
    text << "| " << motion << " | " << method << " | " << fixed(group.mean(psnr), 2) << " | "
         << fixed(group.mean([](const AccuracyRow& r) { return r.final.psnr_db; }), 2) << " | "
         << fixed(group.mean([](const AccuracyRow& r) { return r.psf.ssim; }), 3) << " | "
         << fixed(group.mean([](const AccuracyRow& r) { return r.final.ssim; }), 3) << " |\n";
  });
  text << "\nMeans over scans; over the brain, at 0.8 mm, after the gain that fits best.\n";
  bool live = false;
  for_groups([&](const std::string& motion, const std::string& method, const Group& group) {
    const std::vector<double> p95 = group.values([](const AccuracyRow& r) { return r.p95_ms; });
    if (p95.empty()) return;
    if (!live)
      text << "\n| motion | poses | arrival to pose, 95 % below, ms (mean over scans) | worst scan, ms |\n"
              "|---|---|---|---|\n";
    live = true;
    text << "| " << motion << " | " << method << " | "
         << fixed(std::accumulate(p95.begin(), p95.end(), 0.) / static_cast<double>(p95.size()), 0) << " | "
         << fixed(p95.back(), 0) << " |\n";
  });
  if (live) text << "\nArrivals with 80 slices or more in the sequence.\n";
  bool radii = false;
  for_groups([&](const std::string& motion, const std::string& method, const Group& group) {
    const std::string more = group.coverage(&AccuracyRow::radius), one = group.coverage(&AccuracyRow::radius_one_stack);
    if (more == "-" && one == "-") return;
    if (!radii)
      text << "\n| motion | poses | within their 95 % radius | first stack | far off, warned of | near, warned of | "
              "from "
              "the network | searched for | relative ED when the last had arrived, mm "
              "|\n|---|---|---|---|---|---|---|---|---|\n";
    radii = true;
    text << "| " << motion << " | " << method << " | " << more << " | " << one << " | "
         << group.warned(&AgreementScore::far, &AgreementScore::far_warned) << " | "
         << group.warned(&AgreementScore::near, &AgreementScore::near_warned) << " | "
         << group.sum([](const AccuracyRow& r) { return r.network_starts; }) << " | "
         << group.sum([](const AccuracyRow& r) { return r.search_starts; }) << " | "
         << group.cell([](const AccuracyRow& r) { return r.followed_ed_mm; }, 2) << " |\n";
  });
  if (radii)
    text << "\nRegistered slices of all scans at their arrival, relative to the others: percent within the radius (of "
            "how many; 0.95 quantile of error over radius, median over scans), from the second stack on and in the "
            "first. "
            "Far off, near: slices that were off by more than 10 mm, less than 3 mm, once agreement was known; percent "
            "that low agreement warned of (of how many). From the network: slices that were registered from where the "
            "network had put them; searched for: those that a search had found elsewhere. When the last had arrived: "
            "all slices, the first stack's too, as they had been followed, before the end of the scan registers them "
            "anew.\n";
  return text.str();
}

void plot_accuracy(const std::filesystem::path& path, const std::vector<AccuracyRow>& rows) {
  std::map<std::tuple<std::string, std::string, std::uint64_t>, double> nominal;
  for (const AccuracyRow& row : rows)
    if (row.method == kNominalMethod) nominal[{row.brain, row.motion, row.number}] = row.relative_ed_mm;
  std::vector<Curve> curves;
  for (const AccuracyRow& row : rows) {
    const auto found = nominal.find({row.brain, row.motion, row.number});
    if (row.method == kNominalMethod || found == nominal.end()) continue;
    auto curve = std::find_if(curves.begin(), curves.end(), [&](const Curve& c) { return c.name == row.method; });
    if (curve == curves.end()) curve = curves.insert(curves.end(), {row.method, {}, true});
    curve->points.emplace_back(found->second, row.relative_ed_mm);
  }
  plot_curves(path, "Relative error of each simulated scan", "relative ED of the scanner's poses, mm",
              "relative ED, mm", curves);
}

}  // namespace svort
