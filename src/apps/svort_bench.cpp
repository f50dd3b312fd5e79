// Benchmarks of the core, one JSON object per line. `svort_bench forward` measures the acquisition operator,
// `svort_bench network` the pose networks (network_bench.cpp), `svort_bench live` the live pipeline (live_bench.cpp),
// `svort_bench memory` what the pipeline holds on to (memory_bench.cpp).

#include <ATen/Parallel.h>
#include <sys/resource.h>
#include <torch/types.h>

#include <algorithm>
#include <array>
#include <chrono>
#include <cmath>
#include <cstring>
#include <fstream>
#include <functional>
#include <iomanip>
#include <iostream>
#include <limits>
#include <sstream>
#include <stdexcept>
#include <string>
#include <vector>

#include "bench_support.h"
#include "live_bench.h"
#include "memory_bench.h"
#include "network_bench.h"
#include "svort_ros/acquisition/point_spread_function.h"
#include "svort_ros/acquisition/slice_acquisition.h"
#include "svort_ros/geometry/rigid_transform.h"
#include "svort_ros/reconstruction/volume_estimation.h"

namespace {

using svort::AcquisitionFormulation;
using svort::AcquisitionGeometry;
using svort::peak_memory_mb;
using svort::positive_integers;
using svort::processor;
using svort::SliceAcquisition;

constexpr const char* kUsage =
    "usage: svort_bench forward [--slices N,..] [--threads N,..] [--repetitions N] [--thickness VOXELS]\n"
    "                           [--pixel VOXELS] [--volume D,H,W] [--plain yes|no] [--table yes|no]\n"
    "Times the acquisition operator on 128 x 128 pixel slices and prints one JSON object per line.\n"
    "  --slices       numbers of slices, default 21,60,120,450\n"
    "  --threads      numbers of threads, default 1,2\n"
    "  --repetitions  the best of so many runs counts, default 5\n"
    "  --thickness    slice thickness in voxels, default 3.75\n"
    "  --pixel        slice pixel in voxels, default 1.25\n"
    "  --volume       size in voxels, default 100,112,96\n"
    "  --plain        also time the plain loop over taps that the others are compared with, default yes\n"
    "  --table        print the tables of docs/performance.md instead, the JSON objects to the standard error;\n"
    "                 adds other thicknesses and volumes at the second number of slices, default no\n";

struct UsageError : std::runtime_error {
  using std::runtime_error::runtime_error;
};

struct Options {
  std::vector<std::int64_t> slices = {21, 60, 120, 450};
  std::vector<std::int64_t> threads = {1, 2};
  std::int64_t repetitions = 5;
  double thickness = 3.75;
  double pixel = 1.25;
  std::vector<std::int64_t> volume = {100, 112, 96};
  bool plain = true;
  bool table = false;
};

constexpr int kSize = 128;  // pixels along each side of a slice

Options parse(const std::vector<std::string>& arguments) {
  if (arguments.empty() || arguments[0] != "forward")
    throw UsageError("the first argument must be forward, network, live or memory");
  Options options;
  for (std::size_t i = 1; i < arguments.size(); i += 2) {
    const std::string& name = arguments[i];
    if (i + 1 == arguments.size()) throw UsageError(name + " is unknown or needs a value");
    const std::string& value = arguments[i + 1];
    if (name == "--slices") {
      options.slices = positive_integers(name, value, 5000);
    } else if (name == "--threads") {
      options.threads = positive_integers(name, value, 1024);
    } else if (name == "--repetitions") {
      options.repetitions = positive_integers(name, value, 1000).front();
    } else if (name == "--volume") {
      options.volume = positive_integers(name, value, 1024);
      if (options.volume.size() != 3) throw UsageError("--volume takes three integers, got '" + value + "'");
    } else if (name == "--thickness" || name == "--pixel") {
      double& number = name == "--pixel" ? options.pixel : options.thickness;
      std::istringstream text(value);
      if (!(text >> number) || !text.eof() || !(number >= 0.5 && number <= 20.)) {
        throw UsageError(name + " takes a number from 0.5 to 20, got '" + value + "'");
      }
    } else if (name == "--plain" || name == "--table") {
      if (value != "yes" && value != "no") throw UsageError(name + " takes yes or no, got '" + value + "'");
      (name == "--plain" ? options.plain : options.table) = value == "yes";
    } else {
      throw UsageError(name + " is unknown");
    }
  }
  return options;
}

double best_ms(std::int64_t repetitions, const std::function<void()>& call) {
  double best = std::numeric_limits<double>::infinity();
  for (std::int64_t i = 0; i < repetitions; ++i) {
    const auto start = std::chrono::steady_clock::now();
    call();
    best = std::min(best, std::chrono::duration<double, std::milli>(std::chrono::steady_clock::now() - start).count());
  }
  return best;
}

// Bytes read and written by a plain copy of an array too large for any cache, per second, one thread.
double copy_gb_per_s() {
  const std::vector<char> from(std::size_t{256} << 20, 1);
  std::vector<char> to(from.size());
  const double ms = best_ms(5, [&] { std::memcpy(to.data(), from.data(), from.size()); });
  return 2. * static_cast<double>(from.size()) / ms / 1e6;
}

void reset_peak_memory() {
  std::ofstream file("/proc/self/clear_refs");
  file << "5" << std::flush;
  if (!file) throw std::runtime_error("/proc/self/clear_refs cannot be written: no peak memory per configuration");
}

// Three orthogonal stacks whose head moved a little, slices about one voxel apart.
AcquisitionGeometry moved_stacks(std::int64_t slices, double pixel, double thickness) {
  torch::manual_seed(1);
  torch::Tensor axisangle = torch::randn({slices, 6}) * torch::tensor({.2, .2, .2, 3., 3., 0.}).to(torch::kFloat32);
  const std::int64_t per_stack = (slices + 2) / 3;
  for (std::int64_t i = 0; i < slices; ++i) {
    const std::int64_t stack = i / per_stack;
    if (stack > 0) axisangle[i][stack - 1] += M_PI / 2.;
    const double spread = 70. / static_cast<double>(per_stack);  // voxels: the brain's extent
    axisangle[i][5] = (static_cast<double>(i % per_stack) - static_cast<double>(per_stack - 1) / 2.) * spread;
  }
  AcquisitionGeometry geometry;
  geometry.transforms = svort::axisangle_to_matrix(axisangle).contiguous();
  geometry.psf = svort::gaussian_psf({pixel, pixel, thickness});
  geometry.resolution_ratio = pixel;
  return geometry;
}

// The yardstick: one thread, one loop over pixels, one over taps, eight voxels each, nothing shared or skipped.
class PlainLoop {
 public:
  PlainLoop(const AcquisitionGeometry& geometry, const std::vector<std::int64_t>& shape)
      : transforms_(geometry.transforms),
        ratio_(static_cast<float>(geometry.resolution_ratio)),
        shape_{shape[0], shape[1], shape[2]} {
    const auto psf = geometry.psf.accessor<float, 3>();
    for (std::int64_t z = 0; z < psf.size(0); ++z) {
      for (std::int64_t y = 0; y < psf.size(1); ++y) {
        for (std::int64_t x = 0; x < psf.size(2); ++x) {
          if (psf[z][y][x] == 0.F) continue;
          taps_.push_back({static_cast<float>(x - psf.size(2) / 2), static_cast<float>(y - psf.size(1) / 2),
                           static_cast<float>(z - psf.size(0) / 2), psf[z][y][x]});
        }
      }
    }
  }

  std::size_t tap_count() const { return taps_.size(); }

  torch::Tensor forward(const torch::Tensor& volume) const {
    torch::Tensor slices = torch::zeros({transforms_.size(0), 1, kSize, kSize});
    float* out = slices.data_ptr<float>();
    const float* v = volume.data_ptr<float>();
    for_each_pixel([&](std::int64_t pixel, const float* m, float x, float y) {
      float sum = 0.F, weight = 0.F;
      for_each_tap(m, x, y, [&](float value, std::int64_t cell, float wx, float wy, float wz) {
        float sample = 0.F;
        for (int corner = 0; corner < 8; ++corner) sample += share(corner, wx, wy, wz) * v[cell + offset(corner)];
        sum += value * sample;
        weight += value;
      });
      if (weight > 0.F) out[pixel] = sum / weight;
    });
    return slices;
  }

  torch::Tensor adjoint(const torch::Tensor& slices) const {
    torch::Tensor volume = torch::zeros({shape_[0], shape_[1], shape_[2]});
    const float* in = slices.data_ptr<float>();
    float* v = volume.data_ptr<float>();
    for_each_pixel([&](std::int64_t pixel, const float* m, float x, float y) {
      float weight = 0.F;
      for_each_tap(m, x, y, [&](float value, std::int64_t, float, float, float) { weight += value; });
      if (weight < 0.5F) return;
      const float pixel_value = in[pixel] / weight;
      for_each_tap(m, x, y, [&](float value, std::int64_t cell, float wx, float wy, float wz) {
        for (int corner = 0; corner < 8; ++corner) {
          v[cell + offset(corner)] += pixel_value * value * share(corner, wx, wy, wz);
        }
      });
    });
    return volume;
  }

 private:
  struct Tap {
    float x, y, z, value;
  };
  static float share(int corner, float wx, float wy, float wz) {
    return ((corner & 1) != 0 ? wx : 1.F - wx) * ((corner & 2) != 0 ? wy : 1.F - wy) *
           ((corner & 4) != 0 ? wz : 1.F - wz);
  }
  std::int64_t offset(int corner) const {
    return (corner & 1) + ((corner >> 1) & 1) * shape_[2] + ((corner >> 2) & 1) * shape_[1] * shape_[2];
  }
  template <class Visit>
  void for_each_pixel(const Visit& visit) const {
    const float* matrices = transforms_.data_ptr<float>();
    for (std::int64_t slice = 0; slice < transforms_.size(0); ++slice) {
      for (int row = 0; row < kSize; ++row) {
        for (int column = 0; column < kSize; ++column) {
          visit((slice * kSize + row) * kSize + column, matrices + 12 * slice,
                ratio_ * (static_cast<float>(column) - (kSize - 1) / 2.F),
                ratio_ * (static_cast<float>(row) - (kSize - 1) / 2.F));
        }
      }
    }
  }
  template <class Visit>
  void for_each_tap(const float* m, float column, float row, const Visit& visit) const {
    for (const Tap& tap : taps_) {
      const float x = column + tap.x + m[3], y = row + tap.y + m[7], z = tap.z + m[11];
      const float px = m[0] * x + m[1] * y + m[2] * z + static_cast<float>(shape_[2] - 1) / 2.F;
      const float py = m[4] * x + m[5] * y + m[6] * z + static_cast<float>(shape_[1] - 1) / 2.F;
      const float pz = m[8] * x + m[9] * y + m[10] * z + static_cast<float>(shape_[0] - 1) / 2.F;
      const float fx = std::floor(px), fy = std::floor(py), fz = std::floor(pz);
      const auto ix = static_cast<std::int64_t>(fx), iy = static_cast<std::int64_t>(fy),
                 iz = static_cast<std::int64_t>(fz);
      if (ix < 0 || iy < 0 || iz < 0 || ix + 1 >= shape_[2] || iy + 1 >= shape_[1] || iz + 1 >= shape_[0]) continue;
      visit(tap.value, (iz * shape_[1] + iy) * shape_[2] + ix, px - fx, py - fy, pz - fz);
    }
  }

  torch::Tensor transforms_;
  float ratio_;
  std::array<std::int64_t, 3> shape_;
  std::vector<Tap> taps_;
};

// An ellipsoid as large as a brain, with folds and a soft edge, in a volume that is empty around it.
torch::Tensor test_volume(const std::vector<std::int64_t>& shape) {
  const auto axis = [](std::int64_t count) { return torch::arange(count) - static_cast<double>(count - 1) / 2.; };
  const torch::Tensor z = axis(shape[0]).view({-1, 1, 1}), y = axis(shape[1]).view({1, -1, 1}),
                      x = axis(shape[2]).view({1, 1, -1});
  const torch::Tensor radius = torch::sqrt((x / 36.).square() + (y / 45.).square() + (z / 36.).square());
  const torch::Tensor folds = 1. + 0.3 * torch::sin(0.5 * x + 0.2 * y) * torch::cos(0.4 * z - 0.15 * x);
  return (folds * torch::sigmoid((1. - radius) * 40.)).masked_fill(radius > 1.15, 0.).to(torch::kFloat32).contiguous();
}

double relative_l2(const torch::Tensor& a, const torch::Tensor& b) {
  return ((a - b).norm() / b.norm()).item<double>();
}

struct Timing {
  double forward_ms = 0., adjoint_ms = 0., equalized_ms = 0., iteration_ms = 0.;
};

// One line of a table.
struct Row {
  std::string formulation;
  std::int64_t slices = 0, threads = 1;
  double thickness = 0.;
  std::vector<std::int64_t> volume;
  std::size_t taps = 0;
  Timing time, plain;  // plain: of the same slices; 0 if it was not measured
  double over_copy = 0., peak_mb = 0.;
};

// Times all formulations and numbers of threads for `n` slices; one JSON object per line to `log`.
std::vector<Row> measure(const Options& options, std::int64_t n, double bandwidth, std::ostream& log) {
  const torch::NoGradGuard no_grad;
  const std::array<std::int64_t, 3> shape = {options.volume[0], options.volume[1], options.volume[2]};
  const double voxels = static_cast<double>(shape[0] * shape[1] * shape[2]);
  const torch::Tensor volume = test_volume(options.volume);
  const AcquisitionGeometry geometry = moved_stacks(n, options.pixel, options.thickness);
  const PlainLoop plain(geometry, options.volume);
  const double pixels = static_cast<double>(n) * kSize * kSize;
  std::vector<Row> rows;
  Row row;
  row.slices = n;
  row.thickness = options.thickness;
  row.volume = options.volume;
  row.taps = plain.tap_count();
  torch::Tensor plain_slices, plain_adjoint;
  const auto head = [&] {
    std::ostringstream line;
    line << R"({"benchmark": "forward", "formulation": ")" << row.formulation << R"(", "slices": )" << n
         << R"(, "pixels": [128, 128], "pixel_voxels": )" << options.pixel << R"(, "volume": [)" << shape[0] << ", "
         << shape[1] << ", " << shape[2] << R"(], "thickness_voxels": )" << options.thickness << R"(, "psf_taps": )"
         << row.taps << R"(, "threads": )" << row.threads;
    return line.str();
  };
  // Voxels of the cells that all taps of the PSF would read, whatever the formulation: work done per second.
  const auto gigabytes = [&](double ms) {
    return pixels * static_cast<double>(row.taps) * 8. * sizeof(float) / ms / 1e6;
  };
  if (options.plain) {
    // Long enough to need no repetition.
    row.formulation = "plain";
    row.time.forward_ms = best_ms(1, [&] { plain_slices = plain.forward(volume); });
    row.time.adjoint_ms = best_ms(1, [&] { plain_adjoint = plain.adjoint(plain_slices); });
    row.time.iteration_ms = row.time.forward_ms + row.time.adjoint_ms;  // without its vector operations
    row.plain = row.time;
    log << head() << R"(, "forward_ms": )" << row.time.forward_ms << R"(, "adjoint_ms": )" << row.time.adjoint_ms
        << R"(, "cg_iteration_ms": )" << row.time.iteration_ms << R"(, "forward_gb_per_s": )"
        << gigabytes(row.time.forward_ms) << "}" << std::endl;
    rows.push_back(row);
  }
  for (const AcquisitionFormulation formulation : {AcquisitionFormulation::exact, AcquisitionFormulation::fast}) {
    for (const std::int64_t threads : options.threads) {
      at::set_num_threads(static_cast<int>(threads));
      reset_peak_memory();
      row.formulation = svort::to_string(formulation);
      row.threads = threads;
      const double setup_ms = best_ms(options.repetitions,
                                      [&] { const SliceAcquisition once(geometry, kSize, kSize, shape, formulation); });
      const SliceAcquisition acquisition(geometry, kSize, kSize, shape, formulation);
      Timing& time = row.time;
      torch::Tensor slices, back, equalized;
      time.forward_ms = best_ms(options.repetitions, [&] { slices = acquisition.forward(volume); });
      time.adjoint_ms = best_ms(options.repetitions, [&] { back = acquisition.adjoint(slices, false); });
      time.equalized_ms = best_ms(options.repetitions, [&] { equalized = acquisition.adjoint(slices, true); });
      // Differences of two solves: the start costs one more application and the right side.
      const auto solve = [&](int iterations) {
        svort::ConjugateGradientOptions cg;
        cg.iterations = iterations;
        return best_ms(std::max<std::int64_t>(1, options.repetitions / 2),
                       [&] { svort::solve_weighted_inverse(slices, acquisition, {}, equalized, cg); });
      };
      time.iteration_ms = (solve(4) - solve(0)) / 4.;
      // The least that memory allows: the volume read, the slices written, once each.
      row.over_copy = time.forward_ms / ((voxels + pixels) * sizeof(float) / bandwidth / 1e6);
      row.peak_mb = peak_memory_mb();
      log << head() << R"(, "setup_ms": )" << setup_ms << R"(, "forward_ms": )" << time.forward_ms
          << R"(, "adjoint_ms": )" << time.adjoint_ms << R"(, "equalized_adjoint_ms": )" << time.equalized_ms
          << R"(, "cg_iteration_ms": )" << time.iteration_ms << R"(, "forward_gb_per_s": )"
          << gigabytes(time.forward_ms) << R"(, "copy_gb_per_s": )" << bandwidth << R"(, "forward_over_copy_time": )"
          << row.over_copy << R"(, "peak_memory_mb": )" << row.peak_mb;
      if (options.plain) {
        log << R"(, "forward_speedup": )" << row.plain.forward_ms / time.forward_ms << R"(, "adjoint_speedup": )"
            << row.plain.adjoint_ms / time.adjoint_ms << R"(, "cg_iteration_speedup": )"
            << row.plain.iteration_ms / time.iteration_ms << R"(, "forward_error": )"
            << relative_l2(slices, plain_slices) << R"(, "adjoint_error": )" << relative_l2(back, plain_adjoint);
      }
      log << "}" << std::endl;
      rows.push_back(row);
    }
  }
  return rows;
}

// Markdown. @param with_size whether thickness and volume differ from row to row
void print_table(const std::vector<Row>& rows, bool with_size, std::ostream& out) {
  const auto number = [](double value) {
    std::ostringstream text;
    text << std::fixed << std::setprecision(value < 10. ? 1 : 0) << value;
    return text.str();
  };
  const auto cell = [&](double ms, double plain_ms) {
    return plain_ms > 0. && ms != plain_ms ? number(ms) + " (" + number(plain_ms / ms) + ")" : number(ms);
  };
  out << (with_size ? "| thickness | volume | taps | threads | formulation" : "| slices | threads | formulation")
      << " | A, ms | adjoint, ms | CG step, ms | A over copy | peak, MB |\n"
      << (with_size ? "|---|---" : "") << "|---|---|---|---|---|---|---|---|\n";
  for (const Row& row : rows) {
    if (with_size) {
      out << "| " << row.thickness << " | " << row.volume[0] << " x " << row.volume[1] << " x " << row.volume[2]
          << " | " << row.taps;
    } else {
      out << "| " << row.slices;
    }
    out << " | " << row.threads << " | " << row.formulation << " | " << cell(row.time.forward_ms, row.plain.forward_ms)
        << " | " << cell(row.time.adjoint_ms, row.plain.adjoint_ms) << " | "
        << cell(row.time.iteration_ms, row.plain.iteration_ms) << " | "
        << (row.over_copy > 0. ? number(row.over_copy) : "-") << " | " << (row.peak_mb > 0. ? number(row.peak_mb) : "-")
        << " |\n";
  }
}

void run(const Options& options) {
  const double bandwidth = copy_gb_per_s();
  std::ostream& log = options.table ? std::cerr : std::cout;
  std::vector<Row> by_slices;
  for (const std::int64_t n : options.slices) {
    const std::vector<Row> rows = measure(options, n, bandwidth, log);
    by_slices.insert(by_slices.end(), rows.begin(), rows.end());
  }
  if (!options.table) return;
  const std::int64_t n = options.slices[std::min<std::size_t>(1, options.slices.size() - 1)];
  std::vector<Row> by_size;
  const auto add = [&](const Options& changed) {
    const std::vector<Row> rows = measure(changed, n, bandwidth, log);
    by_size.insert(by_size.end(), rows.begin(), rows.end());
  };
  Options changed = options;
  changed.plain = false;
  for (const double thickness : {1., 2., 3.75, 5., 8.}) {
    changed.thickness = thickness;
    add(changed);
  }
  changed.thickness = options.thickness;
  for (const std::int64_t percent : {50, 75, 150}) {
    for (std::size_t axis = 0; axis < 3; ++axis) {
      changed.volume[axis] = std::max<std::int64_t>(1, options.volume[axis] * percent / 100);
    }
    add(changed);
  }
  std::cout
      << processor() << ", a plain copy moves " << std::fixed << std::setprecision(1) << bandwidth
      << " GB/s. In brackets: times faster than the plain loop of the same slices. \"A over copy\": times what it\n"
      << "takes to read the volume and write the slices once at that rate.\n\n"
      << std::defaultfloat << std::setprecision(6);
  print_table(by_slices, /*with_size=*/false, std::cout);
  std::cout << "\n" << n << " slices:\n\n";
  print_table(by_size, /*with_size=*/true, std::cout);
}

std::string usage() {
  return std::string(kUsage) + svort::kNetworkBenchUsage + svort::kLiveBenchUsage + svort::kMemoryBenchUsage;
}

}  // namespace

int main(int argc, char** argv) {
  const std::vector<std::string> arguments(argv + 1, argv + argc);
  if (arguments.size() == 1 && (arguments[0] == "--help" || arguments[0] == "-h")) {
    std::cout << usage();
    return 0;
  }
  try {
    if (!arguments.empty() && arguments[0] == "network")
      svort::run_network_bench({arguments.begin() + 1, arguments.end()});
    else if (!arguments.empty() && arguments[0] == "live")
      svort::run_live_bench({arguments.begin() + 1, arguments.end()});
    else if (!arguments.empty() && arguments[0] == "memory")
      svort::run_memory_bench({arguments.begin() + 1, arguments.end()});
    else
      run(parse(arguments));
  } catch (const UsageError& error) {
    std::cerr << "svort_bench: " << error.what() << "\n" << usage();
    return 2;
  } catch (const std::invalid_argument& error) {
    std::cerr << "svort_bench: " << error.what() << "\n";
    return 2;
  } catch (const std::exception& error) {
    std::cerr << "svort_bench: " << error.what() << "\n";
    return 1;
  }
  return 0;
}
