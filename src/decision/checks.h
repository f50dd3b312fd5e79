#pragma once

#include <sstream>
#include <stdexcept>
#include <string>

namespace svort {

/// Throws what every option out of range throws: its name, its value and the limit.
class OptionCheck {
 public:
  explicit OptionCheck(std::string section) : section_(std::move(section)) {}

  template <class Value>
  void operator()(bool ok, const char* option, const Value& value, const char* limit) const {
    if (ok) return;
    std::ostringstream message;
    message << section_ << option << " is " << value << "; it must be " << limit;
    throw std::invalid_argument(message.str());
  }

 private:
  std::string section_;
};

}  // namespace svort
