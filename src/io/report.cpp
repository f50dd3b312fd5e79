#include "svort_ros/io/report.h"

#include <torch/version.h>

#include <algorithm>
#include <cmath>
#include <cstdio>
#include <fstream>
#include <functional>
#include <sstream>
#include <vector>

#include "svort_ros/io/atomic_file.h"

namespace svort {
namespace {

namespace fs = std::filesystem;

constexpr double kDegreesPerRadian = 180. / M_PI;
constexpr int kWidth = 1000;  // of charts, px
constexpr int kLeft = 60;     // of the axis within them

std::string fixed(double value, int decimals) {
  if (!std::isfinite(value)) return "&ndash;";
  char text[64];
  std::snprintf(text, sizeof text, "%.*f", decimals, value);
  return text;
}

std::string percent(double share) { return fixed(100. * share, 0) + " %"; }

/// Time of a slice since the first one, s.
double seconds_of(std::int64_t stamp_ns, std::int64_t first_ns) {
  return 1e-9 * static_cast<double>(stamp_ns - first_ns);
}

/// A chart over the scan's time.
class TimeChart {
 public:
  TimeChart(double end_s, double top, int height)
      : end_s_(std::max(end_s, 1.)), top_(top > 0. ? top : 1.), height_(height) {}

  double x(double t) const { return kLeft + t / end_s_ * (kWidth - kLeft - 10); }
  double y(double value) const { return height_ - 25 - std::clamp(value / top_, 0., 1.) * (height_ - 40); }

  void line(const std::vector<std::pair<double, double>>& points, const char* colour, const char* style = "") {
    svg_ << "<polyline fill='none' stroke='" << colour << "' stroke-width='1.6' " << style << " points='";
    for (const auto& [t, value] : points) svg_ << fixed(x(t), 1) << ',' << fixed(y(value), 1) << ' ';
    svg_ << "'/>\n";
  }
  void bar(double t, double width_s, double value, const std::string& colour, const std::string& title) {
    const double left = x(t), right = std::max(x(std::min(t + width_s, end_s_)), left + 2.);
    svg_ << "<rect x='" << fixed(left, 1) << "' y='" << fixed(y(value), 1) << "' width='"
         << fixed(right - left - 0.5, 1) << "' height='" << fixed(y(0.) - y(value), 1) << "' fill='" << colour
         << "'><title>" << escape_html(title) << "</title></rect>\n";
  }
  void mark(double t, const std::string& label) {
    svg_ << "<line x1='" << fixed(x(t), 1) << "' x2='" << fixed(x(t), 1) << "' y1='12' y2='" << height_ - 25
         << "' stroke='#bbb'/><text x='" << fixed(x(t) + 3, 1) << "' y='12' class='t'>" << escape_html(label)
         << "</text>\n";
  }
  void level(double value, const char* colour, const std::string& label) {
    svg_ << "<line x1='" << kLeft << "' x2='" << kWidth - 10 << "' y1='" << fixed(y(value), 1) << "' y2='"
         << fixed(y(value), 1) << "' stroke='" << colour << "' stroke-dasharray='4 3'/><text x='" << kWidth - 12
         << "' y='" << fixed(y(value) - 3, 1) << "' text-anchor='end' class='t'>" << escape_html(label) << "</text>\n";
  }
  std::string html(const std::string& unit) const {
    std::ostringstream out;
    out << "<svg viewBox='0 0 " << kWidth << ' ' << height_ << "' width='" << kWidth << "' height='" << height_
        << "' role='img'>\n";
    for (int i = 0; i <= 4; ++i) {
      const double value = top_ * i / 4.;
      out << "<line x1='" << kLeft << "' x2='" << kWidth - 10 << "' y1='" << fixed(y(value), 1) << "' y2='"
          << fixed(y(value), 1) << "' stroke='#eee'/><text x='" << kLeft - 6 << "' y='" << fixed(y(value) + 4, 1)
          << "' text-anchor='end' class='t'>" << fixed(value, top_ < 4. ? 2 : 0) << "</text>\n";
    }
    for (int i = 0; i <= 5; ++i)
      out << "<text x='" << fixed(x(end_s_ * i / 5.), 1) << "' y='" << height_ - 8
          << "' text-anchor='middle' class='t'>" << fixed(end_s_ * i / 5., 0) << " s</text>\n";
    out << "<text x='4' y='" << height_ / 2 << "' class='t'>" << unit << "</text>\n" << svg_.str() << "</svg>\n";
    return out.str();
  }

 private:
  double end_s_, top_;
  int height_;
  std::ostringstream svg_;
};

/// Red (0) over yellow to green (1), by lightness too, for readers who do not tell red from green.
std::string quality_colour(double score) {
  const double t = std::clamp(score, 0., 1.);
  return "hsl(" + fixed(120. * t, 0) + ",65%," + fixed(38. + 12. * t, 0) + "%)";
}

std::string picture(const fs::path& path, const std::string& what) {
  std::ifstream file(path, std::ios::binary);
  if (!file) return "<p class='note'>No picture of " + what + ": there was nothing to draw.</p>\n";
  std::ostringstream bytes;
  bytes << file.rdbuf();
  return "<img alt='" + what + "' src='data:image/png;base64," + base64(bytes.str()) + "'/>\n";
}

std::string row(const std::vector<std::string>& cells, const char* tag = "td") {
  std::string text = "<tr>";
  for (const std::string& cell : cells) text += std::string("<") + tag + ">" + cell + "</" + tag + ">";
  return text + "</tr>\n";
}

void stack_marks(const std::vector<HeadMotion>& slices, TimeChart* chart) {
  int stack = -1;
  for (const HeadMotion& slice : slices) {
    if (slice.stack == stack) continue;
    stack = slice.stack;
    chart->mark(seconds_of(slice.stamp_ns, slices.front().stamp_ns), "stack " + std::to_string(stack));
  }
}

std::string motion_section(const MotionReport& motion) {
  std::ostringstream out;
  out << "<h2>Head motion</h2>\n";
  if (motion.slices.empty()) return out.str() + "<p class='note'>No slice was kept.</p>\n";
  const std::int64_t first = motion.slices.front().stamp_ns;
  std::vector<std::pair<double, double>> displacement, error, rotation;
  double top = 4., top_deg = 4.;
  for (const HeadMotion& slice : motion.slices) {
    if (!std::isfinite(slice.error_mm)) continue;
    const double t = seconds_of(slice.stamp_ns, first);
    displacement.emplace_back(t, slice.displacement_mm);
    error.emplace_back(t, slice.error_mm);
    rotation.emplace_back(t, slice.rotation.norm() * kDegreesPerRadian);
    top = std::max(top, 1.1 * slice.displacement_mm);
    top_deg = std::max(top_deg, 1.1 * rotation.back().second);
  }
  const double end = seconds_of(motion.slices.back().stamp_ns, first);
  out << "<p>Class <b>" << to_string(motion.motion) << "</b>: " << fixed(motion.window_displacement_mm, 1)
      << " mm mean displacement over the last window. Measured on a sphere of " << fixed(motion.head_radius_mm, 0)
      << " mm, since stack " << motion.slices[motion.reference].stack << " slice "
      << motion.slices[motion.reference].index
      << ". What lies below the dashed line is within its 95&nbsp;% error.</p>\n";
  TimeChart chart(end, top, 220);
  stack_marks(motion.slices, &chart);
  chart.line(error, "#999", "stroke-dasharray='4 3'");
  chart.line(displacement, "#0072b2");
  out << "<h3>Displacement</h3>" << chart.html("mm");
  TimeChart angles(end, top_deg, 160);
  stack_marks(motion.slices, &angles);
  angles.line(rotation, "#d55e00");
  out << "<h3>Rotation</h3>" << angles.html("deg");
  return out.str();
}

std::string quality_section(const DecisionEngine& engine) {
  std::ostringstream out;
  out << "<h2>Slice quality</h2>\n";
  const auto& slices = engine.quality();
  if (slices.empty()) return out.str() + "<p class='note'>No slice was kept.</p>\n";
  const double accept = engine.options().quality.accept;
  const std::int64_t first = slices.front().stamp_ns;
  const double end = seconds_of(slices.back().stamp_ns, first);
  TimeChart chart(end * (1. + 1. / static_cast<double>(slices.size())), 1., 150);
  stack_marks(engine.motion().slices, &chart);
  std::size_t bad = 0;
  for (std::size_t i = 0; i < slices.size(); ++i) {
    const SliceQuality& slice = slices[i];
    bad += slice.score < accept ? 1 : 0;
    std::string title =
        "stack " + std::to_string(slice.stack) + " slice " + std::to_string(slice.index) + ": " + fixed(slice.score, 2);
    for (const QualityReason reason : slice.reasons) title += std::string(" ") + to_string(reason);
    const double t = seconds_of(slice.stamp_ns, first);
    const double next = i + 1 < slices.size() ? seconds_of(slices[i + 1].stamp_ns, first)
                                              : 2. * t - (i > 0 ? seconds_of(slices[i - 1].stamp_ns, first) : t);
    chart.bar(t, std::max(0., next - t), std::max(slice.score, 0.02), quality_colour(slice.score), title);
  }
  chart.level(accept, "#333", "accept");
  out << "<p>" << bad << " of " << slices.size() << " slices are below " << fixed(accept, 2)
      << " and should be acquired again.</p>\n"
      << chart.html("score");
  if (bad == 0) return out.str();
  out << "<table>" << row({"stack", "slice", "score", "from the image alone", "reasons"}, "th");
  for (const SliceQuality& slice : slices) {
    if (slice.score >= accept) continue;
    std::string reasons;
    for (const QualityReason reason : slice.reasons)
      reasons += std::string(reasons.empty() ? "" : ", ") + to_string(reason);
    out << row({std::to_string(slice.stack), std::to_string(slice.index), fixed(slice.score, 2),
                fixed(slice.image_score, 2), reasons.empty() ? "&ndash;" : reasons});
  }
  out << "</table>\n";
  return out.str();
}

std::string coverage_section(const fs::path& directory, const DecisionEngine& engine) {
  std::ostringstream out;
  const CoverageMap& map = engine.coverage();
  const Completion& completion = engine.planner().completion();
  out << "<h2>Coverage</h2>\n<p><b>" << percent(map.complete) << "</b> of the brain (" << fixed(map.brain_mm3 * 1e-3, 0)
      << " ml) is seen well; " << fixed(map.mean_orientations, 1) << " orientations on average. ";
  if (completion.slices == 0)
    out << "Complete.";
  else if (std::isfinite(completion.seconds))
    out << "To complete at the present motion: " << completion.slices << " slices, about "
        << fixed(completion.seconds, 0) << " s.";
  else
    out << "Not to be completed at the present motion.";
  out << "</p>\n" << picture(directory / "coverage.png", "coverage");
  if (!map.gaps.empty()) {
    out << "<table>" << row({"gap, ml", "width, mm", "centre in the brain frame, mm"}, "th");
    for (std::size_t i = 0; i < std::min<std::size_t>(map.gaps.size(), 8); ++i) {
      const CoverageGap& gap = map.gaps[i];
      out << row({fixed(gap.volume_ml, 1), fixed(gap.width_mm, 0),
                  fixed(gap.centre.x(), 0) + ", " + fixed(gap.centre.y(), 0) + ", " + fixed(gap.centre.z(), 0)});
    }
    out << "</table>\n";
  }
  return out.str();
}

std::string decision_section(const DecisionEngine& engine, std::int64_t first_ns) {
  std::ostringstream out;
  const ReacquisitionPlanner& planner = engine.planner();
  out << "<h2>Requests</h2>\n<p>"
      << (engine.options().reacquisition.dry_run ? "Dry run: nobody was asked to obey. " : "")
      << planner.requests().size() << " requests; " << fixed(planner.budget_left_s(), 0) << " s of "
      << fixed(engine.options().reacquisition.budget_s, 0) << " s are left.</p>\n";
  if (planner.events().empty()) return out.str();
  out << "<table>"
      << row({"time, s", "event", "request", "stack", "slice", "reasons", "gain, %", "cost, s", "detail"}, "th");
  for (const PlannerEvent& event : planner.events()) {
    const ReacquisitionRequest& request = event.request;
    std::string reasons;
    for (const std::string& reason : request.reasons) reasons += (reasons.empty() ? "" : ", ") + escape_html(reason);
    out << row({fixed(seconds_of(event.stamp_ns, first_ns), 1), escape_html(event.event),
                request.id > 0 ? std::to_string(request.id) : "&ndash;", std::to_string(request.stack),
                std::to_string(request.index), reasons.empty() ? "&ndash;" : reasons, fixed(100. * request.gain, 2),
                fixed(request.cost_s, 1), escape_html(event.detail)});
  }
  out << "</table>\n";
  return out.str();
}

std::string timing_section(const LivePipeline& pipeline, const RunInfo& run) {
  std::vector<double> pose, volume, decision;
  for (const JournalEntry& entry : pipeline.journal().entries()) {
    if (!is_kept(entry.status)) continue;
    pose.push_back(entry.latency_ms);
    volume.push_back(entry.volume_latency_ms);
    decision.push_back(entry.decision_latency_ms);
  }
  std::ostringstream out;
  out << "<h2>Timings</h2>\n<table>" << row({"from arrival, ms", "median", "95 %", "largest"}, "th");
  for (const auto& [name, values] : {std::pair{"pose", pose}, {"volume", volume}, {"decision", decision}}) {
    const Percentiles p = percentiles(values);
    out << row({name, fixed(p.median, 1), fixed(p.p95, 1), fixed(p.max, 1)});
  }
  out << "</table>\n<p>" << pipeline.sequence().slices().size() << " slices kept of "
      << pipeline.journal().entries().size() << " that arrived; " << run.threads << " threads, device "
      << escape_html(pipeline.device()) << ", " << fixed(run.wall_s, 1) << " s in all.</p>\n";
  return out.str();
}

constexpr const char* kStyle =
    "body{font:15px/1.45 sans-serif;color:#222;max-width:1040px;margin:24px auto;padding:0 16px}"
    "h1{font-size:24px}h2{font-size:19px;border-bottom:1px solid #ccc;margin-top:30px}h3{font-size:15px;margin:8px 0 0}"
    "table{border-collapse:collapse;font-size:13px}th,td{border:1px solid #ddd;padding:3px 8px;text-align:left}"
    "th{background:#f3f3f3}.t{font:11px sans-serif;fill:#555}.note{color:#777}img,svg{max-width:100%;height:auto}"
    ".warn{background:#fff4d6;padding:8px 12px;border-left:4px solid #e69f00}";

}  // namespace

std::string escape_html(const std::string& text) {
  std::string result;
  for (std::size_t i = 0; i < text.size(); ++i) {
    const auto c = static_cast<unsigned char>(text[i]);
    if (c == '&') {
      result += "&amp;";
    } else if (c == '<') {
      result += "&lt;";
    } else if (c == '>') {
      result += "&gt;";
    } else if (c == '"') {
      result += "&quot;";
    } else if (c == '\'') {
      result += "&#39;";
    } else if (c >= 0x20 && c < 0x7F) {
      result += text[i];
    } else {
      // A whole UTF-8 sequence stays as it is.
      const std::size_t length = c >= 0xF0 && c < 0xF5 ? 4 : c >= 0xE0 && c < 0xF0 ? 3 : c >= 0xC2 && c < 0xE0 ? 2 : 0;
      bool whole = length > 0 && i + length <= text.size();
      for (std::size_t k = 1; whole && k < length; ++k)
        whole = (static_cast<unsigned char>(text[i + k]) & 0xC0U) == 0x80U;
      if (whole) {
        result += text.substr(i, length);
        i += length - 1;
      } else {
        result += '?';
      }
    }
  }
  return result;
}

std::string base64(const std::string& bytes) {
  static constexpr char kLetters[] = "ABCDEFGHIJKLMNOPQRSTUVWXYZabcdefghijklmnopqrstuvwxyz0123456789+/";
  std::string text;
  text.reserve((bytes.size() + 2) / 3 * 4);
  for (std::size_t i = 0; i < bytes.size(); i += 3) {
    const auto byte = [&](std::size_t k) {
      return i + k < bytes.size() ? static_cast<std::uint32_t>(static_cast<unsigned char>(bytes[i + k])) : 0U;
    };
    const std::uint32_t group = byte(0) << 16U | byte(1) << 8U | byte(2);
    text += kLetters[group >> 18U];
    text += kLetters[group >> 12U & 63U];
    text += i + 1 < bytes.size() ? kLetters[group >> 6U & 63U] : '=';
    text += i + 2 < bytes.size() ? kLetters[group & 63U] : '=';
  }
  return text;
}

void write_report(const fs::path& directory, const LivePipeline& pipeline, const RunInfo& run,
                  const DecisionEngine& engine) {
  std::ostringstream html;
  const std::string scan = escape_html(pipeline.sequence().scan_id());
  const auto& slices = pipeline.estimate().slices;
  const std::int64_t first = slices.empty() ? 0 : slices.front().info.stamp_ns;
  html << "<!DOCTYPE html>\n<html lang='en'><head><meta charset='utf-8'><title>Scan " << scan << "</title><style>"
       << kStyle << "</style></head><body>\n<h1>Scan " << scan << "</h1>\n<p>" << slices.size()
       << " slices, poses by <b>" << escape_html(pipeline.options().estimator.method) << "</b>, "
       << (pipeline.estimate().final ? "final" : "not finalised") << "; " << percent(engine.coverage().complete)
       << " of the brain complete, head motion " << to_string(engine.motion().motion) << ".</p>\n"
       << "<p class='warn'>Not a medical device; do not base decisions about patients on it.</p>\n";
  for (const std::string& warning : pipeline.notes().warnings)
    html << "<p class='warn'>" << escape_html(warning) << "</p>\n";
  if (const double agreement = pipeline.estimate().agreement; agreement < kAgreement)
    html << "<p class='warn'>The slices do not agree with each other (" << fixed(agreement, 2) << ", should be "
         << fixed(kAgreement, 2) << "): poses may be far off.</p>\n";
  html << motion_section(engine.motion()) << quality_section(engine) << coverage_section(directory, engine)
       << "<h2>Volume</h2>\n"
       << picture(directory / "volume.png", "the volume") << decision_section(engine, first)
       << timing_section(pipeline, run) << "<h2>Versions</h2>\n<p>svort_ros " << SVORT_VERSION << ", LibTorch "
       << TORCH_VERSION << ", " << escape_html(run.program)
       << "; run.json holds all options and thresholds.</p>\n</body></html>\n";
  write_file(directory / "report.html", html.str());
}

}  // namespace svort
