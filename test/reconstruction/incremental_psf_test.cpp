#include "svort_ros/reconstruction/incremental_psf.h"

#include <gtest/gtest.h>
#include <torch/types.h>

#include <algorithm>
#include <cmath>
#include <random>

#include "svort_ros/acquisition/point_spread_function.h"
#include "svort_ros/geometry/rigid_transform.h"
#include "svort_ros/reconstruction/volume_estimation.h"

namespace svort {
namespace {

constexpr std::array<std::int64_t, 3> kShape = {28, 30, 26};
constexpr int kSlices = 24, kPixels = 24;

torch::Tensor random_transforms(std::int64_t count) {
  return axisangle_to_matrix(torch::cat({torch::randn({count, 3}), (torch::rand({count, 3}) * 2 - 1) * 7}, /*dim=*/1));
}

class IncrementalPsf : public testing::Test {
 protected:
  void SetUp() override {
    torch::manual_seed(2);
    slices_ = torch::rand({kSlices, 1, kPixels, kPixels}) + 0.5;
    geometry_.transforms = random_transforms(kSlices);
    geometry_.psf = stack_psfs({gaussian_psf({1.25, 1.25, 3.75}), gaussian_psf({1.25, 1.25, 2.5})});
    geometry_.psf_of_slice = torch::arange(kSlices) % 2;
    geometry_.resolution_ratio = 1.25;
    masks_.slices = torch::rand({kSlices, 1, kPixels, kPixels}) > 0.2;
  }
  torch::Tensor rebuilt(const torch::Tensor& transforms, AcquisitionFormulation formulation) const {
    AcquisitionGeometry geometry = geometry_;
    geometry.transforms = transforms;
    return reconstruct_psf(slices_, SliceAcquisition(geometry, kPixels, kPixels, kShape, formulation, masks_));
  }
  torch::Tensor slices_;
  AcquisitionGeometry geometry_;
  AcquisitionMasks masks_;
};

TEST_F(IncrementalPsf, EqualsARebuildAfterHundredsOfReplacements) {
  std::mt19937 generator(5);
  for (const auto formulation : {AcquisitionFormulation::exact, AcquisitionFormulation::fast}) {
    IncrementalPsfReconstruction incremental(slices_, geometry_, kShape, formulation, masks_);
    std::vector<std::int64_t> all(kSlices);
    for (std::size_t i = 0; i < all.size(); ++i) all[i] = static_cast<std::int64_t>(i);
    int replaced = 0;
    while (replaced < 300) {
      std::shuffle(all.begin(), all.end(), generator);
      const std::vector<std::int64_t> moved(all.begin(), all.begin() + 1 + replaced % 5);
      incremental.replace(moved, random_transforms(static_cast<std::int64_t>(moved.size())));
      replaced += static_cast<int>(moved.size());
    }
    EXPECT_EQ(incremental.rebuild_count(), 1);
    const torch::Tensor expected = rebuilt(incremental.transforms(), formulation), actual = incremental.volume();
    ASSERT_GT(expected.norm().item<double>(), 10.);
    EXPECT_LT(((actual - expected).norm() / expected.norm()).item<double>(), 1e-4) << to_string(formulation);
    // The caller's transforms were copied.
    EXPECT_FALSE(torch::equal(geometry_.transforms, incremental.transforms()));
  }
}

TEST_F(IncrementalPsf, SlicesThatLeaveTakeEverythingWithThem) {
  IncrementalPsfReconstruction incremental(slices_, geometry_, kShape, AcquisitionFormulation::fast, masks_);
  torch::Tensor away = random_transforms(kSlices).clone();
  away.select(2, 3).fill_(300.F);
  std::vector<std::int64_t> all(kSlices);
  for (std::size_t i = 0; i < all.size(); ++i) all[i] = static_cast<std::int64_t>(i);
  incremental.replace(all, away);
  EXPECT_EQ(incremental.volume().abs().max().item<float>(), 0.F) << "rounding must not be divided by rounding";
}

TEST_F(IncrementalPsf, RebuildsAfterTheGivenNumber) {
  IncrementalPsfOptions options;
  options.rebuild_every = 4;
  IncrementalPsfReconstruction incremental(slices_, geometry_, kShape, AcquisitionFormulation::exact, masks_, options);
  incremental.replace({1, 2, 3}, random_transforms(3));
  EXPECT_EQ(incremental.rebuild_count(), 1);
  incremental.replace({5}, random_transforms(1));
  EXPECT_EQ(incremental.rebuild_count(), 2);
  const torch::Tensor expected = rebuilt(incremental.transforms(), AcquisitionFormulation::exact);
  EXPECT_LT(((incremental.volume() - expected).norm() / expected.norm()).item<double>(), 1e-5);
}

TEST_F(IncrementalPsf, RejectsWhatDoesNotFitAndChangesNothing) {
  IncrementalPsfReconstruction incremental(slices_, geometry_, kShape, AcquisitionFormulation::fast, masks_);
  const torch::Tensor before = incremental.volume();
  EXPECT_THROW(incremental.replace({kSlices}, random_transforms(1)), std::invalid_argument);
  EXPECT_THROW(incremental.replace({-1}, random_transforms(1)), std::invalid_argument);
  EXPECT_THROW(incremental.replace({3, 3}, random_transforms(2)), std::invalid_argument);
  EXPECT_THROW(incremental.replace({3}, random_transforms(2)), std::invalid_argument);
  EXPECT_THROW(incremental.replace({3}, torch::full({1, 3, 4}, NAN)), std::invalid_argument);
  EXPECT_TRUE(torch::equal(incremental.volume(), before));
  IncrementalPsfOptions options;
  options.rebuild_every = 0;
  EXPECT_THROW(IncrementalPsfReconstruction(slices_, geometry_, kShape, AcquisitionFormulation::fast, masks_, options),
               std::invalid_argument);
}

}  // namespace
}  // namespace svort
