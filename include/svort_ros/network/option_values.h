#pragma once

#include <cstdint>
#include <limits>
#include <map>
#include <stdexcept>
#include <string>
#include <type_traits>
#include <utility>
#include <variant>

namespace svort {

/// The options of any network, as checkpoints and the registry carry them; keys of sections are "section.key".
using OptionValue = std::variant<bool, std::int64_t, double, std::string>;
using OptionValues = std::map<std::string, OptionValue>;

/// As text, e.g. for listings.
std::string to_string(const OptionValue& value);

namespace option_values_detail {

class Collector {
 public:
  Collector(OptionValues* values, std::string prefix) : values_(values), prefix_(std::move(prefix)) {}

  template <class T>
  void operator()(const std::string& key, const T& value, const char* /*help*/) {
    static_assert(std::is_arithmetic_v<T> || std::is_same_v<T, std::string>);
    if constexpr (std::is_same_v<T, bool> || std::is_same_v<T, std::string>)
      (*values_)[prefix_ + key] = value;
    else if constexpr (std::is_integral_v<T>)
      (*values_)[prefix_ + key] = static_cast<std::int64_t>(value);
    else
      (*values_)[prefix_ + key] = static_cast<double>(value);
  }
  template <class Options>
  void section(const std::string& key, Options& options) {
    options.visit(Collector(values_, prefix_ + key + "."));
  }

 private:
  OptionValues* values_;
  std::string prefix_;
};

class Assigner {
 public:
  Assigner(OptionValues* left, std::string prefix) : left_(left), prefix_(std::move(prefix)) {}

  template <class T>
  void operator()(const std::string& key, T& value, const char* /*help*/) {
    const auto entry = left_->find(prefix_ + key);
    if (entry == left_->end()) return;
    if constexpr (std::is_same_v<T, bool> || std::is_same_v<T, std::string>) {
      value = get<T>(*entry);
    } else if constexpr (std::is_integral_v<T>) {
      const auto number = get<std::int64_t>(*entry);
      if (number < static_cast<std::int64_t>(std::numeric_limits<T>::min()) ||
          number > static_cast<std::int64_t>(std::numeric_limits<T>::max()))
        throw std::invalid_argument("option '" + entry->first + "' is out of range: " + std::to_string(number));
      value = static_cast<T>(number);
    } else {
      // An integer is a number too; files may say 1 for 1.0.
      const bool integer = std::holds_alternative<std::int64_t>(entry->second);
      value =
          static_cast<T>(integer ? static_cast<double>(std::get<std::int64_t>(entry->second)) : get<double>(*entry));
    }
    left_->erase(entry);
  }
  template <class Options>
  void section(const std::string& key, Options& options) {
    options.visit(Assigner(left_, prefix_ + key + "."));
  }

 private:
  template <class T>
  static const T& get(const OptionValues::value_type& entry) {
    const T* value = std::get_if<T>(&entry.second);
    if (value == nullptr) throw std::invalid_argument("option '" + entry.first + "' has a value of the wrong type");
    return *value;
  }

  OptionValues* left_;
  std::string prefix_;
};

}  // namespace option_values_detail

/// All options of a struct that describes itself with visit().
template <class Options>
OptionValues option_values(Options options) {
  OptionValues values;
  options.visit(option_values_detail::Collector(&values, ""));
  return values;
}

/// Overwrites the options that `values` names.
/// @throws std::invalid_argument naming an unknown option, or one of the wrong type or out of range
template <class Options>
void assign_options(OptionValues values, Options* options) {
  options->visit(option_values_detail::Assigner(&values, ""));
  if (!values.empty()) throw std::invalid_argument("unknown option '" + values.begin()->first + "'");
}

}  // namespace svort
