#include "svort_ros/io/accuracy_table.h"

#include <algorithm>
#include <array>
#include <charconv>
#include <cmath>
#include <cstdio>
#include <fstream>
#include <functional>
#include <limits>
#include <map>
#include <numeric>
#include <sstream>
#include <stdexcept>
#include <tuple>
#include <type_traits>
#include <utility>

#include "svort_ros/io/atomic_file.h"
#include "svort_ros/io/plots.h"

namespace svort {
namespace {

struct Column {
  const char* name;
  std::function<std::string(const AccuracyRow&)> text;
  std::function<void(AccuracyRow&, const std::string&)> set;
};

std::string text_of(double value) {
  std::array<char, 32> buffer{};
  const auto end = std::to_chars(buffer.data(), buffer.data() + buffer.size(), value, std::chars_format::general, 9);
  return std::string(buffer.data(), end.ptr);
}

template <class Number>
Number number_of(const std::string& text) {
  if constexpr (std::is_floating_point_v<Number>) {
    if (text == "nan" || text == "-nan") return std::numeric_limits<Number>::quiet_NaN();
  }
  Number value{};
  const auto [end, error] = std::from_chars(text.data(), text.data() + text.size(), value);
  if (error != std::errc() || end != text.data() + text.size())
    throw std::invalid_argument("'" + text + "' is not a number");
  return value;
}

template <class Member>
Column word(const char* name, Member member) {
  return {name, [member](const AccuracyRow& row) { return row.*member; },
          [member](AccuracyRow& row, const std::string& text) { row.*member = text; }};
}

/// @param member reference to the number of a row: AccuracyRow& -> Number&
template <class Access>
Column number(const char* name, Access access) {
  return {name,
          [access](const AccuracyRow& row) {
            AccuracyRow copy = row;
            if constexpr (std::is_floating_point_v<std::decay_t<decltype(access(copy))>>)
              return text_of(access(copy));
            else
              return std::to_string(access(copy));
          },
          [access](AccuracyRow& row, const std::string& text) {
            auto& value = access(row);
            using Number = std::decay_t<decltype(value)>;
            if constexpr (std::is_same_v<Number, bool>)
              value = number_of<int>(text) != 0;
            else
              value = number_of<Number>(text);
          }};
}

const std::vector<Column>& columns() {
  static const std::vector<Column> all = [] {
    std::vector<Column> list;
    list.push_back(word("brain", &AccuracyRow::brain));
    list.push_back(word("motion", &AccuracyRow::motion));
    list.push_back(number(
        "scan", [](AccuracyRow & r) -> auto& { return r.number; }));
    list.push_back(word("masks", &AccuracyRow::masks));
    list.push_back(number(
        "stacks", [](AccuracyRow & r) -> auto& { return r.stacks; }));
    list.push_back(word("method", &AccuracyRow::method));
    list.push_back(number(
        "slices", [](AccuracyRow & r) -> auto& { return r.slices; }));
    list.push_back(number(
        "relative_ed_mm", [](AccuracyRow & r) -> auto& { return r.relative_ed_mm; }));
    list.push_back(number(
        "relative_median_ed_mm", [](AccuracyRow & r) -> auto& { return r.relative_median_ed_mm; }));
    list.push_back(number(
        "relative_gd_rad", [](AccuracyRow & r) -> auto& { return r.relative_gd_rad; }));
    list.push_back(number(
        "atlas_ed_mm", [](AccuracyRow & r) -> auto& { return r.atlas.ed_mm; }));
    list.push_back(number(
        "atlas_median_ed_mm", [](AccuracyRow & r) -> auto& { return r.atlas.median_ed_mm; }));
    list.push_back(number(
        "atlas_gd_rad", [](AccuracyRow & r) -> auto& { return r.atlas.gd_rad; }));
    list.push_back(number(
        "atlas_frame_rad", [](AccuracyRow & r) -> auto& { return r.atlas.frame_rad; }));
    list.push_back(number(
        "atlas_sure", [](AccuracyRow & r) -> auto& { return r.atlas.sure; }));
    list.push_back(number(
        "shipped_ed_mm", [](AccuracyRow & r) -> auto& { return r.shipped.ed_mm; }));
    list.push_back(number(
        "shipped_median_ed_mm", [](AccuracyRow & r) -> auto& { return r.shipped.median_ed_mm; }));
    list.push_back(number(
        "shipped_gd_rad", [](AccuracyRow & r) -> auto& { return r.shipped.gd_rad; }));
    list.push_back(number(
        "shipped_frame_rad", [](AccuracyRow & r) -> auto& { return r.shipped.frame_rad; }));
    list.push_back(number(
        "shipped_sure", [](AccuracyRow & r) -> auto& { return r.shipped.sure; }));
    list.push_back(number(
        "psf_psnr_db", [](AccuracyRow & r) -> auto& { return r.psf.psnr_db; }));
    list.push_back(number(
        "psf_ssim", [](AccuracyRow & r) -> auto& { return r.psf.ssim; }));
    list.push_back(number(
        "final_psnr_db", [](AccuracyRow & r) -> auto& { return r.final.psnr_db; }));
    list.push_back(number(
        "final_ssim", [](AccuracyRow & r) -> auto& { return r.final.ssim; }));
    list.push_back(number(
        "converged", [](AccuracyRow & r) -> auto& { return r.converged; }));
    list.push_back(number(
        "seconds", [](AccuracyRow & r) -> auto& { return r.seconds; }));
    list.push_back(number(
        "p95_ms", [](AccuracyRow & r) -> auto& { return r.p95_ms; }));
    return list;
  }();
  return all;
}

std::string fixed(double value, int decimals) {
  if (!std::isfinite(value)) return "-";
  std::array<char, 64> buffer{};
  const auto end =
      std::to_chars(buffer.data(), buffer.data() + buffer.size(), value, std::chars_format::fixed, decimals);
  return std::string(buffer.data(), end.ptr);
}

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

std::vector<AccuracyRow> read_accuracy_rows(const std::filesystem::path& path) {
  std::vector<AccuracyRow> rows;
  std::ifstream file(path);
  if (!file) return rows;
  std::string line;
  for (int number = 1; std::getline(file, line); ++number) {
    if (number == 1) continue;
    std::vector<std::string> fields;
    std::stringstream text(line);
    for (std::string field; std::getline(text, field, ',');) fields.push_back(field);
    const std::string where = path.string() + ": line " + std::to_string(number) + ": ";
    if (fields.size() != columns().size())
      throw std::runtime_error(where + std::to_string(fields.size()) + " fields, there must be " +
                               std::to_string(columns().size()) + "; measure into another folder");
    AccuracyRow row;
    for (std::size_t i = 0; i < fields.size(); ++i) {
      try {
        columns()[i].set(row, fields[i]);
      } catch (const std::invalid_argument& error) {
        throw std::runtime_error(where + columns()[i].name + ": " + error.what());
      }
    }
    rows.push_back(row);
  }
  return rows;
}

void write_accuracy_rows(const std::filesystem::path& path, const std::vector<AccuracyRow>& rows) {
  std::string csv;
  for (const Column& column : columns()) csv += std::string(csv.empty() ? "" : ",") + column.name;
  csv += '\n';
  for (const AccuracyRow& row : rows) {
    std::string line;
    for (const Column& column : columns()) line += (&column == &columns().front() ? "" : ",") + column.text(row);
    csv += line + '\n';
  }
  write_file(path, csv);
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
          "template, mm | turned | s |\n|---|---|---|---|---|---|---|---|---|---|---|\n";
  for_groups([&](const std::string& motion, const std::string& method, const Group& group) {
    text << "| " << motion << " | " << method << " | " << group.size() << " | "
         << group.cell([](const AccuracyRow& r) { return r.relative_ed_mm; }, 2) << " | "
         << group.cell([](const AccuracyRow& r) { return r.relative_gd_rad; }, 3) << " | "
         << group.cell([](const AccuracyRow& r) { return r.atlas.ed_mm; }, 2) << " | "
         << group.cell([](const AccuracyRow& r) { return r.atlas.gd_rad; }, 3) << " | "
         << group.turned(&AccuracyRow::atlas) << " | "
         << group.cell([](const AccuracyRow& r) { return r.shipped.ed_mm; }, 2) << " | "
         << group.turned(&AccuracyRow::shipped) << " | "
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
