#include <gtest/gtest.h>

#include "golden_data.h"
#include "svort_ros/acquisition/slice_acquisition.h"
#include "svort_ros/geometry/rigid_transform.h"

namespace svort {
namespace {

constexpr double kForwardTolerance = 1e-4;
constexpr double kAdjointTolerance = 1e-5;
// A voxel with an arbitrarily small weight gets a full value, one with none 0; rounding may flip a few.
constexpr double kEqualizedL2Tolerance = 1e-4;
constexpr double kOffVoxel = 1e-3, kOffVoxelShare = 1e-4;

bool ends_with(const std::string& text, const std::string& ending) {
  return text.size() >= ending.size() && text.compare(text.size() - ending.size(), ending.size(), ending) == 0;
}

TEST(GoldenSliceAcquisition, MatchesThePublicImplementation) {
  const GoldenData data("slice_acq.pt");
  WorstDeviation transforms("transforms of axis-angle, maximum", 1e-6);
  WorstDeviation forward("acquired slices, maximum", kForwardTolerance);
  WorstDeviation weights("weights of acquired slices, maximum", kForwardTolerance);
  WorstDeviation plain("plain adjoint, maximum", kAdjointTolerance);
  WorstDeviation equalized("equalised adjoint, relative L2", kEqualizedL2Tolerance);
  WorstDeviation flipped("equalised adjoint, share of voxels off", kOffVoxelShare);

  const torch::Tensor volume = data.at("volume"), volume_mask = data.at("vol_mask");
  transforms.check(deviation(axisangle_to_matrix(data.at("ax")), data.at("transforms")).maximum, "transforms");
  int cases = 0;
  for (; data.has("c" + std::to_string(cases) + "_slice_shape"); ++cases) {
    const std::string prefix = "c" + std::to_string(cases) + "_";
    const torch::Tensor shape = data.at(prefix + "slice_shape").to(torch::kLong);
    const auto height = static_cast<int>(shape[0].item<std::int64_t>());
    const auto width = static_cast<int>(shape[1].item<std::int64_t>());
    const AcquisitionGeometry geometry{data.at("transforms"), data.at("psf"),
                                       data.at(prefix + "res_ratio").item<double>()};
    const torch::Tensor slices_mask = data.at(prefix + "slices_mask"), slices = data.at(prefix + "slices_in");
    const auto masks_of = [&](const std::string& key) {
      const bool both = ends_with(key, "_both");
      return AcquisitionMasks{both || ends_with(key, "_smask") ? slices_mask : torch::Tensor(),
                              both || ends_with(key, "_vmask") ? volume_mask : torch::Tensor()};
    };
    for (const std::string& key : data.keys(prefix + "fwd")) {
      const bool is_weight = ends_with(key, "_weight");
      const std::string result = is_weight ? key.substr(0, key.size() - 7) : key;
      torch::Tensor weight;
      const torch::Tensor acquired = acquire_slices(volume, geometry, height, width, masks_of(result), &weight);
      (is_weight ? weights : forward).check(deviation(is_weight ? weight : acquired, data.at(key)).maximum, key);
    }
    for (const std::string& key : data.keys(prefix + "adj_eq")) {
      const bool equalize = key[prefix.size() + 6] == '1';
      const torch::Tensor scattered =
          scatter_slices(slices, geometry, {volume.size(0), volume.size(1), volume.size(2)}, equalize, masks_of(key));
      const torch::Tensor expected = data.at(key);
      const Deviation d = deviation(scattered, expected);
      if (!equalize) {
        plain.check(d.maximum, key);
        continue;
      }
      equalized.check(d.relative_l2, key);
      flipped.check(((scattered - expected).abs() > kOffVoxel).to(torch::kFloat64).mean().item<double>(), key);
    }
  }
  EXPECT_GE(cases, 1);
  EXPECT_GE(forward.count(), 4) << "fwd, fwd_smask, fwd_vmask, fwd_both";
  EXPECT_GE(weights.count(), 2);
  EXPECT_GE(plain.count(), 2);
  EXPECT_GE(equalized.count(), 2);
}

}  // namespace
}  // namespace svort
