#pragma once

#include <Eigen/Core>
#include <cstdint>
#include <vector>

namespace svort {

/// A cube of voxels, centred on the origin, that can be sampled with its gradient. 0 outside.
class SampledVolume {
 public:
  SampledVolume() = default;
  /// @param values size^3, [z][y][x]
  SampledVolume(std::vector<float> values, int size, double voxel_mm);

  struct Sample {
    float value = 0.F;
    Eigen::Vector3f gradient = Eigen::Vector3f::Zero();  ///< per mm; exact derivative of the trilinear interpolant
  };
  /// @param position mm
  Sample at(const Eigen::Vector3f& position) const {
    const Eigen::Vector3f index = position * inverse_voxel_ + Eigen::Vector3f::Constant(centre_);
    const Eigen::Vector3i base = index.array().floor().cast<int>();
    const int last = size_ - 2;
    Sample sample;
    if (base.x() < 0 || base.y() < 0 || base.z() < 0 || base.x() > last || base.y() > last || base.z() > last)
      return sample;
    const Eigen::Vector3f f = index - base.cast<float>();
    const float* v = values_.data() + (static_cast<std::int64_t>(base.z()) * size_ + base.y()) * size_ + base.x();
    const std::int64_t row = size_, plane = static_cast<std::int64_t>(size_) * size_;
    const float x00 = v[0] + f.x() * (v[1] - v[0]);
    const float x10 = v[row] + f.x() * (v[row + 1] - v[row]);
    const float x01 = v[plane] + f.x() * (v[plane + 1] - v[plane]);
    const float x11 = v[plane + row] + f.x() * (v[plane + row + 1] - v[plane + row]);
    const float d00 = v[1] - v[0], d10 = v[row + 1] - v[row];
    const float d01 = v[plane + 1] - v[plane], d11 = v[plane + row + 1] - v[plane + row];
    const float y0 = x00 + f.y() * (x10 - x00), y1 = x01 + f.y() * (x11 - x01);
    const float d0 = d00 + f.y() * (d10 - d00), d1 = d01 + f.y() * (d11 - d01);
    sample.value = y0 + f.z() * (y1 - y0);
    sample.gradient = {d0 + f.z() * (d1 - d0), (x10 - x00) + f.z() * ((x11 - x01) - (x10 - x00)), y1 - y0};
    sample.gradient *= inverse_voxel_;
    return sample;
  }

  int size() const { return size_; }
  double voxel_mm() const { return voxel_mm_; }
  const std::vector<float>& values() const { return values_; }

 private:
  std::vector<float> values_;
  int size_ = 0;
  double voxel_mm_ = 1.;
  float inverse_voxel_ = 1.F, centre_ = 0.F;
};

/// Separable Gaussian blur of a cube, zero outside. @param sigma in voxels; below 0.1 nothing is done
std::vector<float> blurred(std::vector<float> values, int size, double sigma);

}  // namespace svort
