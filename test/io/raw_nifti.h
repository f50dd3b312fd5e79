#pragma once

#include <algorithm>
#include <array>
#include <cstdint>
#include <cstring>
#include <string>
#include <vector>

namespace svort {

/// Bytes of a NIfTI-1 file (.nii), built field by field from the standard, so that reader and test share no code.
class RawNifti {
 public:
  RawNifti(int nx, int ny, int nz, std::int16_t datatype, bool big_endian = false)
      : big_endian_(big_endian), header_(352, '\0') {
    put<std::int32_t>(0, 348);
    const std::array<std::int16_t, 8> dim = {
        3, static_cast<std::int16_t>(nx), static_cast<std::int16_t>(ny), static_cast<std::int16_t>(nz), 1, 1, 1, 1};
    for (std::size_t i = 0; i < dim.size(); ++i) put(40 + 2 * i, dim[i]);
    put<std::int16_t>(70, datatype);
    for (std::size_t i = 0; i < 8; ++i) put<float>(76 + 4 * i, 1.F);
    put<float>(108, 352.F);
    put<float>(112, 1.F);
    header_[123] = 2;  // mm
    std::memcpy(&header_[344], "n+1", 4);
    sform({1.F, 0.F, 0.F, 0.F, 0.F, 1.F, 0.F, 0.F, 0.F, 0.F, 1.F, 0.F});
  }

  template <class T>
  RawNifti& put(std::size_t offset, T value) {
    const std::string bytes = to_bytes(value);
    header_.replace(offset, bytes.size(), bytes);
    return *this;
  }
  RawNifti& bits(std::int16_t bits_per_voxel) { return put<std::int16_t>(72, bits_per_voxel); }
  RawNifti& scaling(float slope, float inter) { return put(112, slope).put(116, inter); }
  RawNifti& sform(const std::array<float, 12>& rows, std::int16_t code = 1) {
    for (std::size_t i = 0; i < rows.size(); ++i) put(280 + 4 * i, rows[i]);
    return put<std::int16_t>(254, code);
  }
  RawNifti& units(char units) {
    header_[123] = units;
    return *this;
  }

  template <class T>
  RawNifti& values(const std::vector<T>& values) {
    bits(static_cast<std::int16_t>(8 * sizeof(T)));
    data_.clear();
    for (const T value : values) data_ += to_bytes(value);
    return *this;
  }

  std::string bytes() const { return header_ + data_; }

 private:
  template <class T>
  std::string to_bytes(T value) const {
    std::string bytes(sizeof(T), '\0');
    std::memcpy(bytes.data(), &value, sizeof(T));
    if (big_endian_) std::reverse(bytes.begin(), bytes.end());  // the tests run on little-endian machines
    return bytes;
  }

  bool big_endian_;
  std::string header_;
  std::string data_;
};

}  // namespace svort
