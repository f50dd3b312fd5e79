#include "svort_ros/io/decision_files.h"

#include <algorithm>
#include <cmath>
#include <nlohmann/json.hpp>
#include <sstream>
#include <stdexcept>

#include "csv_text.h"
#include "svort_ros/io/atomic_file.h"
#include "svort_ros/io/nifti.h"
#include "svort_ros/io/options_file.h"
#include "svort_ros/io/plots.h"

namespace svort {
namespace {

namespace fs = std::filesystem;
using Json = nlohmann::ordered_json;

constexpr double kDegreesPerRadian = 180. / M_PI;

std::string vector_fields(const Eigen::Vector3d& v) {
  std::string text;
  for (int axis = 0; axis < 3; ++axis) text += (axis ? "," : "") + number(v[axis] == 0. ? 0. : v[axis]);
  return text;
}

template <class Names>
std::string joined(const Names& names) {
  std::string text;
  for (const auto& name : names) text += (text.empty() ? "" : " ") + std::string(name);
  return text;
}

std::vector<std::string> names_of(const std::vector<QualityReason>& reasons) {
  std::vector<std::string> names;
  for (const QualityReason reason : reasons) names.emplace_back(to_string(reason));
  return names;
}

/// Finite numbers; what is not known is null.
Json known(double value) { return std::isfinite(value) ? Json(value) : Json(nullptr); }

Json pose_to_json(const Pose& pose) {
  Eigen::Quaterniond q(pose.linear());
  q.normalize();
  if (q.w() < 0.) q.coeffs() *= -1.;
  const auto& t = pose.translation();
  return {t.x(), t.y(), t.z(), q.x(), q.y(), q.z(), q.w()};
}

Json request_to_json(const ReacquisitionRequest& request) {
  return {
      {"id", request.id},       {"rank", request.rank},     {"again", request.again},
      {"stack", request.stack}, {"slice", request.index},   {"reasons", request.reasons},
      {"gain", request.gain},   {"cost_s", request.cost_s}, {"scanner_slice", pose_to_json(request.T_scanner_slice)}};
}

Json quality_to_json(const SliceQuality& quality) {
  Json features = Json::object();
  const auto values = quality.features.values();
  for (std::size_t i = 0; i < values.size(); ++i) features[QualityFeatures::names()[i]] = known(values[i]);
  return {{"stack", quality.stack},
          {"slice", quality.index},
          {"score", quality.score},
          {"reasons", names_of(quality.reasons)},
          {"features", features}};
}

int count_state(const ReacquisitionPlanner& planner, RequestState state) {
  return static_cast<int>(std::count_if(planner.requests().begin(), planner.requests().end(),
                                        [state](const auto& request) { return request.state == state; }));
}

void remove_if_there(const fs::path& path) {
  std::error_code error;
  fs::remove(path, error);
  if (error) throw std::runtime_error(path.string() + ": cannot remove the file of an earlier run: " + error.message());
}

}  // namespace

void write_motion_table(const fs::path& path, const std::string& scan_id, const MotionReport& motion) {
  std::ostringstream csv;
  csv << "scan_id,stack,slice,stamp,shift_x,shift_y,shift_z,rotation_x,rotation_y,rotation_z,displacement_mm,"
         "rotation_deg,error_mm,moved,framewise_mm,speed_mm_s,reference\n";
  for (std::size_t i = 0; i < motion.slices.size(); ++i) {
    const HeadMotion& slice = motion.slices[i];
    csv << field(scan_id) << ',' << slice.stack << ',' << slice.index << ',' << seconds(slice.stamp_ns) << ','
        << vector_fields(slice.shift_mm) << ',' << vector_fields(slice.rotation * kDegreesPerRadian) << ','
        << number(slice.displacement_mm) << ',' << number(slice.rotation.norm() * kDegreesPerRadian) << ','
        << number(slice.error_mm) << ',' << (slice.moved ? 1 : 0) << ',' << number(slice.framewise_mm) << ','
        << number(slice.speed_mm_s) << ',' << (i == motion.reference ? 1 : 0) << '\n';
  }
  write_file(path, csv.str());
}

void write_quality_table(const fs::path& path, const std::string& scan_id, const DecisionEngine& engine) {
  std::ostringstream csv;
  csv << "scan_id,stack,slice,stamp,score,image_score,first_score,accepted,reasons";
  for (const char* name : QualityFeatures::names()) csv << ',' << name;
  csv << '\n';
  for (const SliceQuality& slice : engine.quality()) {
    csv << field(scan_id) << ',' << slice.stack << ',' << slice.index << ',' << seconds(slice.stamp_ns) << ','
        << number(slice.score) << ',' << number(slice.image_score) << ',' << number(slice.first_score) << ','
        << (slice.score >= engine.options().quality.accept ? 1 : 0) << ',' << joined(names_of(slice.reasons));
    for (const double value : slice.features.values()) csv << ',' << number(value);
    csv << '\n';
  }
  write_file(path, csv.str());
}

void write_reacquisition_table(const fs::path& path, const std::string& scan_id,
                               const std::vector<PlannerEvent>& events) {
  std::ostringstream csv;
  csv << "scan_id,stamp,revision,event,id,rank,again,stack,slice,reasons,gain,cost_s,budget_left_s,tx,ty,tz,qx,qy,qz,"
         "qw,scanner_tx,scanner_ty,scanner_tz,scanner_qx,scanner_qy,scanner_qz,scanner_qw,detail\n";
  for (const PlannerEvent& event : events) {
    const ReacquisitionRequest& request = event.request;
    csv << field(scan_id) << ',' << seconds(event.stamp_ns) << ',' << event.revision << ',' << event.event << ','
        << request.id << ',' << request.rank << ',' << (request.again ? 1 : 0) << ',' << request.stack << ','
        << request.index << ',' << joined(request.reasons) << ',' << number(request.gain) << ','
        << number(request.cost_s) << ',' << number(event.budget_left_s) << ',' << pose_fields(request.T_brain_slice)
        << ',' << pose_fields(request.T_scanner_slice) << ',' << field(event.detail) << '\n';
  }
  write_file(path, csv.str());
}

void write_decision_log(const fs::path& path, const DecisionEngine& engine) {
  std::ostringstream log;
  for (const DecisionRecord& record : engine.records()) {
    Json requests = Json::array();
    for (const ReacquisitionRequest& request : record.waiting) requests.push_back(request_to_json(request));
    const Json json = {{"stamp", 1e-9 * static_cast<double>(record.stamp_ns)},
                       {"revision", record.revision},
                       {"frame_revision", record.frame_revision},
                       {"slices", record.slices},
                       {"newest", quality_to_json(record.newest)},
                       {"accepted", record.accepted},
                       {"motion",
                        {{"class", to_string(record.motion)},
                         {"window_displacement_mm", record.window_displacement_mm},
                         {"displacement_mm", record.head.displacement_mm},
                         {"error_mm", known(record.head.error_mm)},
                         {"speed_mm_s", record.head.speed_mm_s}}},
                       {"coverage",
                        {{"mean_score", record.coverage},
                         {"seen_well", record.seen_well},
                         {"complete", record.complete},
                         {"slices_left", record.completion.slices},
                         {"seconds_left", known(record.completion.seconds)},
                         {"yield", record.completion.yield}}},
                       {"budget_left_s", record.budget_left_s},
                       {"requests", requests},
                       {"options_version", record.options_version}};
    log << json.dump() << '\n';
  }
  write_file(path, log.str());
}

std::string motion_png(const MotionReport& motion) {
  Curve displacement{"displacement, mm", {}}, rotation{"rotation, deg", {}}, framewise{"framewise, mm", {}},
      error{"95 % error, mm", {}};
  for (const HeadMotion& slice : motion.slices) {
    const double t = 1e-9 * static_cast<double>(slice.stamp_ns - motion.slices.front().stamp_ns);
    if (!std::isfinite(slice.error_mm)) continue;  // an outlier's pose
    displacement.points.emplace_back(t, slice.displacement_mm);
    rotation.points.emplace_back(t, slice.rotation.norm() * kDegreesPerRadian);
    framewise.points.emplace_back(t, slice.framewise_mm);
    error.points.emplace_back(t, slice.error_mm);
  }
  return curves_png("Head motion since the reference slice (class: " + std::string(to_string(motion.motion)) + ")",
                    "time since the first slice, s", "mm or degrees", {displacement, rotation, framewise, error});
}

Json decisions_to_json(const DecisionEngine& engine) {
  const MotionReport& motion = engine.motion();
  const CoverageMap& coverage = engine.coverage();
  const ReacquisitionPlanner& planner = engine.planner();
  std::size_t accepted = 0;
  for (const SliceQuality& slice : engine.quality()) accepted += slice.score >= engine.options().quality.accept ? 1 : 0;
  Json gaps = Json::array();
  for (std::size_t i = 0; i < std::min<std::size_t>(coverage.gaps.size(), 10); ++i) {
    const CoverageGap& gap = coverage.gaps[i];
    gaps.push_back({{"width_mm", gap.width_mm},
                    {"volume_ml", gap.volume_ml},
                    {"centre_mm", {gap.centre.x(), gap.centre.y(), gap.centre.z()}}});
  }
  Json requests = Json::object();
  for (const RequestState state : {RequestState::proposed, RequestState::requested, RequestState::fulfilled,
                                   RequestState::vetoed, RequestState::withdrawn})
    requests[to_string(state)] = count_state(planner, state);
  Json json;
  json["motion"] = {{"class", to_string(motion.motion)},
                    {"window_displacement_mm", motion.window_displacement_mm},
                    {"head_radius_mm", motion.head_radius_mm}};
  json["quality"] = {{"accepted", accepted}, {"of", engine.quality().size()}};
  json["coverage"] = {{"brain_ml", coverage.brain_mm3 * 1e-3},
                      {"mean_score", coverage.mean_score},
                      {"seen_well", coverage.seen_well},
                      {"complete", coverage.complete},
                      {"orientations", coverage.mean_orientations},
                      {"slices_left", planner.completion().slices},
                      {"seconds_left", known(planner.completion().seconds)},
                      {"gaps", gaps}};
  json["reacquisition"] = {{"requests", requests}, {"budget_left_s", planner.budget_left_s()}};
  return json;
}

void write_decisions(const fs::path& directory, const std::string& scan_id, const DecisionEngine& engine) {
  const bool any = !engine.records().empty();
  const bool map = any && !engine.coverage().empty();
  const auto write_or_remove = [&](const char* name, bool wanted, const auto& write) {
    if (wanted)
      write(directory / name);
    else
      remove_if_there(directory / name);
  };
  write_or_remove("motion.csv", any, [&](const fs::path& path) { write_motion_table(path, scan_id, engine.motion()); });
  write_or_remove("quality.csv", any, [&](const fs::path& path) { write_quality_table(path, scan_id, engine); });
  write_or_remove("reacquisition.csv", any,
                  [&](const fs::path& path) { write_reacquisition_table(path, scan_id, engine.planner().events()); });
  write_or_remove("decisions.jsonl", any, [&](const fs::path& path) { write_decision_log(path, engine); });
  write_or_remove("motion.png", any, [&](const fs::path& path) { write_file(path, motion_png(engine.motion())); });
  write_or_remove("coverage.nii.gz", map,
                  [&](const fs::path& path) { write_nifti(path, engine.coverage().score_volume()); });
  write_or_remove("orientations.nii.gz", map,
                  [&](const fs::path& path) { write_nifti(path, engine.coverage().orientation_volume()); });
  write_or_remove("coverage.png", map, [&](const fs::path& path) {
    const CoverageMap& coverage = engine.coverage();
    plot_volume_views(path, coverage.score_volume(),
                      "Coverage: " + std::to_string(std::lround(100. * coverage.complete)) +
                          " % of the brain complete, white is seen well");
  });
}

void write_what_if(const fs::path& directory, const std::string& scan_id, const DecisionEngine& engine,
                   const DecisionEngine& what_if) {
  const fs::path folder = directory / "what_if";
  std::error_code error;
  fs::create_directories(folder, error);
  if (error) throw std::runtime_error(folder.string() + ": cannot make this folder: " + error.message());
  write_decisions(folder, scan_id, what_if);
  // Slices that one would have accepted and the other not.
  Json changed = Json::array();
  for (std::size_t i = 0; i < std::min(engine.quality().size(), what_if.quality().size()); ++i) {
    const SliceQuality& a = engine.quality()[i];
    const SliceQuality& b = what_if.quality()[i];
    const bool was = a.score >= engine.options().quality.accept, would_be = b.score >= what_if.options().quality.accept;
    if (was != would_be) changed.push_back({{"stack", a.stack}, {"slice", a.index}, {"accepted", would_be}});
  }
  const auto with_options = [](const DecisionEngine& each) {
    Json result = decisions_to_json(each);
    result["options"] = options_to_json(each.options());
    return result;
  };
  const Json json = {
      {"decided", with_options(engine)}, {"what_if", with_options(what_if)}, {"slices_judged_otherwise", changed}};
  write_file(folder / "what_if.json", json.dump(2) + "\n");
}

}  // namespace svort
