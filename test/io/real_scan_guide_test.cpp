// The shipped weights on the bundled real scan, which no network was trained on.

#include <gtest/gtest.h>

#include <algorithm>
#include <cstdio>
#include <filesystem>
#include <string>
#include <vector>

#include "svort_ros/geometry/rigid_fit.h"
#include "svort_ros/io/brain_templates.h"
#include "svort_ros/io/nifti_stack.h"
#include "svort_ros/live/live_pipeline.h"

namespace svort {
namespace {

const std::filesystem::path kSource = SVORT_SOURCE_DIR;
constexpr double kLeverMm = 40.;

std::vector<Slice> real_scan() {
  const std::filesystem::path folder = kSource / "data/real";
  std::vector<std::filesystem::path> stacks, masks;
  for (const char* run : {"1", "3", "5"}) {
    stacks.push_back(folder / (std::string("sub-01_run-") + run + "_T2w.nii.gz"));
    masks.push_back(folder / (std::string("sub-01_run-") + run + "_T2w_desc-brain_mask.nii.gz"));
  }
  return read_stacks(stacks, masks, "real", {});
}

std::vector<Pose> registered(const std::vector<Slice>& scan, bool guided, const std::string& templates = {}) {
  PipelineOptions options;
  options.estimator.registration.finest_mm = 2.;
  options.estimator.search_every = 0;  // what is said while slices arrive does not matter here
  options.estimator.network.guide = guided;
  if (guided) options.estimator.network.weights = (kSource / "models/live.pt").string();
  LivePipeline pipeline(options, load_templates(templates));
  for (const Slice& slice : scan) pipeline.add(slice);
  pipeline.finalise();
  std::vector<Pose> poses;
  for (const SliceEstimate& slice : pipeline.estimate().slices) poses.push_back(slice.T_brain_slice);
  return poses;
}

/// Mean over slices after the one motion that fits best, mm.
double relative_mm(const std::vector<Pose>& a, const std::vector<Pose>& b) {
  const Pose fit = fit_planes(a, b, kLeverMm);
  double sum = 0.;
  for (std::size_t i = 0; i < a.size(); ++i)
    sum += plane_distance(fit * a[i], b[i], kLeverMm) / static_cast<double>(a.size());
  return sum;
}

TEST(RealScanGuide, FindsTheCanonicalFrameOfTheBundledScan) {
  // The template is this very brain, aligned with the atlas: its match is the frame.
  const std::vector<Slice> scan = real_scan();
  const std::vector<Pose> voted = registered(scan, true),
                          matched = registered(scan, false, (kSource / "models/template").string());
  EXPECT_LT(relative_mm(voted, matched), 0.5) << "the guide must not harm registration";
  const Pose off = fit_planes(voted, matched, kLeverMm);
  std::printf("the network's frame is off by %.1f degrees and %.1f mm\n", rotation_angle(off) * 180. / M_PI,
              off.translation().norm());
  EXPECT_LT(rotation_angle(off), 20. * M_PI / 180.);
  EXPECT_LT(off.translation().norm(), 8.);
}

TEST(RealScanGuide, RegistrationThatItGuidesFindsAHeadThatIsMadeToJump) {
  const std::vector<Slice> scan = real_scan();
  const std::vector<Pose> truth = registered(scan, false);
  // A scanner that turns about the brain is as good as a head that turns in the scanner.
  std::vector<Slice> jumped = scan;
  Eigen::Vector3d centre = Eigen::Vector3d::Zero();
  for (const Slice& slice : scan) centre += slice.info.T_scanner_slice.translation() / static_cast<double>(scan.size());
  Pose jump = Pose::Identity();
  jump.linear() = Eigen::AngleAxisd(0.9, Eigen::Vector3d(1., -2., 1.).normalized()).toRotationMatrix();
  jump.translation() = centre - jump.linear() * centre + Eigen::Vector3d(6., -4., 5.);
  // From the middle of the second stack to its end. The slices of a stack must be parallel: those after the jump are
  // sent as a stack of their own.
  int stack = 0;
  for (Slice& slice : jumped) stack = std::max(stack, slice.info.stack);
  std::size_t in_second = 0;
  for (Slice& slice : jumped) {
    if (slice.info.stack != 1 || ++in_second <= 11) continue;
    slice.info.T_scanner_slice = jump * slice.info.T_scanner_slice;
    slice.info.stack = stack + 1;
  }
  const std::vector<Pose> guided = registered(jumped, true);
  ASSERT_EQ(guided.size(), truth.size());
  std::vector<Pose> nominal;
  for (const Slice& slice : jumped)
    if (std::any_of(slice.mask.begin(), slice.mask.end(), [](auto value) { return value != 0; }))
      nominal.push_back(slice.info.T_scanner_slice);
  ASSERT_EQ(nominal.size(), truth.size());
  EXPECT_GT(relative_mm(nominal, truth), 10.);
  EXPECT_LT(relative_mm(guided, truth), 2.);
}

}  // namespace
}  // namespace svort
