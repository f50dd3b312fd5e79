#include "svort_ros/simulation/scan_simulator.h"

#include <ATen/Context.h>
#include <torch/types.h>

#include <algorithm>
#include <array>
#include <cmath>
#include <sstream>
#include <stdexcept>

#include "purposes.h"
#include "svort_ros/acquisition/point_spread_function.h"
#include "svort_ros/acquisition/slice_acquisition.h"
#include "svort_ros/geometry/rigid_transform.h"

namespace svort {
namespace {

using torch::indexing::Slice;

void require(bool ok, const char* option, double value, const char* limit) {
  if (ok) return;
  std::ostringstream text;
  text << "simulator." << option << " is " << value << ", must be " << limit;
  throw std::invalid_argument(text.str());
}

/// Everything about one scan but its pixels.
struct Draft {
  std::uint64_t number = 0;
  std::string motion;
  const Anatomy* anatomy = nullptr;
  std::size_t block = 0;  ///< its brain's place in the batch's volume
  ScanPlan plan;
  ScanArtifacts artifacts;
  std::size_t first = 0;  ///< its first row in the batch
};

Pose in_plane_shift(double x, double y) {
  Pose pose = Pose::Identity();
  pose.translation() << x, y, 0.;
  return pose;
}

/// Rows of n x 12 trans_first matrices, translations multiplied by `scale`.
void put_pose(const Pose& pose, double scale, float* row) {
  const TransFirst matrix = trans_first_from_pose(pose);
  for (int i = 0; i < 3; ++i)
    for (int j = 0; j < 4; ++j) row[4 * i + j] = static_cast<float>(matrix(i, j) * (j == 3 ? scale : 1.));
}

/// The brains of a batch, one above the other in one array, so that one forward model serves all scans.
class StackedVolumes {
 public:
  StackedVolumes(const std::vector<const Anatomy*>& anatomies, const NetworkGrid& grid) : grid_(grid) {
    // One box for all: the union of the brains, and the reach of a voxel's interpolation.
    constexpr double kMargin = 3.;
    for (std::size_t a = 0; a < 3; ++a) {
      const auto axis = static_cast<int>(a);
      const std::int64_t size = grid.volume_shape[2 - a];
      double low = static_cast<double>(size), high = 0.;
      for (const Anatomy* anatomy : anatomies) {
        const double middle = anatomy->extent.centre[axis] / grid.resolution_mm + 0.5 * static_cast<double>(size - 1);
        const double half = anatomy->extent.half_size[axis] / grid.resolution_mm;
        low = std::min(low, middle - half);
        high = std::max(high, middle + half);
      }
      first_[a] = std::clamp<std::int64_t>(static_cast<std::int64_t>(std::floor(low - kMargin)), 0, size - 1);
      const auto last =
          std::clamp<std::int64_t>(static_cast<std::int64_t>(std::ceil(high + kMargin)), first_[a], size - 1);
      count_[a] = last - first_[a] + 1;
    }
    pitch_ = count_[2] + kGap;
    blocks_ = static_cast<std::int64_t>(anatomies.size());
    shape_ = {blocks_ * pitch_, count_[1], count_[0]};
    image = torch::zeros({shape_[0], shape_[1], shape_[2]}, anatomies[0]->image.options());
    mask = torch::zeros({shape_[0], shape_[1], shape_[2]}, anatomies[0]->mask.options());
    for (std::int64_t block = 0; block < blocks_; ++block) {
      const Anatomy& anatomy = *anatomies[static_cast<std::size_t>(block)];
      const auto box = [&](const torch::Tensor& volume) {
        return volume.narrow(0, first_[2], count_[2]).narrow(1, first_[1], count_[1]).narrow(2, first_[0], count_[0]);
      };
      image.narrow(0, block * pitch_, count_[2]).copy_(box(anatomy.image));
      mask.narrow(0, block * pitch_, count_[2]).copy_(box(anatomy.mask));
    }
  }

  const std::array<std::int64_t, 3>& shape() const { return shape_; }

  /// A pose in the canonical frame (mm) as one in this array's frame (voxels), for the brain in `block`.
  Pose voxel_pose(const Pose& T_brain_slice, std::size_t block) const {
    Pose pose = T_brain_slice;
    pose.translation() /= grid_.resolution_mm;
    for (std::size_t a = 0; a < 3; ++a) {
      const double whole_middle = 0.5 * static_cast<double>(grid_.volume_shape[2 - a] - 1);
      const double here = a == 2 ? static_cast<double>(static_cast<std::int64_t>(block) * pitch_) : 0.;
      const double own_middle = 0.5 * static_cast<double>(shape_[2 - a] - 1);
      pose.translation()[static_cast<int>(a)] += whole_middle - static_cast<double>(first_[a]) + here - own_middle;
    }
    return pose;
  }

  /// Ends of a brain's box along x, y, z in this array's frame, voxels.
  std::array<std::array<double, 2>, 3> limits(std::size_t block) const {
    std::array<std::array<double, 2>, 3> result{};
    for (std::size_t a = 0; a < 3; ++a) {
      const double begin = a == 2 ? static_cast<double>(static_cast<std::int64_t>(block) * pitch_) : 0.;
      const double middle = 0.5 * static_cast<double>(shape_[2 - a] - 1);
      result[a] = {begin - middle, begin + static_cast<double>(count_[a] - 1) - middle};
    }
    return result;
  }

  torch::Tensor image, mask;

 private:
  static constexpr std::int64_t kGap = 8;  ///< no pixel in one brain's box has taps in the next
  NetworkGrid grid_;
  std::array<std::int64_t, 3> first_{}, count_{};  // x, y, z
  std::int64_t pitch_ = 0, blocks_ = 0;
  std::array<std::int64_t, 3> shape_{};
};

/// Moves images by whole pixels: out(row, column) = in(row + dy, column + dx), 0 beyond the border.
torch::Tensor shift_pixels(const torch::Tensor& images, const torch::Tensor& dx, const torch::Tensor& dy) {
  const std::int64_t n = images.size(0), height = images.size(2), width = images.size(3);
  const torch::Tensor column = torch::arange(width, dx.options()) + dx.view({n, 1, 1, 1});
  const torch::Tensor row = torch::arange(height, dy.options()).view({1, 1, height, 1}) + dy.view({n, 1, 1, 1});
  const torch::Tensor inside = (column >= 0) & (column < width) & (row >= 0) & (row < height);
  const torch::Tensor along = images.gather(3, column.clamp(0, width - 1).expand({n, 1, height, width}));
  return along.gather(2, row.clamp(0, height - 1).expand({n, 1, height, width})) * inside;
}

/// A random generator of the device, apart from its default one.
torch::Generator make_generator(torch::Device device) { return at::globalContext().defaultGenerator(device).clone(); }

}  // namespace

ScanSimulator::ScanSimulator(const std::vector<BrainVolume>& volumes, const NetworkGrid& grid,
                             const SimulatorOptions& options, std::uint64_t seed, torch::Device device)
    : grid_(grid), options_(options), seed_(seed), device_(device), source_(volumes, grid, options.anatomy, device) {
  check(options.scanner);
  check(options.artifacts);
  if (options.motion != "mixed") motion_class(options.motion);
  acquisition_formulation(options.formulation);
  require(options.size_px >= 8 && options.size_px <= 4096, "size_px", options.size_px, "in 8 .. 4096");
  require(options.resolution_mm > 0. && options.resolution_mm <= 100., "resolution_mm", options.resolution_mm,
          "positive and at most 100");
  require(options.min_brain_mm2 > 0., "min_brain_mm2", options.min_brain_mm2, "positive");
  require(options.anatomies >= 1, "anatomies", options.anatomies, "at least 1");
  require(options.scans_per_anatomy >= 1, "scans_per_anatomy", options.scans_per_anatomy, "at least 1");
}

// Brains are used side by side, so that neighbouring scans differ, and are replaced together.
std::uint64_t ScanSimulator::anatomy_number(std::uint64_t scan) const {
  const auto side_by_side = static_cast<std::uint64_t>(options_.anatomies);
  const std::uint64_t generation = scan / (side_by_side * static_cast<std::uint64_t>(options_.scans_per_anatomy));
  return generation * side_by_side + scan % side_by_side;
}

const Anatomy& ScanSimulator::anatomy_of(std::uint64_t number) {
  auto found = anatomies_.find(number);
  if (found == anatomies_.end()) found = anatomies_.emplace(number, source_.make(seed_, number)).first;
  return found->second;
}

std::vector<SimulatedScan> ScanSimulator::simulate(std::uint64_t first, int count) {
  const torch::NoGradGuard no_grad;
  require(count >= 1, "count", count, "at least 1");

  // 1. Brains, plans and artifacts, scan by scan.
  std::vector<std::uint64_t> numbers;
  for (int i = 0; i < count; ++i) numbers.push_back(anatomy_number(first + static_cast<std::uint64_t>(i)));
  std::vector<std::uint64_t> used = numbers;
  std::sort(used.begin(), used.end());
  used.erase(std::unique(used.begin(), used.end()), used.end());
  for (auto it = anatomies_.begin(); it != anatomies_.end();) {
    const bool current = it->first + static_cast<std::uint64_t>(options_.anatomies) > used.front();
    it = current && it->first <= used.back() ? std::next(it) : anatomies_.erase(it);
  }
  std::vector<const Anatomy*> brains;
  for (const std::uint64_t number : used) brains.push_back(&anatomy_of(number));
  const StackedVolumes volumes(brains, grid_);

  std::vector<Draft> drafts(static_cast<std::size_t>(count));
  std::size_t total = 0;
  for (std::size_t i = 0; i < drafts.size(); ++i) {
    Draft& draft = drafts[i];
    draft.number = first + i;
    draft.block = static_cast<std::size_t>(std::lower_bound(used.begin(), used.end(), numbers[i]) - used.begin());
    draft.anatomy = brains[draft.block];
    draft.motion = options_.motion;
    if (draft.motion == "mixed")
      draft.motion = motion_classes()[static_cast<std::size_t>(
          RandomStream(seed_, draft.number, purpose::kMotionClass).integer(1, 3))];
    draft.plan = plan_scan(options_.scanner, motion_class(draft.motion), draft.anatomy->extent, seed_, draft.number);
    draft.artifacts = draw_artifacts(options_.artifacts, draft.plan, seed_, draft.number);
    draft.first = total;
    total += draft.plan.acquired.size();
  }
  const auto rows = static_cast<std::int64_t>(total);

  // 2. Clean slices: as the scanner makes them, or, prepared, around the brain.
  const double pixel = options_.resolution_mm;
  const std::int64_t size = options_.size_px;
  std::vector<float> voxel_poses(total * 12);
  std::vector<std::int64_t> psf_of_slice(total);
  std::vector<float> brain_centres(total * 2);  // in the slice, mm
  std::vector<float> cuts(total * 3), erosions(total);
  std::vector<float> reach(total * 6);  // of the brain's box from the slice's centre, voxels
  std::vector<torch::Tensor> psfs;
  for (std::size_t i = 0; i < drafts.size(); ++i) {
    Draft& draft = drafts[i];
    const double ratio = pixel / grid_.resolution_mm;
    psfs.push_back(gaussian_psf({ratio, ratio, draft.plan.thickness_mm / grid_.resolution_mm}));
    for (std::size_t k = 0; k < draft.plan.acquired.size(); ++k) {
      PlannedSlice& slice = draft.plan.acquired[k];
      const auto centre_in_slice = [&] {
        return Eigen::Vector3d(slice.T_brain_slice().inverse() * draft.anatomy->extent.centre);
      };
      if (options_.prepared) {
        const Eigen::Vector3d centre = centre_in_slice();
        const Pose crop =
            in_plane_shift(std::round(centre.x() / pixel) * pixel, std::round(centre.y() / pixel) * pixel);
        slice.T_scanner_slice = slice.T_scanner_slice * crop;
        slice.T_stack_slice = slice.T_stack_slice * crop;
      }
      const std::size_t row = draft.first + k;
      const Pose voxel_pose = volumes.voxel_pose(slice.T_brain_slice(), draft.block);
      put_pose(voxel_pose, 1., &voxel_poses[12 * row]);
      const auto limits = volumes.limits(draft.block);
      for (std::size_t a = 0; a < 3; ++a)
        for (std::size_t side = 0; side < 2; ++side)
          reach[6 * row + 2 * a + side] =
              static_cast<float>(limits[a][side] - voxel_pose.translation()[static_cast<int>(a)]);
      psf_of_slice[row] = static_cast<std::int64_t>(i);
      const Eigen::Vector3d centre = centre_in_slice();
      brain_centres[2 * row] = static_cast<float>(centre.x());
      brain_centres[2 * row + 1] = static_cast<float>(centre.y());
      const SliceArtifacts& artifacts = draft.artifacts.slices[k];
      const Eigen::Vector2d normal = artifacts.mask_cut ? artifacts.cut_normal : Eigen::Vector2d::Zero();
      cuts[3 * row] = static_cast<float>(normal.x());
      cuts[3 * row + 1] = static_cast<float>(normal.y());
      cuts[3 * row + 2] = static_cast<float>(artifacts.cut_offset + normal.dot(centre.head<2>()));
      if (!artifacts.mask_cut) cuts[3 * row + 2] = 1.F;
      erosions[row] = static_cast<float>(artifacts.erosion_mm / pixel);
    }
  }
  const auto floats = [&](const std::vector<float>& values, std::vector<std::int64_t> shape) {
    return torch::tensor(values, torch::kFloat32).view(shape).to(device_);
  };
  const auto float_options = torch::TensorOptions().dtype(torch::kFloat32).device(device_);
  const torch::Tensor axis = (torch::arange(size, float_options) - 0.5 * static_cast<double>(size - 1)) * pixel;
  const torch::Tensor x = axis.view({1, 1, 1, size}), y = axis.view({1, 1, size, 1});
  AcquisitionGeometry geometry;
  geometry.transforms = floats(voxel_poses, {rows, 3, 4});
  geometry.psf = stack_psfs(psfs).to(device_);
  geometry.resolution_ratio = pixel / grid_.resolution_mm;
  geometry.psf_of_slice = torch::tensor(psf_of_slice, torch::kInt64).to(device_);
  AcquisitionMasks acquisition_masks;
  acquisition_masks.volume = volumes.mask;
  // A slice reaches beyond its own brain's box, and may meet its neighbours there. It must not.
  const torch::Tensor boxes_of_blocks = floats(reach, {rows, 3, 2});
  const torch::Tensor axes = geometry.transforms.slice(2, 0, 2).reshape({rows * 3, 2}) * geometry.resolution_ratio;
  const torch::Tensor in_volume =
      torch::matmul(
          axes, torch::stack({x.expand({1, 1, size, size}).reshape({-1}), y.expand({1, 1, size, size}).reshape({-1})}) /
                    pixel)
          .view({rows, 3, size * size});
  acquisition_masks.slices =
      ((in_volume > boxes_of_blocks.slice(2, 0, 1)) & (in_volume < boxes_of_blocks.slice(2, 1, 2)))
          .all(1)
          .view({rows, 1, size, size});
  const SliceAcquisition acquisition(geometry, static_cast<int>(size), static_cast<int>(size), volumes.shape(),
                                     acquisition_formulation(options_.formulation), acquisition_masks);
  torch::Tensor share;
  torch::Tensor images = acquisition.forward(volumes.image, &share);
  torch::Tensor masks = share > 0.5;

  // 3. Damage to the masks.
  {
    const torch::Tensor cut = floats(cuts, {rows, 3, 1, 1, 1});
    masks = masks & (cut.select(1, 0) * x + cut.select(1, 1) * y < cut.select(1, 2));
    const float most = *std::max_element(erosions.begin(), erosions.end());
    // By one pixel a step, along rows and columns alone, so that corners are cut as by a disc.
    const torch::Tensor erosion = floats(erosions, {rows, 1, 1, 1});
    for (int step = 0; static_cast<float>(step) + 0.5F < most; ++step) {
      const torch::Tensor padded = torch::constant_pad_nd(masks, {1, 1, 1, 1}, 0);
      const auto moved = [&](std::int64_t dx, std::int64_t dy) {
        return padded.narrow(2, 1 + dy, size).narrow(3, 1 + dx, size);
      };
      const torch::Tensor smaller = masks & moved(1, 0) & moved(-1, 0) & moved(0, 1) & moved(0, -1);
      masks = torch::where(erosion > static_cast<double>(step) + 0.5, smaller, masks);
    }
  }

  // 4. The box around each mask: which slices stay, and where they are cropped. The only wait for the device.
  const torch::Tensor columns = masks.any(2).flatten(1), lines = masks.any(3).flatten(1);
  const torch::Tensor boxes_on_device =
      torch::stack({columns.to(torch::kUInt8).argmax(1), size - 1 - columns.flip({1}).to(torch::kUInt8).argmax(1),
                    lines.to(torch::kUInt8).argmax(1), size - 1 - lines.flip({1}).to(torch::kUInt8).argmax(1),
                    masks.flatten(1).sum(1)},
                   1);
  const torch::Tensor boxes = boxes_on_device.to(torch::kCPU);
  const auto box = boxes.accessor<std::int64_t, 2>();

  std::vector<std::int64_t> kept, shift_x, shift_y;
  std::vector<float> truth, nominal, positions, times, bias, voids, per_slice;
  std::vector<std::int64_t> counts, scan_of_row;
  std::vector<std::uint8_t> flags, black, maskless;
  std::vector<std::int64_t> begins;
  std::vector<SimulatedScan> scans(drafts.size());
  for (std::size_t i = 0; i < drafts.size(); ++i) {
    Draft& draft = drafts[i];
    SimulatedScan& scan = scans[i];
    begins.push_back(static_cast<std::int64_t>(kept.size()));
    const std::size_t acquired = draft.plan.acquired.size();
    std::vector<bool> keep(acquired, true);
    if (options_.prepared) {
      std::size_t best = 0;
      for (std::size_t k = 0; k < acquired; ++k) {
        const auto row = static_cast<std::int64_t>(draft.first + k);
        const SliceArtifacts& artifacts = draft.artifacts.slices[k];
        keep[k] = !artifacts.dropped && !artifacts.mask_lost &&
                  static_cast<double>(box[row][4]) * pixel * pixel >= options_.min_brain_mm2;
        if (box[row][4] > box[static_cast<std::int64_t>(draft.first + best)][4]) best = k;
      }
      if (std::find(keep.begin(), keep.end(), true) == keep.end()) keep[best] = true;
    }

    // Brain's centre in the scanner, as BrainRoi finds it: the middle of the box around all masks.
    Eigen::Vector3d low = Eigen::Vector3d::Constant(1e9), high = -low;
    std::vector<std::size_t> members;
    for (std::size_t k = 0; k < acquired; ++k) {
      if (!keep[k]) continue;
      members.push_back(k);
      const auto row = static_cast<std::int64_t>(draft.first + k);
      const auto at = [&](std::int64_t index) {
        return (static_cast<double>(index) - 0.5 * static_cast<double>(size - 1)) * pixel;
      };
      PlannedSlice& slice = draft.plan.acquired[k];
      for (const std::int64_t column : {box[row][0], box[row][1]})
        for (const std::int64_t line : {box[row][2], box[row][3]}) {
          const Eigen::Vector3d corner = slice.T_scanner_slice * Eigen::Vector3d(at(column), at(line), 0.);
          low = low.cwiseMin(corner);
          high = high.cwiseMax(corner);
        }
      std::int64_t dx = 0, dy = 0;
      if (options_.prepared && box[row][4] > 0) {
        dx = static_cast<std::int64_t>(
            std::floor(0.5 * static_cast<double>(box[row][0] + box[row][1] - (size - 1)) + 0.5));
        dy = static_cast<std::int64_t>(
            std::floor(0.5 * static_cast<double>(box[row][2] + box[row][3] - (size - 1)) + 0.5));
        const Pose crop = in_plane_shift(static_cast<double>(dx) * pixel, static_cast<double>(dy) * pixel);
        slice.T_scanner_slice = slice.T_scanner_slice * crop;
        slice.T_stack_slice = slice.T_stack_slice * crop;
      }
      kept.push_back(row);
      shift_x.push_back(dx);
      shift_y.push_back(dy);
    }
    Pose T_common_scanner = Pose::Identity();
    T_common_scanner.translation() = -0.5 * (low + high);

    std::vector<PlannedSlice> remaining;
    for (const std::size_t k : members) {
      const PlannedSlice& slice = draft.plan.acquired[k];
      const SliceArtifacts& artifacts = draft.artifacts.slices[k];
      remaining.push_back(slice);
      scan_of_row.push_back(static_cast<std::int64_t>(i));
      float pose[12];
      put_pose(slice.T_brain_slice(), 1., pose);
      truth.insert(truth.end(), pose, pose + 12);
      put_pose(options_.scanner.protocol == "uniform" ? slice.T_stack_slice : T_common_scanner * slice.T_scanner_slice,
               1., pose);
      nominal.insert(nominal.end(), pose, pose + 12);
      positions.push_back(static_cast<float>(slice.index - slice.slices_in_stack / 2));
      positions.push_back(static_cast<float>(slice.stack));
      counts.push_back(slice.slices_in_stack);
      times.push_back(static_cast<float>(slice.time_s - draft.plan.acquired[members.front()].time_s));
      for (const bool flag : {slice.displaced, artifacts.voided, artifacts.noisy}) flags.push_back(flag ? 1 : 0);
      for (const double c : draft.artifacts.log_bias(slice.T_scanner_slice)) bias.push_back(static_cast<float>(c));
      // The void as a quadratic of the cropped slice's coordinates; brain_centres are those before the crop.
      const std::size_t row = draft.first + k;
      const std::size_t at = scan_of_row.size() - 1;
      const Eigen::Vector2d middle =
          artifacts.void_centre +
          Eigen::Vector2d(double(brain_centres[2 * row]) - static_cast<double>(shift_x[at]) * pixel,
                          double(brain_centres[2 * row + 1]) - static_cast<double>(shift_y[at]) * pixel);
      const Eigen::Matrix2d& shape = artifacts.void_shape;
      const Eigen::Vector2d pulled = shape * middle;
      for (const double c :
           {middle.dot(pulled), -2. * pulled.x(), -2. * pulled.y(), shape(0, 0), 2. * shape(0, 1), shape(1, 1)})
        voids.push_back(static_cast<float>(-0.5 * c));
      for (const double c :
           {artifacts.noise, artifacts.gain * (1. - artifacts.whole_loss), artifacts.local_loss, draft.artifacts.gamma})
        per_slice.push_back(static_cast<float>(c));
      if (!options_.prepared) {
        scan.dropped.push_back(artifacts.dropped);
        black.push_back(artifacts.dropped ? 1 : 0);
        maskless.push_back(artifacts.dropped || artifacts.mask_lost ? 1 : 0);
      }
    }
    draft.plan.acquired = std::move(remaining);
    scan.number = draft.number;
    scan.volume_index = source_.volume_of(numbers[i]);
    scan.motion = draft.motion;
    scan.plan = draft.plan;
  }
  begins.push_back(static_cast<std::int64_t>(kept.size()));

  // 5. The slices that stay, cropped, with what goes wrong in the scanner.
  const auto n = static_cast<std::int64_t>(kept.size());
  const auto integers = [&](const std::vector<std::int64_t>& values) {
    return torch::tensor(values, torch::kInt64).to(device_);
  };
  const torch::Tensor index = integers(kept);
  images = images.index_select(0, index);
  masks = masks.index_select(0, index);
  if (options_.prepared) {
    const torch::Tensor dx = integers(shift_x), dy = integers(shift_y);
    images = shift_pixels(images, dx, dy);
    masks = shift_pixels(masks, dx, dy);
  }
  const torch::Tensor u = x.expand({1, 1, size, size}).reshape({-1}), v = y.expand({1, 1, size, size}).reshape({-1});
  const torch::Tensor monomials = torch::stack({torch::ones_like(u), u, v, u * u, u * v, v * v});
  const auto plane = [&](const std::vector<float>& coefficients) {
    return torch::matmul(floats(coefficients, {n, 6}), monomials).view({n, 1, size, size});
  };
  const torch::Tensor parameters = floats(per_slice, {n, 4, 1, 1, 1});
  const torch::Tensor noise = parameters.select(1, 0), gain = parameters.select(1, 1), loss = parameters.select(1, 2),
                      gamma = parameters.select(1, 3);
  images = torch::pow(images.clamp_min(0.), gamma) * torch::exp(plane(bias).clamp(-1., 1.)) * gain *
           (1. - loss * torch::exp(plane(voids)));
  {
    torch::Generator generator = make_generator(device_);
    torch::Tensor channels = torch::empty({2, n, 1, size, size}, float_options);
    for (std::size_t i = 0; i < scans.size(); ++i) {
      generator.set_current_seed(RandomStream(seed_, scans[i].number, purpose::kNoise).bits() >> 1);
      const std::int64_t of_scan = begins[i + 1] - begins[i];
      channels.narrow(1, begins[i], of_scan).copy_(torch::randn({2, of_scan, 1, size, size}, generator, float_options));
    }
    const torch::Tensor real = images + noise * channels[0], imaginary = noise * channels[1];
    images = torch::sqrt(real * real + imaginary * imaginary);
  }
  if (options_.prepared) {
    images = images * masks;
  } else {
    const auto rows_of = [&](const std::vector<std::uint8_t>& values) {
      return torch::tensor(values, torch::kUInt8).to(device_).view({n, 1, 1, 1}).to(torch::kBool);
    };
    images = images.masked_fill(rows_of(black), 0.);
    masks = masks & ~rows_of(maskless);
  }

  // 6. Scan by scan: intensity scale, tensors.
  const torch::Tensor all_truth = floats(truth, {n, 3, 4}), all_nominal = floats(nominal, {n, 3, 4});
  const torch::Tensor all_positions = floats(positions, {n, 2}), all_times = floats(times, {n});
  const torch::Tensor all_counts = integers(counts);
  const torch::Tensor all_flags = torch::tensor(flags, torch::kUInt8).to(device_).view({n, 3}).to(torch::kBool);
  std::vector<torch::Tensor> scales;
  for (std::size_t i = 0; i < scans.size(); ++i) {
    SimulatedScan& scan = scans[i];
    const auto part = [&](const torch::Tensor& all) { return all.narrow(0, begins[i], begins[i + 1] - begins[i]); };
    // The 0.99 quantile of the brain pixels, of an even sample: sorting all takes longer than simulating them.
    const torch::Tensor of_scan = part(images).flatten(), of_mask = part(masks).flatten();
    const std::int64_t step = std::max<std::int64_t>(1, of_scan.size(0) / 20011);
    const torch::Tensor sample = of_scan.slice(0, 0, of_scan.size(0), step);
    const torch::Tensor brain = of_mask.slice(0, 0, of_mask.size(0), step);
    const torch::Tensor sorted = std::get<0>((sample * brain).sort(0, true));
    const torch::Tensor rank = (brain.sum() * 0.01).to(torch::kInt64).clamp_max(sorted.size(0) - 1);
    torch::Tensor scale = sorted.index_select(0, rank.view({1}));
    scale = torch::where(scale > 0, scale, torch::ones_like(scale));
    scales.push_back(scale);

    scan.input.slices = part(images) / scale;
    scan.input.transforms = part(all_nominal);
    scan.input.positions = part(all_positions);
    scan.input.slice_counts = part(all_counts);
    scan.input.times = part(all_times);
    scan.input.common_frame = options_.scanner.protocol != "uniform";
    scan.input.slice_resolution_mm = pixel;
    scan.input.thickness_mm = scan.plan.thickness_mm;
    scan.masks = part(masks);
    scan.truth = part(all_truth);
    // The same contrast as the slices have: exponent and scale.
    scan.volume = torch::pow(drafts[i].anatomy->image, drafts[i].artifacts.gamma) / scale;
    scan.displaced = part(all_flags).select(1, 0);
    scan.voided = part(all_flags).select(1, 1);
    scan.noisy = part(all_flags).select(1, 2);
  }
  const torch::Tensor scale_values = torch::cat(scales).to(torch::kCPU);
  for (std::size_t i = 0; i < scans.size(); ++i)
    scans[i].intensity_scale = scale_values[static_cast<std::int64_t>(i)].item<double>();
  return scans;
}

}  // namespace svort
