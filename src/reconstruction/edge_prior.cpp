#include "edge_prior.h"

#include <cmath>
#include <cstdint>
#include <vector>

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

}  // namespace svort
