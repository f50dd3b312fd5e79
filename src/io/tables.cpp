#include "svort_ros/io/tables.h"

#include <array>
#include <charconv>
#include <cmath>
#include <cstdio>
#include <fstream>
#include <limits>
#include <map>
#include <sstream>
#include <stdexcept>
#include <string_view>
#include <utility>

#include "csv_text.h"
#include "svort_ros/io/atomic_file.h"

namespace svort {
namespace {

constexpr std::array<const char*, 25> kPoseColumns = {
    "scan_id", "stack", "slice",   "stamp",        "tx",        "ty",      "tz",      "qx",      "qy",
    "qz",      "qw",    "head_tx", "head_ty",      "head_tz",   "head_qx", "head_qy", "head_qz", "head_qw",
    "weight",  "ncc",   "status",  "radius_95_mm", "displaced", "void",    "noisy"};
constexpr std::size_t kRequiredPoseColumns = 11;  // up to qw
constexpr std::size_t kEstimateColumns = 22;      // the others are flags of truth.csv

constexpr const char* kUpdateHeader =
    "stamp,stack,slice,sequence_length,revision,latency_ms,encoded,device,tx,ty,tz,qx,qy,qz,qw,status,reason,"
    "volume_latency_ms,decision_latency_ms,start,radius_95_mm";

/// One line of the table, with its fields by the name of their column.
class RowReader {
 public:
  RowReader(const std::filesystem::path& path, const std::map<std::string, std::size_t>& columns, const Record& record)
      : path_(path), columns_(columns), record_(record) {}

  bool has(const std::string& column) const { return columns_.count(column) > 0; }
  const std::string& text(const std::string& column) const { return record_.fields[columns_.at(column)]; }

  template <class T>
  T value(const std::string& column) const {
    const std::string& field = text(column);
    T result{};
    const auto [end, error] = std::from_chars(field.data(), field.data() + field.size(), result);
    if (error != std::errc() || end != field.data() + field.size())
      fail(path_, record_.line, "column '" + column + "': '" + field + "' is not a number of the kind wanted");
    return result;
  }

  bool flag(const std::string& column) const {
    const std::string& field = text(column);
    if (field != "0" && field != "1")
      fail(path_, record_.line, "column '" + column + "': '" + field + "' is not 0 or 1");
    return field == "1";
  }

  /// "12.000000001" as ns, without the rounding of a double.
  std::int64_t nanoseconds(const std::string& column) const {
    const std::string& field = text(column);
    const std::size_t point = field.find('.');
    std::string digits = field.substr(0, point);
    std::string fraction = point == std::string::npos ? "" : field.substr(point + 1);
    const bool negative = !digits.empty() && digits.front() == '-';
    if (negative) digits.erase(0, 1);
    const bool plain = !digits.empty() && digits.size() <= 9 + 1 && fraction.size() <= 9 &&
                       (digits + fraction).find_first_not_of("0123456789") == std::string::npos;
    if (!plain)
      fail(path_, record_.line,
           "column '" + column + "': '" + field + "' is not a time in seconds with at most nine decimals");
    fraction.append(9 - fraction.size(), '0');
    std::int64_t result = 0;
    for (const char c : digits + fraction) {
      // Ten digits of seconds times 1e9 may pass the range; SliceInfo could not hold such a time either.
      if (result > (std::numeric_limits<std::int64_t>::max() - 9) / 10)
        fail(path_, record_.line, "column '" + column + "': '" + field + "' s is too large");
      result = 10 * result + (c - '0');
    }
    return negative ? -result : result;
  }

  Pose pose(const std::string& prefix) const {
    const auto finite = [&](const char* name) {
      const double result = value<double>(prefix + name);
      if (!std::isfinite(result)) fail(path_, record_.line, "column '" + prefix + name + "' is not finite");
      return result;
    };
    Pose pose = Pose::Identity();
    pose.translation() << finite("tx"), finite("ty"), finite("tz");
    Eigen::Quaterniond q;
    q.x() = finite("qx");
    q.y() = finite("qy");
    q.z() = finite("qz");
    q.w() = finite("qw");
    if (std::abs(q.norm() - 1.) > 1e-3)
      fail(path_, record_.line,
           "columns '" + prefix + "qx' to '" + prefix + "qw': length " + number(q.norm()) + ", must be 1 within 1e-3");
    pose.linear() = q.normalized().toRotationMatrix();
    return pose;
  }

 private:
  const std::filesystem::path& path_;
  const std::map<std::string, std::size_t>& columns_;
  const Record& record_;
};

std::map<std::string, std::size_t> read_header(const std::filesystem::path& path, const Record& record) {
  std::map<std::string, std::size_t> columns;
  for (std::size_t i = 0; i < record.fields.size(); ++i) {
    const std::string& name = record.fields[i];
    bool known = false;
    for (const char* column : kPoseColumns) known = known || name == column;
    if (!known) fail(path, record.line, "unknown column '" + name + "'");
    if (!columns.emplace(name, i).second) fail(path, record.line, "column '" + name + "' is there twice");
  }
  for (std::size_t i = 0; i < kRequiredPoseColumns; ++i)
    if (!columns.count(kPoseColumns[i]))
      fail(path, record.line, std::string("column '") + kPoseColumns[i] + "' is missing");
  for (const char* name : {"tx", "ty", "tz", "qx", "qy", "qz", "qw"})
    if (columns.count("head_tx") != columns.count(std::string("head_") + name))
      fail(path, record.line, "columns 'head_tx' to 'head_qw' must all be there, or none");
  return columns;
}

}  // namespace

void write_pose_table(const std::filesystem::path& path, const Estimate& estimate) {
  std::ostringstream csv;
  for (std::size_t i = 0; i < kEstimateColumns; ++i) csv << (i ? "," : "") << kPoseColumns[i];
  csv << '\n';
  for (const SliceEstimate& slice : estimate.slices)
    csv << field(slice.info.scan_id) << ',' << slice.info.stack << ',' << slice.info.index << ','
        << seconds(slice.info.stamp_ns) << ',' << pose_fields(slice.T_brain_slice) << ','
        << pose_fields(slice.T_scanner_brain) << ',' << number(slice.weight) << ',' << number(slice.ncc) << ','
        << to_string(slice.status) << ',' << number(slice.radius_95_mm) << '\n';
  write_file(path, csv.str());
}

void write_truth_table(const std::filesystem::path& path, const std::vector<PoseRow>& rows) {
  std::ostringstream csv;
  for (std::size_t i = 0; i < kPoseColumns.size(); ++i)
    if (i < kRequiredPoseColumns || i >= kEstimateColumns) csv << (i ? "," : "") << kPoseColumns[i];
  csv << '\n';
  for (const PoseRow& row : rows)
    csv << field(row.scan_id) << ',' << row.stack << ',' << row.slice << ',' << seconds(row.stamp_ns) << ','
        << pose_fields(row.T_brain_slice) << ',' << row.displaced << ',' << row.voided << ',' << row.noisy << '\n';
  write_file(path, csv.str());
}

std::vector<PoseRow> read_pose_table(const std::filesystem::path& path) {
  std::ifstream file(path, std::ios::binary);
  if (!file || !std::filesystem::is_regular_file(path)) throw std::runtime_error(path.string() + ": cannot be read");
  std::ostringstream content;
  content << file.rdbuf();
  const std::vector<Record> records = parse_csv(path, content.str());
  if (records.empty()) throw std::runtime_error(path.string() + ", line 1: the file is empty, a header is needed");

  const auto columns = read_header(path, records.front());
  std::vector<PoseRow> rows;
  for (std::size_t i = 1; i < records.size(); ++i) {
    const Record& record = records[i];
    if (record.fields.size() != columns.size())
      fail(path, record.line,
           std::to_string(record.fields.size()) + " fields, the header has " + std::to_string(columns.size()));
    const RowReader reader(path, columns, record);
    PoseRow row;
    row.scan_id = reader.text("scan_id");
    row.stack = reader.value<int>("stack");
    row.slice = reader.value<int>("slice");
    row.stamp_ns = reader.nanoseconds("stamp");
    row.stamp = 1e-9 * static_cast<double>(row.stamp_ns);
    row.T_brain_slice = reader.pose("");
    if (reader.has("head_tx")) row.T_scanner_brain = reader.pose("head_");
    if (reader.has("weight")) row.weight = reader.value<double>("weight");
    if (reader.has("ncc")) row.ncc = reader.value<double>("ncc");
    if (reader.has("status")) row.status = reader.text("status");
    if (reader.has("radius_95_mm")) row.radius_95_mm = reader.value<double>("radius_95_mm");
    for (auto [column, flag] : {std::pair{"displaced", &row.displaced}, {"void", &row.voided}, {"noisy", &row.noisy}})
      if (reader.has(column)) *flag = reader.flag(column);
    rows.push_back(row);
  }
  return rows;
}

void write_update_table(const std::filesystem::path& path, const Journal& journal) {
  std::ostringstream csv;
  csv << kUpdateHeader << '\n';
  for (const JournalEntry& entry : journal.entries())
    csv << seconds(entry.info.stamp_ns) << ',' << entry.info.stack << ',' << entry.info.index << ','
        << entry.sequence_length << ',' << entry.revision << ',' << milliseconds(entry.latency_ms) << ','
        << entry.encoded << ',' << field(entry.device) << ','
        << (is_kept(entry.status) ? pose_fields(entry.T_brain_slice) : std::string("nan,nan,nan,nan,nan,nan,nan"))
        << ',' << to_string(entry.status) << ',' << field(entry.reason) << ',' << milliseconds(entry.volume_latency_ms)
        << ',' << milliseconds(entry.decision_latency_ms) << ',' << field(entry.start) << ','
        << number(entry.radius_95_mm) << '\n';
  write_file(path, csv.str());
}

}  // namespace svort
