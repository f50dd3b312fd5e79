#include "svort_ros/simulation/scan_slices.h"

#include <gtest/gtest.h>
#include <torch/types.h>

#include <stdexcept>

namespace svort {
namespace {

SimulatedScan scan_of_phantom(bool prepared) {
  PhantomOptions phantom;
  phantom.length_mm = 60.;
  phantom.resolution_mm = 2.;
  SimulatorOptions options;
  options.motion = "mild";
  options.prepared = prepared;
  options.anatomy = no_anatomy_variation();
  options.scanner.stacks_min = options.scanner.stacks_max = 2;
  NetworkGrid grid;
  grid.volume_shape = {48, 48, 48};
  grid.resolution_mm = 2.;
  return ScanSimulator({make_phantom(phantom)}, grid, options, 1).simulate(0, 1)[0];
}

TEST(ScanSlices, HandOutWhatWasSimulated) {
  const SimulatedScan scan = scan_of_phantom(false);
  ScanSlicesOptions options;
  options.scan_id = "case";
  options.start_ns = 5000000000;
  const std::vector<Slice> slices = scan_slices(scan, options);
  ASSERT_EQ(slices.size(), scan.plan.acquired.size());
  for (std::size_t i = 0; i < slices.size(); ++i) {
    const SliceInfo& info = slices[i].info;
    EXPECT_EQ(info.scan_id, "case");
    EXPECT_EQ(info.stack, scan.plan.acquired[i].stack);
    EXPECT_EQ(info.index, scan.plan.acquired[i].index);
    EXPECT_NEAR(1e-9 * static_cast<double>(info.stamp_ns - 5000000000), scan.plan.acquired[i].time_s, 1e-9);
    EXPECT_TRUE(info.T_scanner_slice.isApprox(scan.plan.acquired[i].T_scanner_slice));
    EXPECT_EQ(info.thickness, scan.plan.thickness_mm);
    EXPECT_EQ(info.pixel_spacing.x(), 2.);
    ASSERT_EQ(slices[i].pixels.size(), 64U * 64U);
    const torch::Tensor image = scan.input.slices[static_cast<std::int64_t>(i)].flatten();
    const torch::Tensor mask = scan.masks[static_cast<std::int64_t>(i)].flatten();
    for (const int pixel : {0, 64 * 32 + 32, 64 * 20 + 40}) {
      const auto at = static_cast<std::size_t>(pixel);
      EXPECT_FLOAT_EQ(slices[i].pixels[at], 1000.F * image[pixel].item<float>());
      EXPECT_EQ(slices[i].mask[at] != 0, mask[pixel].item<bool>());
    }
  }
}

TEST(ScanSlices, PreparedScansHaveNoWholeSlices) {
  EXPECT_THROW(scan_slices(scan_of_phantom(true)), std::invalid_argument);
}

}  // namespace
}  // namespace svort
