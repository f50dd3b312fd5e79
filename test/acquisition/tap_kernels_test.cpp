#include "../../src/acquisition/tap_kernels.h"

#include <gtest/gtest.h>

#include <random>
#include <vector>

#include "../../src/acquisition/tap_sampler.h"
#include "svort_ros/acquisition/point_spread_function.h"

namespace svort {
namespace {

#if defined(__x86_64__)
TEST(TapKernels, GiveTheSameBytesOnEveryProcessor) {
  if (!__builtin_cpu_supports("avx2")) GTEST_SKIP() << "this processor has no AVX2";
  const torch::Tensor psf = gaussian_psf({1.25, 1.25, 3.});
  const PsfTaps taps = nonzero_taps(psf.data_ptr<float>(), {psf.size(0), psf.size(1), psf.size(2)});
  const VolumeShape shape{23, 22, 21};
  const float rotation[12] = {.8F, -.6F, 0.F, .3F, .48F, .64F, -.6F, -.2F, .36F, .48F, .8F, .1F};
  const SliceTaps slice(taps, rotation, shape, 20, 20, 1.25);
  std::mt19937 generator(3);
  std::uniform_real_distribution<float> random(0.F, 1.F);
  std::vector<float> volume(static_cast<std::size_t>(shape.voxel_count()));
  for (float& voxel : volume) voxel = random(generator);

  struct Result {
    std::vector<float> centres, sums, weights, scattered, pairs, rows;
    std::vector<double> double_pairs;
  };
  const auto compute = [&](const TapKernels& kernels) {
    Result result;
    result.scattered.resize(volume.size());
    result.pairs.resize(2 * volume.size());
    result.double_pairs.resize(2 * volume.size());
    for (std::uint16_t row = 0; row < 20; ++row) {
      for (const std::uint16_t first : {std::uint16_t{0}, std::uint16_t{6}, std::uint16_t{12}}) {
        std::uint16_t columns[kLanes], rows[kLanes];
        for (std::size_t lane = 0; lane < kLanes; ++lane) {
          columns[lane] = static_cast<std::uint16_t>(first + lane);
          rows[lane] = row;
        }
        PixelBatch batch;
        batch.count = first == 6 ? 5 : kLanes;
        batch.rim = true;
        kernels.place_pixels(slice.plane(), columns, rows, &batch);
        for (std::size_t lane = 0; lane < kLanes; ++lane) {
          const auto centre = slice.centre(columns[lane], row);
          EXPECT_EQ(batch.x[lane], centre[0]);
          EXPECT_EQ(batch.y[lane], centre[1]);
          EXPECT_EQ(batch.z[lane], centre[2]);
        }
        float sums[kLanes], weights[kLanes];
        const float value[kLanes] = {1.F, 2.F, 3.F, -4.F, 5.F, .6F, .7F, 8.F};
        const float scale[kLanes] = {1.F, .5F, 1.F, 1.F, .25F, 1.F, 1.F, 1.F};
        kernels.gather(slice.list(), batch, volume.data(), sums);
        kernels.weigh(slice.list(), batch, weights);
        kernels.scatter(slice.list(), batch, value, result.scattered.data());
        kernels.scatter_pairs(slice.list(), batch, value, scale, result.pairs.data());
        kernels.scatter_double_pairs(slice.list(), batch, value, scale, result.double_pairs.data());
        result.sums.insert(result.sums.end(), sums, sums + kLanes);
        result.weights.insert(result.weights.end(), weights, weights + kLanes);
      }
    }
    result.rows.resize(101);
    const std::vector<const float*> rows = {volume.data(), volume.data() + 7, volume.data() + 201};
    const std::vector<float> factors = {.2F, .5F, .3F};
    kernels.combine_rows(rows.data(), factors.data(), rows.size(), 101, result.rows.data());
    return result;
  };
  const Result baseline = compute(baseline_tap_kernels()), avx2 = compute(avx2_tap_kernels());
  EXPECT_EQ(baseline.sums, avx2.sums);
  EXPECT_EQ(baseline.weights, avx2.weights);
  EXPECT_EQ(baseline.scattered, avx2.scattered);
  EXPECT_EQ(baseline.pairs, avx2.pairs);
  EXPECT_EQ(baseline.double_pairs, avx2.double_pairs);
  EXPECT_EQ(baseline.rows, avx2.rows);
  float total = 0.F;
  for (const float weight : baseline.weights) total += weight;
  EXPECT_GT(total, 100.F) << "some taps are inside";
}
#endif

}  // namespace
}  // namespace svort
