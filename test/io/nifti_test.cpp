#include "svort_ros/io/nifti.h"

#include <sys/resource.h>

#include <cmath>
#include <csignal>
#include <limits>
#include <numeric>

#include "io/raw_nifti.h"
#include "io/scratch.h"

namespace svort {
namespace {

using Nifti = Scratch;

const std::filesystem::path kRealStack = std::filesystem::path(SVORT_SOURCE_DIR) / "data/real/sub-01_run-1_T2w.nii.gz";

template <class T>
void expect_reads(const std::filesystem::path& file, const std::vector<T>& values) {
  const NiftiImage image = read_nifti(file);
  EXPECT_EQ(image.size, Eigen::Vector3i(2, 1, 2));
  ASSERT_EQ(image.values.size(), values.size());
  for (std::size_t i = 0; i < values.size(); ++i) EXPECT_EQ(image.values[i], static_cast<float>(values[i]));
}

TEST_F(Nifti, ReadsEveryRealTypeOfEitherEndianness) {
  const auto check = [this](std::int16_t code, const auto& values) {
    for (const bool big_endian : {false, true}) {
      SCOPED_TRACE(std::to_string(code) + (big_endian ? " big-endian" : " little-endian"));
      const auto file = write("a.nii", RawNifti(2, 1, 2, code, big_endian).values(values).bytes());
      expect_reads(file, values);
    }
  };
  check(2, std::vector<std::uint8_t>{0, 1, 200, 255});
  check(256, std::vector<std::int8_t>{0, 1, -128, 127});
  check(512, std::vector<std::uint16_t>{0, 1, 40000, 65535});
  check(4, std::vector<std::int16_t>{0, 1, -32768, 32767});
  check(768, std::vector<std::uint32_t>{0, 1, 3000000000U, 7});
  check(8, std::vector<std::int32_t>{0, 1, -2000000000, 7});
  check(1280, std::vector<std::uint64_t>{0, 1, 10000000000000000000U, 7});
  check(1024, std::vector<std::int64_t>{0, 1, -4000000000000000000, 7});
  check(16, std::vector<float>{0.F, 1.5F, -1e30F, 1e-30F});
  check(64, std::vector<double>{0., 1.5, -1e30, 0.1});
}

TEST_F(Nifti, AppliesTheScaling) {
  const std::vector<std::int16_t> values = {0, 1, -2, 100};
  const auto read_scaled = [&](float slope, float inter) {
    return read_nifti(write("a.nii", RawNifti(2, 1, 2, 4).values(values).scaling(slope, inter).bytes())).values;
  };
  EXPECT_EQ(read_scaled(0.5F, 10.F), (std::vector<float>{10.F, 10.5F, 9.F, 60.F}));
  EXPECT_EQ(read_scaled(-1.F, 0.F), (std::vector<float>{0.F, -1.F, 2.F, -100.F}));
  const std::vector<float> plain = {0.F, 1.F, -2.F, 100.F};
  const float nan = std::numeric_limits<float>::quiet_NaN();
  EXPECT_EQ(read_scaled(0.F, 10.F), plain);  // slope 0: the values are not scaled
  EXPECT_EQ(read_scaled(nan, nan), plain);
  EXPECT_EQ(read_scaled(nan, 10.F), plain);
}

/// niftilib's own loader turns these into zeros; a spoilt image must not pass for a good one.
TEST_F(Nifti, KeepsNan) {
  const float nan = std::numeric_limits<float>::quiet_NaN();
  const auto values =
      read_nifti(write("a.nii", RawNifti(2, 1, 2, 16).values<float>({1.F, nan, HUGE_VALF, 2.F}).bytes())).values;
  EXPECT_TRUE(std::isnan(values[1]));
  EXPECT_TRUE(std::isinf(values[2]));
}

TEST_F(Nifti, AffineIsLps) {
  RawNifti raw(2, 1, 2, 2);
  raw.values<std::uint8_t>({0, 0, 0, 0});
  raw.sform({0.F, -2.F, 0.F, 10.F, 1.F, 0.F, 0.F, 20.F, 0.F, 0.F, 3.F, 30.F});
  const NiftiImage image = read_nifti(write("a.nii", raw.bytes()));
  // RAS (10, 20, 30) is LPS (-10, -20, 30).
  EXPECT_TRUE((image.affine_lps * Eigen::Vector3d(0., 0., 0.)).isApprox(Eigen::Vector3d(-10., -20., 30.), 1e-7));
  EXPECT_TRUE((image.affine_lps * Eigen::Vector3d(1., 1., 1.)).isApprox(Eigen::Vector3d(-8., -21., 33.), 1e-7));
  EXPECT_TRUE(image.spacing.isApprox(Eigen::Vector3d(1., 2., 3.), 1e-7));
}

TEST_F(Nifti, SformBeforeQform) {
  RawNifti raw(2, 1, 2, 2);
  raw.values<std::uint8_t>({0, 0, 0, 0});
  raw.put<std::int16_t>(252, 1);                  // qform: half turn about x, qb = 1
  raw.put<float>(256, 1.F).put<float>(268, 7.F);  // quatern_b, qoffset_x
  raw.put<float>(80, 2.F).put<float>(84, 2.F).put<float>(88, 4.F);
  raw.sform({1.F, 0.F, 0.F, 5.F, 0.F, 1.F, 0.F, 0.F, 0.F, 0.F, 1.F, 0.F}, 2);
  NiftiImage image = read_nifti(write("a.nii", raw.bytes()));
  EXPECT_TRUE((image.affine_lps * Eigen::Vector3d(0., 0., 1.)).isApprox(Eigen::Vector3d(-5., 0., 1.), 1e-7));
  raw.put<std::int16_t>(254, 0);
  image = read_nifti(write("a.nii", raw.bytes()));
  EXPECT_TRUE((image.affine_lps * Eigen::Vector3d(1., 1., 1.)).isApprox(Eigen::Vector3d(-9., 2., -4.), 1e-6))
      << image.affine_lps.matrix();
}

TEST_F(Nifti, PlaneIsOneSlice) {
  RawNifti raw(3, 2, 1, 2);
  raw.put<std::int16_t>(40, 2).values<std::uint8_t>({1, 2, 3, 4, 5, 6});
  EXPECT_EQ(read_nifti(write("a.nii", raw.bytes())).size, Eigen::Vector3i(3, 2, 1));
}

/// NIfTI-2 has another, wider header (offsets as in its standard).
TEST_F(Nifti, ReadsNifti2) {
  std::string bytes(544, '\0');
  const auto put = [&bytes](std::size_t offset, auto value) { std::memcpy(&bytes[offset], &value, sizeof(value)); };
  put(0, std::int32_t{540});
  const std::string magic("n+2\0\r\n\x1a\n", 8);
  bytes.replace(4, 8, magic);
  put(12, std::int16_t{4});   // int16
  put(14, std::int16_t{16});  // bits
  const std::array<std::int64_t, 8> dim = {3, 2, 1, 2, 1, 1, 1, 1};
  for (std::size_t i = 0; i < 8; ++i) put(16 + 8 * i, dim[i]);
  for (std::size_t i = 0; i < 8; ++i) put(104 + 8 * i, 1.);
  put(168, std::int64_t{544});
  put(176, 2.);               // scl_slope
  put(348, std::int32_t{1});  // sform_code
  const std::array<double, 12> sform = {1., 0., 0., 10., 0., 2., 0., 20., 0., 0., 3., 30.};
  for (std::size_t i = 0; i < 12; ++i) put(400 + 8 * i, sform[i]);
  put(500, std::int32_t{2});  // mm
  for (const std::int16_t value : std::vector<std::int16_t>{1, -2, 300, 4}) {
    bytes.resize(bytes.size() + 2);
    put(bytes.size() - 2, value);
  }
  const NiftiImage image = read_nifti(write("a.nii", bytes));
  EXPECT_EQ(image.size, Eigen::Vector3i(2, 1, 2));
  EXPECT_EQ(image.values, (std::vector<float>{2.F, -4.F, 600.F, 8.F}));
  EXPECT_TRUE((image.affine_lps * Eigen::Vector3d(1., 0., 1.)).isApprox(Eigen::Vector3d(-11., -20., 33.)));
}

TEST_F(Nifti, NamesFileAndFault) {
  const auto message = [this](const std::string& bytes, const std::string& name = "a.nii") {
    const auto file = write(name, bytes);
    const std::string text = message_of([&] { read_nifti(file); });
    EXPECT_EQ(text.rfind(file.string() + ": ", 0), 0U) << text;
    return text.substr(std::min(text.size(), file.string().size() + 2));
  };
  const auto good = [] { return RawNifti(2, 1, 2, 2).values<std::uint8_t>({0, 0, 0, 0}); };
  EXPECT_NO_THROW(read_nifti(write("a.nii", good().bytes())));
  EXPECT_EQ(message(""), "is not a readable NIfTI file");
  EXPECT_EQ(message("not an image at all"), "is not a readable NIfTI file");
  EXPECT_EQ(message(good().bytes().substr(0, 200)), "is not a readable NIfTI file");
  EXPECT_EQ(message(good().bytes(), "a.img"), "is not named .nii or .nii.gz");
  EXPECT_EQ(message(good().bytes().substr(0, 354)), "the file is truncated: 354 bytes, its header asks for 356");
  EXPECT_EQ(message(good().units(1).bytes()), "lengths are in 'm', must be mm");
  EXPECT_EQ(message(good().put<std::int16_t>(254, 0).bytes()), "the header has neither sform nor qform");
  EXPECT_EQ(message(good().sform({0.F, 0.F, 0.F, 0.F, 0.F, 1.F, 0.F, 0.F, 0.F, 0.F, 1.F, 0.F}).bytes()),
            "the sform is singular or not finite");
  const float nan = std::numeric_limits<float>::quiet_NaN();
  EXPECT_EQ(message(good().sform({nan, 0.F, 0.F, 0.F, 0.F, 1.F, 0.F, 0.F, 0.F, 0.F, 1.F, 0.F}).bytes()),
            "the sform is singular or not finite");
  EXPECT_EQ(message(good().put<std::int16_t>(40, 4).put<std::int16_t>(48, 2).bytes()), "holds 2 volumes, must be one");
  EXPECT_TRUE(contains(message(RawNifti(2, 1, 2, 32).bits(64).bytes()), "voxels of type COMPLEX64 are not supported"));
  EXPECT_TRUE(contains(message(RawNifti(2, 1, 2, 128).bits(24).bytes()), "voxels of type RGB24 are not supported"));
  EXPECT_EQ(message_of([&] { read_nifti(path("none.nii")); }), path("none.nii").string() + ": no such file");
  EXPECT_MESSAGE(read_nifti(path("")), "is not a file");
}

TEST_F(Nifti, SeesTruncatedAndDamagedCompressedFiles) {
  const std::string whole = read(kRealStack);
  ASSERT_GT(whole.size(), 100000U);
  EXPECT_MESSAGE(read_nifti(write("a.nii.gz", whole.substr(0, whole.size() / 2))),
                 path("a.nii.gz").string() + ": the file is truncated or damaged");
  EXPECT_MESSAGE(read_nifti(write("a.nii.gz", whole.substr(0, whole.size() - 12))), "damaged");
  std::string damaged = whole;
  damaged[damaged.size() - 6] = static_cast<char>(damaged[damaged.size() - 6] ^ 1);  // the checksum
  EXPECT_MESSAGE(read_nifti(write("a.nii.gz", damaged)), "damaged");
}

TEST_F(Nifti, ReadsTheBundledScan) {
  const NiftiImage image = read_nifti(kRealStack);
  EXPECT_EQ(image.size, Eigen::Vector3i(320, 320, 22));
  EXPECT_TRUE(image.spacing.isApprox(Eigen::Vector3d(1.125, 1.125, 3.3), 1e-6));
  EXPECT_EQ(image.values.size(), 320U * 320U * 22U);
  // First voxel, from the header: RAS (-190.737, -170.148, -73.497).
  EXPECT_LT((image.affine_lps.translation() - Eigen::Vector3d(190.73688, 170.14845, -73.49743)).norm(), 1e-4);
}

Volume oblique_volume() {
  Volume volume;
  volume.grid.size = {5, 4, 3};
  volume.grid.spacing = {1., 1.5, 2.};
  volume.grid.T_frame_grid =
      Eigen::Translation3d(3., -4., 5.) * Pose(Eigen::AngleAxisd(0.6, Eigen::Vector3d(1., 2., 3.).normalized()));
  volume.values.resize(60);
  std::iota(volume.values.begin(), volume.values.end(), -7.25F);
  return volume;
}

TEST_F(Nifti, WrittenVolumesComeBack) {
  const Volume volume = oblique_volume();
  for (const std::string name : {"a.nii", "a.nii.gz"}) {
    write_nifti(path(name), volume);
    const NiftiImage image = read_nifti(path(name));
    EXPECT_EQ(image.size, volume.grid.size);
    EXPECT_EQ(image.values, volume.values);
    for (const Eigen::Vector3d& index : {Eigen::Vector3d(0., 0., 0.), Eigen::Vector3d(4., 3., 2.)})
      EXPECT_LT((image.affine_lps * index - volume.grid.position(index)).norm(), 1e-5);  // float32 in the header
  }
  EXPECT_EQ(file_count(), 2U);
  EXPECT_EQ(read(path("a.nii")).size(), 352U + 60U * 4U);
  EXPECT_EQ(read(path("a.nii.gz")).substr(0, 2), "\x1f\x8b");
  const std::string once = read(path("a.nii.gz"));
  write_nifti(path("a.nii.gz"), volume);
  EXPECT_EQ(read(path("a.nii.gz")), once) << "not the same bytes for the same volume";
}

/// Programs that only know the qform must see the same place.
TEST_F(Nifti, QformAgreesWithSform) {
  const Volume volume = oblique_volume();
  write_nifti(path("a.nii"), volume);
  std::string bytes = read(path("a.nii"));
  EXPECT_EQ(bytes[252], 2);
  EXPECT_EQ(bytes[254], 2);
  bytes[254] = 0;
  const NiftiImage image = read_nifti(write("q.nii", bytes));
  const Eigen::Vector3d index(4., 3., 2.);
  EXPECT_LT((image.affine_lps * index - volume.grid.position(index)).norm(), 1e-4);
}

TEST_F(Nifti, NamesTheVolumeThatCannotBeWritten) {
  Volume volume = oblique_volume();
  EXPECT_MESSAGE(write_nifti(path("none/a.nii.gz"), volume), path("none/a.nii.gz").string() + ": cannot be written");
  EXPECT_MESSAGE(write_nifti(path("a.mha"), volume), "must be named .nii or .nii.gz");
  volume.values.pop_back();
  EXPECT_MESSAGE(write_nifti(path("a.nii"), volume), "59 values");
  EXPECT_MESSAGE(write_nifti(path("a.nii"), Volume()), "0 values");
  EXPECT_EQ(file_count(), 0U);
}

TEST_F(Nifti, FullDiskLeavesNothing) {
  Volume volume;
  volume.grid.size = {40, 40, 40};
  for (int i = 0; i < 64000; ++i) volume.values.push_back(std::sin(0.37F * static_cast<float>(i % 7919)));
  for (const std::string name : {"a.nii", "a.nii.gz"}) {
    rlimit before{};
    ASSERT_EQ(getrlimit(RLIMIT_FSIZE, &before), 0);
    const auto handler = std::signal(SIGXFSZ, SIG_IGN);
    rlimit small = before;
    small.rlim_cur = 20000;
    ASSERT_EQ(setrlimit(RLIMIT_FSIZE, &small), 0);
    const std::string message = message_of([&] { write_nifti(path(name), volume); });
    ASSERT_EQ(setrlimit(RLIMIT_FSIZE, &before), 0);
    std::signal(SIGXFSZ, handler);
    EXPECT_TRUE(contains(message, path(name).string() + ": cannot write it: ")) << message;
    EXPECT_EQ(file_count(), 0U);
  }
}

}  // namespace
}  // namespace svort
