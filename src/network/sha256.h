#pragma once

#include <array>
#include <cstddef>
#include <cstdint>
#include <string>

namespace svort {

/// SHA-256 (FIPS 180-4).
class Sha256 {
 public:
  void add(const void* data, std::size_t size);
  /// 64 digits. Ends the message: add() must not follow.
  std::string hexadecimal();

 private:
  void process(const unsigned char* block);

  std::array<std::uint32_t, 8> state_ = {0x6a09e667U, 0xbb67ae85U, 0x3c6ef372U, 0xa54ff53aU,
                                         0x510e527fU, 0x9b05688cU, 0x1f83d9abU, 0x5be0cd19U};
  std::array<unsigned char, 64> block_{};
  std::size_t filled_ = 0;
  std::uint64_t length_ = 0;
};

}  // namespace svort
