#pragma once

#include <Eigen/Geometry>
#include <array>
#include <charconv>
#include <cmath>
#include <cstdint>
#include <cstdio>
#include <cstdlib>
#include <filesystem>
#include <stdexcept>
#include <string>
#include <vector>

#include "svort_ros/geometry/pose.h"

namespace svort {

// Fields of CSV files, as docs/files.md describes them.

/// Shortest text that reads back as the same number; "nan" whatever the NaN's sign.
inline std::string number(double value) {
  if (std::isnan(value)) return "nan";
  std::array<char, 32> buffer{};
  const auto result = std::to_chars(buffer.data(), buffer.data() + buffer.size(), value);
  return std::string(buffer.data(), result.ptr);
}

inline std::string milliseconds(double value) {
  if (std::isnan(value)) return "nan";
  std::array<char, 64> buffer{};
  std::snprintf(buffer.data(), buffer.size(), "%.3f", value);
  return buffer.data();
}

/// Seconds with nine decimals, exact.
inline std::string seconds(std::int64_t ns) {
  constexpr std::int64_t kSecond = 1000000000;
  std::array<char, 64> buffer{};
  std::snprintf(buffer.data(), buffer.size(), "%s%lld.%09lld", ns < 0 ? "-" : "",
                static_cast<long long>(std::abs(ns / kSecond)), static_cast<long long>(std::abs(ns % kSecond)));
  return buffer.data();
}

/// Text as a CSV field: quoted if it must be (RFC 4180).
inline std::string field(const std::string& text) {
  if (text.find_first_of(",\"\r\n") == std::string::npos) return text;
  std::string quoted = "\"";
  for (const char c : text) {
    if (c == '"') quoted += '"';
    quoted += c;
  }
  return quoted + '"';
}

/// "tx,ty,tz,qx,qy,qz,qw", the quaternion with qw >= 0.
inline std::string pose_fields(const Pose& pose) {
  Eigen::Quaterniond q(pose.linear());
  q.normalize();
  if (q.w() < 0.) q.coeffs() *= -1.;
  const auto& t = pose.translation();
  std::string text;
  for (const double value : {t.x(), t.y(), t.z(), q.x(), q.y(), q.z(), q.w()})
    text += (text.empty() ? "" : ",") + number(value == 0. ? 0. : value);  // no "-0"
  return text;
}

[[noreturn]] inline void fail(const std::filesystem::path& path, std::size_t line, const std::string& what) {
  throw std::runtime_error(path.string() + ", line " + std::to_string(line) + ": " + what);
}

struct Record {
  std::size_t line = 0;  ///< line on which it starts, from 1
  std::vector<std::string> fields;
};

/// Splits CSV text into records; quoted fields may hold commas, quotes and line breaks. Empty lines are skipped.
inline std::vector<Record> parse_csv(const std::filesystem::path& path, const std::string& text) {
  std::vector<Record> records;
  Record record;
  std::string current;
  bool quoted = false;      // inside quotes
  bool was_quoted = false;  // the field had quotes, so it may be empty on an otherwise empty line
  std::size_t line = 1;
  record.line = 1;
  const auto end_record = [&] {
    if (!record.fields.empty() || !current.empty() || was_quoted) {
      record.fields.push_back(current);
      records.push_back(record);
    }
    record = Record{line, {}};
    current.clear();
    was_quoted = false;
  };
  for (std::size_t i = 0; i < text.size(); ++i) {
    const char c = text[i];
    if (c == '\n') ++line;
    if (quoted) {
      if (c != '"') {
        current += c;
      } else if (i + 1 < text.size() && text[i + 1] == '"') {
        current += '"';
        ++i;
      } else {
        quoted = false;
      }
    } else if (c == '"') {
      if (!current.empty()) fail(path, line, "a quote in the middle of a field");
      quoted = true;
      was_quoted = true;
    } else if (c == ',') {
      record.fields.push_back(current);
      current.clear();
      was_quoted = false;
    } else if (c == '\n') {
      end_record();
    } else if (c != '\r') {
      current += c;
    }
  }
  if (quoted) fail(path, record.line, "a quoted field does not end");
  end_record();
  return records;
}

}  // namespace svort
