#include "svort_ros/io/brain_volume_file.h"

#include <gtest/gtest.h>
#include <torch/types.h>

#include "io/scratch.h"
#include "svort_ros/io/nifti.h"

namespace svort {
namespace {

class BrainVolumeFile : public Scratch {
 protected:
  /// A volume of 3 x 4 x 5 voxels of 2 mm whose axes run along the given LPS directions.
  std::filesystem::path write(const std::string& name, const Eigen::Matrix3d& axes, std::vector<float> values = {},
                              const Eigen::Vector3d& spacing = Eigen::Vector3d::Constant(2.)) {
    Volume volume;
    volume.grid.size = {3, 4, 5};
    volume.grid.spacing = spacing;
    volume.grid.T_frame_grid.linear() = axes;
    if (values.empty())
      for (int i = 0; i < 60; ++i) values.push_back(static_cast<float>(i));
    volume.values = values;
    write_nifti(path(name), volume);
    return path(name);
  }
  std::string message(const std::filesystem::path& image, const std::filesystem::path& mask = {},
                      const std::filesystem::path& parcellation = {}) {
    try {
      read_brain_volume(image, mask, parcellation);
    } catch (const std::runtime_error& error) {
      return error.what();
    }
    return "read";
  }
};

TEST_F(BrainVolumeFile, AxesAreTurnedToLps) {
  const auto lps = read_brain_volume(write("lps.nii.gz", Eigen::Matrix3d::Identity()));
  EXPECT_EQ(lps.image.sizes(), torch::IntArrayRef({5, 4, 3}));
  EXPECT_EQ(lps.image[1][2][0].item<float>(), 18.F);  // z 1, y 2, x 0
  EXPECT_NEAR(lps.resolution_mm, 2., 1e-6);
  EXPECT_EQ(lps.mask.sum().item<int>(), 59);  // above 0

  // Array axes along right, superior, anterior: RAS-like, permuted, with determinant +1.
  Eigen::Matrix3d axes;
  axes.col(0) = -Eigen::Vector3d::UnitX();
  axes.col(1) = Eigen::Vector3d::UnitZ();
  axes.col(2) = Eigen::Vector3d::UnitY();
  const auto turned = read_brain_volume(write("turned.nii.gz", axes));
  ASSERT_EQ(turned.image.sizes(), torch::IntArrayRef({4, 5, 3}));
  // Voxel (i, j, k) = 12 k + 3 j + i lies at left 2 - i, superior j, posterior k.
  for (int i = 0; i < 3; ++i)
    for (int j = 0; j < 4; ++j)
      for (int k = 0; k < 5; ++k)
        EXPECT_EQ(turned.image[j][k][2 - i].item<float>(), static_cast<float>(12 * k + 3 * j + i));
}

TEST_F(BrainVolumeFile, LabelsBecomeTissues) {
  std::vector<float> labels(60, 0.F);
  labels[7] = 112.F;
  labels[8] = 113.F;
  labels[9] = 94.F;
  const Eigen::Matrix3d id = Eigen::Matrix3d::Identity();
  const auto image = write("image.nii.gz", id);
  const auto crl = read_brain_volume(image, {}, write("crl.nii.gz", id, labels));
  EXPECT_EQ(crl.labels.flatten()[7].item<int>(), static_cast<int>(Tissue::cortex));
  EXPECT_EQ(crl.labels.flatten()[8].item<int>(), static_cast<int>(Tissue::cortex));
  EXPECT_EQ(crl.labels.flatten()[9].item<int>(), static_cast<int>(Tissue::brainstem));
  labels = std::vector<float>(60, 3.F);
  EXPECT_EQ(read_brain_volume(image, {}, write("own.nii.gz", id, labels)).labels.max().item<int>(), 3);
  labels[0] = 113.F;
  EXPECT_NE(message(image, {}, write("mixed.nii.gz", id, labels)).find("neither"), std::string::npos);
  labels[0] = 0.5F;
  EXPECT_NE(message(image, {}, write("half.nii.gz", id, labels)).find("whole numbers"), std::string::npos);
}

TEST_F(BrainVolumeFile, NamesTheFileThatDoesNotFit) {
  const Eigen::Matrix3d id = Eigen::Matrix3d::Identity();
  const auto image = write("image.nii.gz", id);
  EXPECT_NE(message(image, write("empty.nii.gz", id, std::vector<float>(60, 0.F))).find("empty.nii.gz: shows no brain"),
            std::string::npos);
  const Eigen::Matrix3d half_turn = Eigen::AngleAxisd(M_PI, Eigen::Vector3d::UnitZ()).toRotationMatrix();
  EXPECT_NE(message(image, write("elsewhere.nii.gz", half_turn)).find("elsewhere.nii.gz: lies"), std::string::npos);
  const Eigen::Matrix3d oblique = Eigen::AngleAxisd(0.3, Eigen::Vector3d::UnitZ()).toRotationMatrix();
  EXPECT_NE(message(write("oblique.nii.gz", oblique)).find("oblique"), std::string::npos);
  EXPECT_NE(message(write("flat.nii.gz", id, {}, {2., 2., 3.})).find("no cubes"), std::string::npos);
  EXPECT_NE(message(path("missing.nii.gz")).find("missing.nii.gz"), std::string::npos);
}

}  // namespace
}  // namespace svort
