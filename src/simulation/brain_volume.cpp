#include "svort_ros/simulation/brain_volume.h"

#include <torch/serialize.h>
#include <torch/types.h>

#include <array>
#include <cmath>
#include <fstream>
#include <iterator>
#include <sstream>
#include <stdexcept>

#include "svort_ros/simulation/random_stream.h"

namespace svort {
namespace {

constexpr int kMostClasses = 32;
constexpr const char* kFormat = "svort brain volumes 1";

[[noreturn]] void reject(const BrainVolume& volume, const std::string& what) {
  throw std::invalid_argument("brain volume '" + volume.name + "': " + what);
}

std::string shape_text(const torch::Tensor& tensor) {
  std::ostringstream text;
  if (!tensor.defined()) return "undefined";
  text << tensor.sizes() << " " << c10::toString(tensor.scalar_type());
  return text.str();
}

/// Coordinates along one axis of an array whose centre is the origin, mm.
torch::Tensor axis_mm(std::int64_t size, double resolution_mm) {
  return (torch::arange(size, torch::kFloat64) - 0.5 * static_cast<double>(size - 1)) * resolution_mm;
}

}  // namespace

void check(const BrainVolume& volume) {
  const torch::Tensor& image = volume.image;
  if (!image.defined() || image.dim() != 3 || image.scalar_type() != torch::kFloat32 || image.numel() == 0)
    reject(volume, "the image must be D x H x W, Float, got " + shape_text(image));
  if (!volume.mask.defined() || volume.mask.sizes() != image.sizes() || volume.mask.scalar_type() != torch::kBool)
    reject(volume, "the mask must be Bool of the image's size, got " + shape_text(volume.mask) + " for an image of " +
                       shape_text(image));
  if (!(std::isfinite(volume.resolution_mm) && volume.resolution_mm > 0.))
    reject(volume, "the voxel size is " + std::to_string(volume.resolution_mm) + " mm, must be positive");
  if (!torch::isfinite(image).all().item<bool>()) reject(volume, "the image holds NaN or infinity");
  if ((image < 0).any().item<bool>()) reject(volume, "the image holds negative values");
  if (!volume.mask.any().item<bool>()) reject(volume, "the mask has no brain voxel");
  if (!image.masked_select(volume.mask).any().item<bool>()) reject(volume, "the image is 0 within the mask");
  if (!volume.labels.defined()) return;
  if (volume.labels.sizes() != image.sizes() || volume.labels.scalar_type() != torch::kUInt8)
    reject(volume, "the labels must be Byte of the image's size, got " + shape_text(volume.labels));
  if (const int most = volume.labels.max().item<int>(); most >= kMostClasses)
    reject(volume, "label " + std::to_string(most) + " is too large, tissue classes are 0 to " +
                       std::to_string(kMostClasses - 1));
}

BrainExtent brain_extent(const BrainVolume& volume) {
  BrainExtent extent;
  for (int axis = 0; axis < 3; ++axis) {
    // Array dimensions are z, y, x.
    const torch::Tensor along = volume.mask.transpose(0, 2 - axis).flatten(1).any(1);
    const torch::Tensor where = torch::nonzero(along.cpu()).flatten();
    const double first = where[0].item<double>(), last = where[-1].item<double>();
    const auto size = static_cast<double>(along.size(0));
    extent.centre[axis] = (0.5 * (first + last) - 0.5 * (size - 1.)) * volume.resolution_mm;
    extent.half_size[axis] = 0.5 * (last - first + 1.) * volume.resolution_mm;
  }
  return extent;
}

void save_brain_volumes(const std::filesystem::path& path, const std::vector<BrainVolume>& volumes) {
  c10::Dict<std::string, torch::Tensor> dict;
  const auto text_tensor = [](const std::string& text) {
    torch::Tensor bytes = torch::empty({static_cast<std::int64_t>(text.size())}, torch::kUInt8);
    std::copy(text.begin(), text.end(), bytes.data_ptr<std::uint8_t>());
    return bytes;
  };
  dict.insert("format", text_tensor(kFormat));
  dict.insert("count", torch::tensor(static_cast<std::int64_t>(volumes.size())));
  for (std::size_t i = 0; i < volumes.size(); ++i) {
    const BrainVolume& volume = volumes[i];
    check(volume);
    const std::string suffix = "_" + std::to_string(i);
    dict.insert("name" + suffix, text_tensor(volume.name));
    dict.insert("image" + suffix, volume.image.cpu().contiguous());
    dict.insert("mask" + suffix, volume.mask.cpu().contiguous());
    if (volume.labels.defined()) dict.insert("labels" + suffix, volume.labels.cpu().contiguous());
    dict.insert("resolution_mm" + suffix, torch::tensor(volume.resolution_mm, torch::kFloat64));
  }
  const std::vector<char> bytes = torch::pickle_save(dict);
  const std::filesystem::path partial = path.string() + ".partial";
  {
    std::ofstream file(partial, std::ios::binary);
    file.write(bytes.data(), static_cast<std::streamsize>(bytes.size()));
    file.close();
    if (!file) throw std::runtime_error(partial.string() + ": cannot be written");
  }
  std::error_code error;
  std::filesystem::rename(partial, path, error);
  if (error) throw std::runtime_error(path.string() + ": " + error.message());
}

std::vector<BrainVolume> load_brain_volumes(const std::filesystem::path& path) {
  const auto fail = [&path](const std::string& what) { throw std::runtime_error(path.string() + ": " + what); };
  std::ifstream file(path, std::ios::binary);
  if (!file || !std::filesystem::is_regular_file(path)) fail("cannot be read");
  const std::vector<char> bytes((std::istreambuf_iterator<char>(file)), std::istreambuf_iterator<char>());
  std::vector<BrainVolume> volumes;
  try {
    const auto dict = torch::pickle_load(bytes).toGenericDict();
    const auto tensor = [&dict](const std::string& key) { return dict.at(key).toTensor(); };
    const auto text = [&tensor](const std::string& key) {
      const torch::Tensor value = tensor(key).to(torch::kUInt8).contiguous();
      const auto* begin = value.data_ptr<std::uint8_t>();
      return std::string(begin, begin + value.numel());
    };
    if (text("format") != kFormat) throw std::invalid_argument("is not a file of brain volumes");
    const auto count = tensor("count").item<std::int64_t>();
    for (std::int64_t i = 0; i < count; ++i) {
      const std::string suffix = "_" + std::to_string(i);
      BrainVolume volume;
      volume.name = text("name" + suffix);
      volume.image = tensor("image" + suffix);
      volume.mask = tensor("mask" + suffix);
      if (dict.contains("labels" + suffix)) volume.labels = tensor("labels" + suffix);
      volume.resolution_mm = tensor("resolution_mm" + suffix).item<double>();
      check(volume);
      volumes.push_back(volume);
    }
  } catch (const std::exception& error) {
    fail(std::string("is not a file of brain volumes, or is damaged: ") + error.what());
  }
  return volumes;
}

BrainVolume make_phantom(const PhantomOptions& options) {
  const auto require = [](bool ok, const char* option, double value, const char* limit) {
    if (ok) return;
    std::ostringstream text;
    text << "phantom." << option << " is " << value << ", must be " << limit;
    throw std::invalid_argument(text.str());
  };
  require(options.length_mm >= 20. && options.length_mm <= 200., "length_mm", options.length_mm, "in 20 .. 200");
  require(options.resolution_mm >= 0.2 && options.resolution_mm <= 10., "resolution_mm", options.resolution_mm,
          "in 0.2 .. 10");
  require(options.fold_mm >= 0. && options.fold_mm <= 20., "fold_mm", options.fold_mm, "in 0 .. 20");

  RandomStream random(options.seed);
  const double unit = options.length_mm / 80.;  // all lengths below are those of a brain of 80 mm
  const auto cells = static_cast<std::int64_t>(std::ceil(1.3 * options.length_mm / options.resolution_mm));
  const torch::Tensor axis = axis_mm(cells, options.resolution_mm) / unit;
  const torch::Tensor z = axis.view({-1, 1, 1}), y = axis.view({1, -1, 1}), x = axis.view({1, 1, -1});
  const auto vary = [&random](double value) { return value * random.uniform(0.93, 1.07); };

  // Signed distance, about: negative inside.
  const auto ellipsoid = [&](std::array<double, 3> centre, std::array<double, 3> radius) {
    const torch::Tensor dx = (x - centre[0]) / radius[0], dy = (y - centre[1]) / radius[1],
                        dz = (z - centre[2]) / radius[2];
    return ((dx * dx + dy * dy + dz * dz).sqrt() - 1.) * std::cbrt(radius[0] * radius[1] * radius[2]);
  };
  const torch::Tensor hull = ellipsoid({0., 0., 2.}, {vary(32.), 38., vary(30.)});
  // Folds: furrows where plane waves of random directions, about 14 mm long, cross zero.
  torch::Tensor waves = torch::zeros({cells, cells, cells}, torch::kFloat64);
  for (int wave = 0; wave < 6; ++wave) {
    const Eigen::Vector3d k = random.direction() * (2. * M_PI / random.uniform(12., 18.));
    waves = waves + torch::sin(k.x() * x + k.y() * y + k.z() * z + random.uniform(0., 2. * M_PI));
  }
  const torch::Tensor furrow = options.fold_mm / unit * torch::exp(-2. * waves * waves);
  // The lateral furrow of the left side is deeper than that of the right.
  const torch::Tensor left_furrow =
      5. * torch::exp(-(torch::pow((x - 31.) / 8., 2) + torch::pow((z - 0.) / 4., 2) + torch::pow((y + 4.) / 12., 2)));
  const torch::Tensor pial = hull + furrow + left_furrow;
  const torch::Tensor fissure = (x.abs() < 1.5) & (z > -2.) & (hull < 0);
  const torch::Tensor cerebellum = ellipsoid({0., 21., -24.}, {vary(20.), vary(12.), vary(10.)});
  const torch::Tensor stem = ellipsoid({0., 10., -28.}, {7., 7., vary(15.)});
  const auto pair = [&](std::array<double, 3> centre, std::array<double, 3> radius, double left_scale) {
    const torch::Tensor right = ellipsoid({-centre[0], centre[1], centre[2]}, radius);
    for (double& r : radius) r *= left_scale;
    return torch::minimum(ellipsoid(centre, radius), right);
  };
  const torch::Tensor ventricle = torch::minimum(pair({9., 2., 8.}, {vary(4.), vary(16.), vary(5.)}, 1.35),
                                                 ellipsoid({0., 2., -4.}, {1.5, 8., 7.}));
  const torch::Tensor deep = pair({10., -1., -4.}, {vary(7.), vary(11.), vary(7.)}, 1.);

  BrainVolume volume;
  volume.name = "phantom " + std::to_string(options.seed);
  volume.resolution_mm = options.resolution_mm;
  volume.mask = (hull < 2.5) | (cerebellum < 1.5) | (stem < 0.5);
  const auto set = [&volume](const torch::Tensor& where, Tissue tissue) {
    volume.labels.masked_fill_(where.expand_as(volume.labels), static_cast<int>(tissue));
  };
  volume.labels = torch::zeros({cells, cells, cells}, torch::kUInt8);
  set(volume.mask, Tissue::fluid);
  set(pial < 0, Tissue::cortex);
  set(pial < -3., Tissue::white);
  set(fissure, Tissue::fluid);
  set(deep < 0, Tissue::deep_grey);
  set(ventricle < 0, Tissue::fluid);
  set(cerebellum < 0, Tissue::cerebellum);
  set(stem < 0, Tissue::brainstem);

  // T2-like: fluid is bright, the myelin-poor white matter brighter than the cortex.
  const std::array<double, 7> brightness = {0., 1., 0.45, 0.68, 0.5, 0.52, 0.42};
  torch::Tensor image = torch::zeros({cells, cells, cells}, torch::kFloat64);
  for (std::size_t tissue = 0; tissue < brightness.size(); ++tissue)
    image = image + (volume.labels == static_cast<int>(tissue)).to(torch::kFloat64) * brightness[tissue];
  image = image * (1. + 0.01 * waves);
  volume.image = image.to(torch::kFloat32).clamp_min(0.);
  return volume;
}

}  // namespace svort
