#include "svort_ros/io/nifti_stack.h"

#include <algorithm>
#include <cmath>

#include "io/raw_nifti.h"
#include "io/scratch.h"
#include "svort_ros/sequence/slice_sequence.h"

namespace svort {
namespace {

using NiftiStack = Scratch;

/// 3 x 2 pixels, 5 slices; voxel (i, j, k) holds i + 10 j + 100 k. Oblique: 2 mm columns, 1.5 mm rows, slices 4 mm
/// apart.
RawNifti oblique_stack() {
  RawNifti raw(3, 2, 5, 4);
  std::vector<std::int16_t> values;
  for (int k = 0; k < 5; ++k)
    for (int j = 0; j < 2; ++j)
      for (int i = 0; i < 3; ++i) values.push_back(static_cast<std::int16_t>(i + 10 * j + 100 * k));
  const float c = std::cos(0.3F), s = std::sin(0.3F);
  // RAS: columns along (c, s, 0), rows along (-s, c, 0), slices along z.
  return raw.values(values).sform({2.F * c, -1.5F * s, 0.F, 10.F, 2.F * s, 1.5F * c, 0.F, 20.F, 0.F, 0.F, 4.F, 30.F});
}

RawNifti mask_of(const RawNifti& stack, float value = 1.F) {
  RawNifti mask(3, 2, 5, 16);
  std::vector<float> values(30, 0.F);
  values[7] = value;  // slice 1, pixel (1, 0)
  mask.values(values);
  const std::string header = stack.bytes();
  for (std::size_t offset = 280; offset < 328; offset += 4) {
    float entry = 0.F;
    std::memcpy(&entry, header.data() + offset, 4);
    mask.put(offset, entry);
  }
  return mask;
}

TEST_F(NiftiStack, OrderTimesAndGeometry) {
  StackTimingOptions options;
  options.tr_s = 0.7;
  options.start_s = 100.25;
  const auto file = write("a.nii", oblique_stack().bytes());
  const std::vector<Slice> slices = read_stacks({file, file}, {}, "scan x", options);
  ASSERT_EQ(slices.size(), 10U);
  const std::vector<int> order = {0, 2, 4, 1, 3, 0, 2, 4, 1, 3};
  for (std::size_t i = 0; i < slices.size(); ++i) {
    const Slice& slice = slices[i];
    EXPECT_EQ(slice.info.scan_id, "scan x");
    EXPECT_EQ(slice.info.stack, i < 5 ? 0 : 1);
    EXPECT_EQ(slice.info.index, order[i]);
    EXPECT_EQ(slice.info.slices_in_stack, 5);
    EXPECT_EQ(slice.info.stamp_ns, 100250000000 + static_cast<std::int64_t>(i) * 700000000);
    EXPECT_EQ(slice.info.columns, 3);
    EXPECT_EQ(slice.info.rows, 2);
    EXPECT_TRUE(slice.info.pixel_spacing.isApprox(Eigen::Vector2d(2., 1.5), 1e-6));
    EXPECT_NEAR(slice.info.thickness, 4., 1e-6);
    EXPECT_TRUE(slice.mask.empty());
    EXPECT_TRUE(is_rigid(slice.info.T_scanner_slice));
    // Pixel (2, 1): RAS (10 + 4 c - 1.5 s, 20 + 4 s + 1.5 c, 30 + 4 k), LPS has x and y negated.
    const double c = std::cos(0.3), s = std::sin(0.3);
    const Eigen::Vector3d expected(-(10. + 4. * c - 1.5 * s), -(20. + 4. * s + 1.5 * c), 30. + 4. * slice.info.index);
    EXPECT_LT((slice.info.T_scanner_slice * Eigen::Vector3d(2., 0.75, 0.) - expected).norm(), 1e-5);
    EXPECT_EQ(slice.pixels[5], 12.F + 100.F * static_cast<float>(slice.info.index));
  }
}

TEST_F(NiftiStack, InterleaveAndThickness) {
  StackTimingOptions options;
  options.interleave = 1;
  options.thickness_mm = 3.25;
  const auto file = write("a.nii", oblique_stack().bytes());
  std::vector<Slice> slices = read_stacks({file}, {}, "x", options);
  for (int i = 0; i < 5; ++i) EXPECT_EQ(slices[static_cast<std::size_t>(i)].info.index, i);
  EXPECT_EQ(slices[0].info.thickness, 3.25);
  options.interleave = 3;
  slices = read_stacks({file}, {}, "x", options);
  std::vector<int> order;
  for (const Slice& slice : slices) order.push_back(slice.info.index);
  EXPECT_EQ(order, (std::vector<int>{0, 3, 1, 4, 2}));
}

TEST_F(NiftiStack, MasksBelongToTheirSlices) {
  const auto stack = write("a.nii", oblique_stack().bytes());
  const auto mask = write("m.nii", mask_of(oblique_stack(), 0.5F).bytes());
  for (const Slice& slice : read_stacks({stack}, {mask}, "x", {})) {
    ASSERT_EQ(slice.mask.size(), 6U);
    for (std::size_t i = 0; i < 6; ++i) EXPECT_EQ(slice.mask[i], slice.info.index == 1 && i == 1 ? 1 : 0);
  }
}

TEST_F(NiftiStack, NamesFileAndFault) {
  const auto stack = write("a.nii", oblique_stack().bytes());
  const auto good = write("m.nii", mask_of(oblique_stack()).bytes());
  const auto message = [&](const RawNifti& mask) {
    const auto file = write("bad.nii", mask.bytes());
    const std::string text = message_of([&] { read_stacks({stack}, {file}, "x", {}); });
    EXPECT_EQ(text.rfind(file.string() + ": ", 0), 0U) << text;
    return text;
  };
  EXPECT_TRUE(contains(message(RawNifti(3, 2, 4, 16).values(std::vector<float>(24, 1.F))),
                       "the mask has 3 2 4 voxels, its stack " + stack.string() + " has 3 2 5"));
  EXPECT_TRUE(contains(message(mask_of(oblique_stack()).put<float>(292, 10.002F)), "(tolerance 0.001 mm)"));
  EXPECT_NO_THROW(
      read_stacks({stack}, {write("b.nii", mask_of(oblique_stack()).put<float>(292, 10.0005F).bytes())}, "x", {}));
  EXPECT_TRUE(contains(message(mask_of(oblique_stack(), 0.F)), "no brain voxel"));
  EXPECT_TRUE(contains(message(mask_of(oblique_stack(), NAN)), "NaN or infinity"));
  EXPECT_MESSAGE(read_stacks({stack, stack}, {good}, "x", {}), "1 masks for 2 stacks");
  EXPECT_MESSAGE(read_stacks({path("none.nii")}, {}, "x", {}), path("none.nii").string() + ": no such file");
  // Rows that lean over the columns are no slice geometry.
  const auto sheared = write("s.nii", oblique_stack().put<float>(284, 1.F).bytes());
  EXPECT_MESSAGE(read_stacks({sheared}, {}, "x", {}), sheared.string() + ": ");
  EXPECT_MESSAGE(read_stacks({sheared}, {}, "x", {}), "not orthogonal");
}

TEST_F(NiftiStack, NamesOptionsThatAreOutOfRange) {
  const auto stack = write("a.nii", oblique_stack().bytes());
  const auto message = [&](const auto& change) {
    StackTimingOptions options;
    change(options);
    return message_of([&] { read_stacks({stack}, {}, "x", options); });
  };
  using Options = StackTimingOptions;
  EXPECT_EQ(message([](Options& o) { o.interleave = 0; }), "interleave is 0, must be at least 1");
  EXPECT_EQ(message([](Options& o) { o.tr_s = 0.; }), "tr_s is 0, must be finite and positive");
  EXPECT_EQ(message([](Options& o) { o.thickness_mm = -1.; }), "thickness_mm is -1, must be finite and at least 0");
  EXPECT_EQ(message([](Options& o) { o.start_s = NAN; }), "start_s is nan, must be in 0 .. 4e9");
}

/// The bundled scan: three stacks of 22 slices, of which those beyond the brain's ends are rejected as empty.
TEST_F(NiftiStack, BundledScan) {
  const std::filesystem::path folder = std::filesystem::path(SVORT_SOURCE_DIR) / "data/real";
  std::vector<std::filesystem::path> stacks, masks;
  for (const std::string run : {"1", "3", "5"}) {
    stacks.push_back(folder / ("sub-01_run-" + run + "_T2w.nii.gz"));
    masks.push_back(folder / ("sub-01_run-" + run + "_T2w_desc-brain_mask.nii.gz"));
  }
  StackTimingOptions options;
  options.thickness_mm = 3.;
  const std::vector<Slice> slices = read_stacks(stacks, masks, "sub-01", options);
  ASSERT_EQ(slices.size(), 66U);
  EXPECT_EQ(slices.back().info.stamp_ns, 1000000000 + 65 * std::int64_t{1200000000});

  SliceSequence sequence;
  for (const Slice& slice : slices) {
    const bool has_brain = std::count(slice.mask.begin(), slice.mask.end(), 1) > 0;
    const Arrival arrival = sequence.add(slice);
    EXPECT_TRUE(arrival.warnings.empty());
    if (has_brain && arrival.status == ArrivalStatus::accepted) {
      EXPECT_EQ(sequence.newest_arrival()->info.index, slice.info.index);
    } else {
      EXPECT_EQ(arrival.status, ArrivalStatus::empty_mask) << arrival.reason;
    }
    RecordProperty("intensity_scale", std::to_string(sequence.intensity_scale()));
  }
  EXPECT_GE(sequence.slices().size(), 45U);
  EXPECT_GE(sequence.arrivals().at(ArrivalStatus::empty_mask), 3U);
  // A head of this age is 6 to 11 cm in every direction.
  EXPECT_GT(sequence.brain_roi().extent().minCoeff(), 50.);
  EXPECT_LT(sequence.brain_roi().extent().maxCoeff(), 120.);
}

}  // namespace
}  // namespace svort
