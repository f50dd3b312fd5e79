#include "svort_ros/io/brain_volume_file.h"

#include <torch/types.h>

#include <algorithm>
#include <array>
#include <cmath>
#include <cstdint>
#include <map>
#include <sstream>
#include <stdexcept>

#include "svort_ros/io/nifti.h"

namespace svort {
namespace {

[[noreturn]] void fail(const std::filesystem::path& path, const std::string& what) {
  throw std::runtime_error(path.string() + ": " + what);
}

/// Which array axis runs along each LPS axis, and in which direction.
struct AxisOrder {
  std::array<int, 3> array_axis{};
  std::array<bool, 3> reversed{};
};

AxisOrder axis_order(const std::filesystem::path& path, const NiftiImage& image) {
  AxisOrder order;
  for (int world = 0; world < 3; ++world) {
    int found = -1;
    for (int axis = 0; axis < 3; ++axis) {
      const Eigen::Vector3d step = image.affine_lps.linear().col(axis);
      const double along = step[world] / step.norm();
      if (1. - std::abs(along) > 1e-3) continue;
      found = axis;
      order.reversed[static_cast<std::size_t>(world)] = along < 0.;
    }
    if (found < 0) fail(path, "its axes are oblique; resample it along the patient's axes first");
    order.array_axis[static_cast<std::size_t>(world)] = found;
  }
  for (int axis = 1; axis < 3; ++axis)
    if (std::abs(image.spacing[axis] / image.spacing[0] - 1.) > 1e-3) {
      std::ostringstream text;
      text << "voxels of " << image.spacing.transpose() << " mm are no cubes; resample it first";
      fail(path, text.str());
    }
  return order;
}

/// z, y, x along superior, posterior, left.
torch::Tensor reordered(const NiftiImage& image, const AxisOrder& order) {
  const torch::Tensor values = torch::from_blob(const_cast<float*>(image.values.data()),
                                                {image.size.z(), image.size.y(), image.size.x()}, torch::kFloat32);
  torch::Tensor result = values.permute({2 - order.array_axis[2], 2 - order.array_axis[1], 2 - order.array_axis[0]});
  std::vector<std::int64_t> flips;
  for (std::size_t world = 0; world < 3; ++world)
    if (order.reversed[world]) flips.push_back(2 - static_cast<std::int64_t>(world));
  return result.flip(flips).clone(at::MemoryFormat::Contiguous);
}

void check_same_grid(const std::filesystem::path& path, const NiftiImage& other, const NiftiImage& image,
                     const std::filesystem::path& image_path) {
  if (other.size != image.size) {
    std::ostringstream text;
    text << "its size " << other.size.transpose() << " differs from " << image.size.transpose() << " of "
         << image_path.string();
    fail(path, text.str());
  }
  const Eigen::Vector3d last = (image.size - Eigen::Vector3i::Ones()).cast<double>();
  const double distance =
      std::max((other.affine_lps * Eigen::Vector3d(0., 0., 0.) - image.affine_lps.translation()).norm(),
               (other.affine_lps * last - image.affine_lps * last).norm());
  if (distance > 1e-2) {
    std::ostringstream text;
    text << "lies " << distance << " mm away from " << image_path.string();
    fail(path, text.str());
  }
}

/// Label key of the CRL fetal brain atlas ("Olympic edition").
const std::map<int, Tissue>& crl_key() {
  static const std::map<int, Tissue> key = [] {
    std::map<int, Tissue> result;
    const auto put = [&result](std::initializer_list<int> labels, Tissue tissue) {
      for (const int label : labels) result[label] = tissue;
    };
    put({92, 93, 124}, Tissue::fluid);
    put({112, 113}, Tissue::cortex);
    put({91, 110, 111, 114, 115, 116, 117, 118, 119, 120, 121, 122, 123, 125}, Tissue::white);
    put({37, 38, 41, 42, 71, 72, 73, 74, 77, 78, 108, 109}, Tissue::deep_grey);
    put({100, 101}, Tissue::cerebellum);
    put({94}, Tissue::brainstem);
    return result;
  }();
  return key;
}

torch::Tensor tissue_classes(const std::filesystem::path& path, const torch::Tensor& labels) {
  constexpr int kMost = 255, kMostClasses = 31;
  if (!torch::equal(labels, labels.round()) || (labels < 0).any().item<bool>() || (labels > kMost).any().item<bool>())
    fail(path, "labels must be whole numbers in 0 .. 255");
  const torch::Tensor whole = labels.to(torch::kInt64);
  const torch::Tensor present = torch::bincount(whole.flatten(), {}, kMost + 1);
  bool crl = true, plain = true;
  std::array<std::int64_t, kMost + 1> classes{};
  for (int label = 1; label <= kMost; ++label) {
    if (present[label].item<std::int64_t>() == 0) continue;
    const auto found = crl_key().find(label);
    crl = crl && found != crl_key().end();
    plain = plain && label <= kMostClasses;
    if (found != crl_key().end()) classes[static_cast<std::size_t>(label)] = static_cast<std::int64_t>(found->second);
  }
  if (plain) return whole.to(torch::kUInt8);
  if (!crl) fail(path, "its labels are neither those of the CRL fetal brain atlas nor classes in 1 .. 31");
  const torch::Tensor table = torch::from_blob(classes.data(), {kMost + 1}, torch::kInt64);
  return table.index_select(0, whole.flatten()).view(whole.sizes()).to(torch::kUInt8);
}

BrainVolume read_with_neighbours(const std::string& file) {
  const std::string ending = file.size() > 3 && file.compare(file.size() - 3, 3, ".gz") == 0 ? ".nii.gz" : ".nii";
  const std::string stem = file.substr(0, file.size() - std::min(file.size(), ending.size()));
  const auto beside = [&](const std::vector<const char*>& names) {
    for (const char* name : names) {
      if (const std::string path = stem + name + ending; std::filesystem::exists(path)) return path;
    }
    return std::string();
  };
  return read_brain_volume(file, beside({"_mask"}), beside({"_parc", "_WMZparc"}));
}

}  // namespace

BrainVolume read_brain_volume(const std::filesystem::path& image, const std::filesystem::path& mask,
                              const std::filesystem::path& parcellation) {
  const NiftiImage nifti = read_nifti(image);
  const AxisOrder order = axis_order(image, nifti);
  const auto read_other = [&](const std::filesystem::path& path) {
    const NiftiImage other = read_nifti(path);
    check_same_grid(path, other, nifti, image);
    return reordered(other, order);
  };
  BrainVolume volume;
  volume.name = image.string();
  volume.resolution_mm = nifti.spacing.x();
  volume.image = reordered(nifti, order);
  volume.mask = mask.empty() ? volume.image > 0 : read_other(mask) > 0;
  if (!volume.mask.any().item<bool>()) fail(mask.empty() ? image : mask, "shows no brain");
  if (!parcellation.empty()) volume.labels = tissue_classes(parcellation, read_other(parcellation));
  // Interpolation on the way to the file can leave small negative values; an image of magnitudes has none.
  volume.image = volume.image.clamp_min(0.);
  try {
    check(volume);
  } catch (const std::invalid_argument& error) {
    throw std::runtime_error(error.what());
  }
  return volume;
}

std::vector<BrainVolume> read_brain_volumes(const std::vector<std::string>& files) {
  std::vector<BrainVolume> volumes;
  for (const std::string& file : files) {
    if (std::filesystem::path(file).extension() != ".pt") {
      volumes.push_back(read_with_neighbours(file));
      continue;
    }
    for (BrainVolume& volume : load_brain_volumes(file)) volumes.push_back(std::move(volume));
  }
  return volumes;
}

std::string volume_name(const std::filesystem::path& file) {
  std::string name = file.filename().string();
  for (const std::string ending : {".gz", ".nii"})
    if (name.size() > ending.size() && name.compare(name.size() - ending.size(), ending.size(), ending) == 0)
      name.resize(name.size() - ending.size());
  return name;
}

Volume to_volume(const torch::Tensor& image, double resolution_mm) {
  const torch::Tensor values = image.to(torch::kCPU, torch::kFloat32).contiguous();
  Volume volume;
  volume.grid.size = {static_cast<int>(values.size(2)), static_cast<int>(values.size(1)),
                      static_cast<int>(values.size(0))};
  volume.grid.spacing.setConstant(resolution_mm);
  volume.values.assign(values.data_ptr<float>(), values.data_ptr<float>() + values.numel());
  return volume;
}

}  // namespace svort
