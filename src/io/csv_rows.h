#pragma once

#include <algorithm>
#include <array>
#include <charconv>
#include <chrono>
#include <cmath>
#include <cstdio>
#include <filesystem>
#include <fstream>
#include <functional>
#include <limits>
#include <set>
#include <sstream>
#include <stdexcept>
#include <string>
#include <type_traits>
#include <utility>
#include <vector>

#include "svort_ros/io/atomic_file.h"

namespace svort {

// Tables that a long measurement stores row by row, so that it may be stopped and started again. Text in them holds
// no commas.

template <class Row>
struct CsvColumn {
  std::string name;
  std::function<std::string(const Row&)> text;
  std::function<void(Row&, const std::string&)> set;
  bool key = false;  ///< one of those that tell rows apart
};

namespace csv_detail {

template <class Value>
std::string text_of(const Value& value) {
  if constexpr (std::is_same_v<Value, std::string>) {
    return value;
  } else if constexpr (std::is_floating_point_v<Value>) {
    std::array<char, 32> buffer{};
    const auto end = std::to_chars(buffer.data(), buffer.data() + buffer.size(), value, std::chars_format::general, 9);
    return std::string(buffer.data(), end.ptr);
  } else {
    return std::to_string(value);
  }
}

template <class Value>
void set_from(const std::string& text, Value* value) {
  if constexpr (std::is_same_v<Value, std::string>) {
    *value = text;
  } else if constexpr (std::is_same_v<Value, bool>) {
    int whole = 0;
    set_from(text, &whole);
    *value = whole != 0;
  } else {
    if constexpr (std::is_floating_point_v<Value>) {
      if (text == "nan" || text == "-nan") {
        *value = std::numeric_limits<Value>::quiet_NaN();
        return;
      }
    }
    const auto [end, error] = std::from_chars(text.data(), text.data() + text.size(), *value);
    if (error != std::errc() || end != text.data() + text.size())
      throw std::invalid_argument("'" + text + "' is not a number");
  }
}

}  // namespace csv_detail

/// @param access reference to the value in a row: Row& -> Value&
template <class Row, class Access>
CsvColumn<Row> csv_column(const std::string& name, Access access, bool key = false) {
  return {name,
          [access](const Row& row) {
            Row copy = row;
            return csv_detail::text_of(std::as_const(access(copy)));
          },
          [access](Row& row, const std::string& text) { csv_detail::set_from(text, &access(row)); }, key};
}

/// None if the file is not there.
/// @throws std::runtime_error naming the file and the line that is not one of write_csv_rows()
template <class Row>
std::vector<Row> read_csv_rows(const std::filesystem::path& path, const std::vector<CsvColumn<Row>>& columns) {
  std::vector<Row> rows;
  std::ifstream file(path);
  if (!file) return rows;
  std::string line;
  for (int number = 1; std::getline(file, line); ++number) {
    if (number == 1) continue;
    std::vector<std::string> fields;
    std::stringstream text(line);
    for (std::string field; std::getline(text, field, ',');) fields.push_back(field);
    const std::string where = path.string() + ": line " + std::to_string(number) + ": ";
    if (fields.size() != columns.size())
      throw std::runtime_error(where + std::to_string(fields.size()) + " fields, there must be " +
                               std::to_string(columns.size()) + "; measure into another folder");
    Row row;
    for (std::size_t i = 0; i < fields.size(); ++i) {
      try {
        columns[i].set(row, fields[i]);
      } catch (const std::invalid_argument& error) {
        throw std::runtime_error(where + columns[i].name + ": " + error.what());
      }
    }
    rows.push_back(row);
  }
  return rows;
}

/// The file is replaced as a whole. @throws std::runtime_error naming the file and the reason
template <class Row>
void write_csv_rows(const std::filesystem::path& path, const std::vector<CsvColumn<Row>>& columns,
                    const std::vector<Row>& rows) {
  std::string csv;
  for (const auto& column : columns) csv += (csv.empty() ? "" : ",") + column.name;
  csv += '\n';
  for (const Row& row : rows) {
    std::string line;
    for (const auto& column : columns) line += (&column == &columns.front() ? "" : ",") + column.text(row);
    csv += line + '\n';
  }
  write_file(path, csv);
}

/// Rows of a file, each once.
template <class Row>
class RowStore {
 public:
  /// Takes over what the file holds. @throws std::runtime_error as read_csv_rows()
  RowStore(std::filesystem::path path, std::vector<CsvColumn<Row>> columns)
      : path_(std::move(path)), columns_(std::move(columns)), rows_(read_csv_rows(path_, columns_)) {
    for (const Row& row : rows_) keys_.insert(key_of(row));
  }

  /// Whether there is a row with the same key columns.
  bool has(const Row& row) const { return keys_.count(key_of(row)) > 0; }
  /// Those that are not there yet, and the file with them. @throws std::runtime_error naming the file and the reason
  void add(const std::vector<Row>& rows) {
    for (const Row& row : rows)
      if (keys_.insert(key_of(row)).second) rows_.push_back(row);
    write_csv_rows(path_, columns_, rows_);
  }
  const std::vector<Row>& rows() const { return rows_; }

 private:
  std::string key_of(const Row& row) const {
    std::string key;
    for (const auto& column : columns_)
      if (column.key) key += column.text(row) + ',';
    return key;
  }

  std::filesystem::path path_;
  std::vector<CsvColumn<Row>> columns_;
  std::vector<Row> rows_;
  std::set<std::string> keys_;
};

/// Tells how far a measurement of equal tasks is.
class TaskClock {
 public:
  explicit TaskClock(std::size_t tasks) : tasks_(tasks) {}
  /// A task that an earlier run has done.
  void skip() { --tasks_; }
  /// After a task: "3 of 144, about 12 min left".
  std::string next() {
    ++done_;
    const double spent = std::chrono::duration<double>(std::chrono::steady_clock::now() - start_).count();
    const double left = spent / static_cast<double>(done_) * static_cast<double>(tasks_ - std::min(tasks_, done_));
    return std::to_string(done_) + " of " + std::to_string(tasks_) + ", about " +
           std::to_string(static_cast<long>(std::ceil(left / 60.))) + " min left";
  }

 private:
  std::size_t tasks_, done_ = 0;
  std::chrono::steady_clock::time_point start_ = std::chrono::steady_clock::now();
};

/// With so many decimals; "-" unless finite.
inline std::string fixed(double value, int decimals) {
  if (!std::isfinite(value)) return "-";
  std::array<char, 64> buffer{};
  const auto end =
      std::to_chars(buffer.data(), buffer.data() + buffer.size(), value, std::chars_format::fixed, decimals);
  return std::string(buffer.data(), end.ptr);
}

}  // namespace svort
