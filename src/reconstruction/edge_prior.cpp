#include "edge_prior.h"

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <utility>
#include <vector>

#include "../acquisition/parallel.h"

namespace svort {

void add_edge_prior_gradient(const torch::Tensor& volume, double edge, double strength, torch::Tensor* gradient) {
  const std::int64_t depth = volume.size(0), height = volume.size(1), width = volume.size(2);
  const float* values = volume.data_ptr<float>();
  float* out = gradient->data_ptr<float>();

  struct Neighbour {
    std::int64_t offset;
    float factor;  // 1 / (distance^2 delta^2)
  };
  std::vector<Neighbour> neighbours;
  for (int dz = -1; dz <= 1; ++dz) {
    for (int dy = -1; dy <= 1; ++dy) {
      for (int dx = -1; dx <= 1; ++dx) {
        const int squared_distance = dx * dx + dy * dy + dz * dz;
        if (squared_distance == 0) continue;
        neighbours.push_back(
            {(dz * height + dy) * width + dx, static_cast<float>(1. / squared_distance / (edge * edge))});
      }
    }
  }
  const auto factor = static_cast<float>(strength);
  for (std::int64_t z = 1; z + 1 < depth; ++z) {
    for (std::int64_t y = 1; y + 1 < height; ++y) {
      // Row by row and neighbour by neighbour: the innermost loop vectorises.
      const std::int64_t row = (z * height + y) * width;
      for (const Neighbour& neighbour : neighbours) {
        for (std::int64_t x = 1; x + 1 < width; ++x) {
          const float difference = values[row + x] - values[row + x + neighbour.offset];
          const float scaled = difference * neighbour.factor;
          out[row + x] += factor * scaled / std::sqrt(1.F + difference * scaled);
        }
      }
    }
  }
}

EdgeWeights::EdgeWeights(const torch::Tensor& volume, const torch::Tensor& known, double edge)
    : depth_(volume.size(0)), height_(volume.size(1)), width_(volume.size(2)) {
  const torch::Tensor contiguous = volume.contiguous(), inside = known.contiguous();
  const float* value = contiguous.data_ptr<float>();
  const bool* in = inside.data_ptr<bool>();
  const auto count = static_cast<std::size_t>(volume.numel());
  const auto inverse = static_cast<float>(1. / edge);
  for (std::vector<float>* weights : {&x_, &y_, &z_}) weights->assign(count, 0.F);
  const std::int64_t plane = height_ * width_;
  const auto weight = [&](std::int64_t i, std::int64_t j) {
    if (!in[i] || !in[j]) return 0.F;
    const float d = (value[i] - value[j]) * inverse;
    return 1.F / std::sqrt(1.F + d * d);
  };
  parallel_chunks(depth_, [&](std::int64_t begin, std::int64_t end) {
    for (std::int64_t z = begin; z < end; ++z)
      for (std::int64_t y = 0; y < height_; ++y)
        for (std::int64_t x = 0; x < width_; ++x) {
          const std::int64_t i = z * plane + y * width_ + x;
          if (!in[i]) continue;
          const auto at = static_cast<std::size_t>(i);
          if (x + 1 < width_) x_[at] = weight(i, i + 1);
          if (y + 1 < height_) y_[at] = weight(i, i + width_);
          if (z + 1 < depth_) z_[at] = weight(i, i + plane);
        }
  });
}

void EdgeWeights::add_laplacian(const torch::Tensor& x, float strength, torch::Tensor* result) const {
  const float* value = x.data_ptr<float>();
  float* out = result->data_ptr<float>();
  const std::int64_t plane = height_ * width_, count = depth_ * plane;
  // Each voxel gathers from its neighbours, so that the order of sums is the same for any number of threads. The last
  // weight along an axis is 0, and what lies before the first voxel is skipped.
  parallel_chunks(depth_, [&](std::int64_t begin, std::int64_t end) {
    for (const auto& [weights, stride] : {std::pair{&x_, std::int64_t{1}}, {&y_, width_}, {&z_, plane}}) {
      const float* weight = weights->data();
      for (std::int64_t i = begin * plane; i < std::min(end * plane, count - stride); ++i)
        out[i] += strength * weight[i] * (value[i] - value[i + stride]);
      for (std::int64_t i = std::max(begin * plane, stride); i < end * plane; ++i)
        out[i] += strength * weight[i - stride] * (value[i] - value[i - stride]);
    }
  });
}

}  // namespace svort
