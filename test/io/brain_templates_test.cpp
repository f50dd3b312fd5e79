#include "svort_ros/io/brain_templates.h"

#include <gtest/gtest.h>

#include <fstream>
#include <stdexcept>
#include <string>

#include "scratch.h"
#include "svort_ros/io/nifti.h"

namespace svort {
namespace {

using LoadTemplates = Scratch;

Volume volume_with_a_spot(const Eigen::Vector3d& offset) {
  Volume volume;
  volume.grid.size = Eigen::Vector3i(8, 6, 4);
  volume.grid.spacing = Eigen::Vector3d(1., 2., 3.);
  volume.grid.T_frame_grid.translation() = offset;
  volume.values.assign(volume.grid.voxel_count(), 0.F);
  volume.values[volume.grid.offset(6, 1, 3)] = 5.F;
  return volume;
}

TEST_F(LoadTemplates, CentresEachVolumeAndReadsTheAge) {
  write_nifti(path("brain_27w.nii.gz"), volume_with_a_spot({30., -10., 5.}));
  write_nifti(path("a.nii"), volume_with_a_spot({0., 0., 0.}));
  write_nifti(path("a_parc.nii"), volume_with_a_spot({0., 0., 0.}));
  const auto templates = load_templates(path(""));
  ASSERT_EQ(templates.size(), 2U);
  EXPECT_EQ(templates[0].name, "a");
  EXPECT_EQ(templates[0].gestational_age_weeks, 0.);
  EXPECT_EQ(templates[1].gestational_age_weeks, 27.);
  for (const BrainTemplate& each : templates) {
    // The spot's place relative to the array's centre: (2.5, -1.5, 1.5) voxels of 1 x 2 x 3 mm.
    Eigen::Vector3d spot = Eigen::Vector3d::Zero();
    std::size_t offset = 0;
    for (int z = 0; z < 4; ++z)
      for (int y = 0; y < 6; ++y)
        for (int x = 0; x < 8; ++x, ++offset)
          if (each.volume.values[offset] > 0.F) spot = each.volume.grid.position(Eigen::Vector3d(x, y, z));
    EXPECT_TRUE(spot.isApprox(Eigen::Vector3d(2.5, -3., 4.5), 1e-5)) << each.name << ": " << spot.transpose();
  }
}

TEST_F(LoadTemplates, MasksABrain) {
  Volume volume = volume_with_a_spot({0., 0., 0.});
  volume.values[0] = 3.F;
  write_nifti(path("b.nii.gz"), volume);
  write_nifti(path("b_mask.nii.gz"), volume_with_a_spot({0., 0., 0.}));
  const auto templates = load_templates(path(""));
  ASSERT_EQ(templates.size(), 1U);
  float sum = 0.F;
  for (const float value : templates[0].volume.values) sum += value;
  EXPECT_EQ(sum, 5.F) << "what is outside the mask is dark";
}

TEST_F(LoadTemplates, NamesWhatIsMissing) {
  EXPECT_TRUE(load_templates("").empty());
  const auto message_of = [](const std::filesystem::path& folder) {
    try {
      load_templates(folder);
    } catch (const std::runtime_error& error) {
      return std::string(error.what());
    }
    return std::string();
  };
  EXPECT_NE(message_of(path("nowhere")).find("nowhere: no such folder"), std::string::npos);
  EXPECT_NE(message_of(path("")).find("no NIfTI volume"), std::string::npos);
  std::ofstream(path("c.nii")) << "not a volume";
  EXPECT_NE(message_of(path("")).find("c.nii"), std::string::npos);
}

}  // namespace
}  // namespace svort
