#include "svort_ros/io/nifti.h"

#include <nifti2_io.h>

#include <cerrno>
#include <cmath>
#include <cstring>
#include <limits>
#include <memory>
#include <sstream>
#include <stdexcept>
#include <string>

#include "svort_ros/geometry/patient_frames.h"
#include "svort_ros/io/atomic_file.h"

namespace svort {
namespace {

struct ImageDeleter {
  void operator()(nifti_image* image) const { nifti_image_free(image); }
};
using ImagePtr = std::unique_ptr<nifti_image, ImageDeleter>;

/// A plain or compressed file of niftilib that closes itself.
class ZFile {
 public:
  ZFile(const std::filesystem::path& path, const char* mode, bool compressed)
      : file_(znzopen(path.c_str(), mode, compressed ? 1 : 0)) {}
  ~ZFile() {
    if (file_) znzclose(file_);
  }
  ZFile(const ZFile&) = delete;
  ZFile& operator=(const ZFile&) = delete;

  explicit operator bool() const { return file_ != nullptr; }
  bool seek(std::int64_t offset) { return znzseek(file_, offset, SEEK_SET) >= 0; }
  /// Number of bytes read; more than `count` if the file is damaged (niftilib's -1).
  std::size_t read(void* data, std::size_t count) { return znzread(data, 1, count, file_); }
  bool write(const void* data, std::size_t count) { return znzwrite(data, 1, count, file_) == count; }
  bool close() {
    znzFile file = file_;
    file_ = nullptr;
    return znzclose(file) == 0;
  }

 private:
  znzFile file_;
};

[[noreturn]] void fail(const std::filesystem::path& path, const std::string& what) {
  throw std::runtime_error(path.string() + ": " + what);
}

bool ends_with(const std::string& text, const std::string& end) {
  return text.size() >= end.size() && text.compare(text.size() - end.size(), end.size(), end) == 0;
}

template <class T>
void append_as_float(const std::vector<char>& bytes, std::vector<float>& values) {
  T value;
  for (std::size_t offset = 0; offset < bytes.size(); offset += sizeof(T)) {
    std::memcpy(&value, bytes.data() + offset, sizeof(T));
    values.push_back(static_cast<float>(value));
  }
}

using Appender = void (*)(const std::vector<char>&, std::vector<float>&);

/// Null for types that are not real numbers of a portable layout (complex, RGB, bits, 128-bit float).
Appender appender_of(int datatype) {
  switch (datatype) {
    case NIFTI_TYPE_UINT8:
      return append_as_float<std::uint8_t>;
    case NIFTI_TYPE_INT8:
      return append_as_float<std::int8_t>;
    case NIFTI_TYPE_UINT16:
      return append_as_float<std::uint16_t>;
    case NIFTI_TYPE_INT16:
      return append_as_float<std::int16_t>;
    case NIFTI_TYPE_UINT32:
      return append_as_float<std::uint32_t>;
    case NIFTI_TYPE_INT32:
      return append_as_float<std::int32_t>;
    case NIFTI_TYPE_UINT64:
      return append_as_float<std::uint64_t>;
    case NIFTI_TYPE_INT64:
      return append_as_float<std::int64_t>;
    case NIFTI_TYPE_FLOAT32:
      return append_as_float<float>;
    case NIFTI_TYPE_FLOAT64:
      return append_as_float<double>;
    default:
      return nullptr;
  }
}

/// niftilib's own loader would replace NaN by 0 and say nothing, so the voxels are read here.
std::vector<float> read_values(const std::filesystem::path& path, const nifti_image& header) {
  const Appender append = appender_of(header.datatype);
  if (!append)
    fail(path, std::string("voxels of type ") + nifti_datatype_string(header.datatype) + " are not supported, only " +
                   "integers and floating point numbers of up to 64 bits");
  ZFile file(path, "rb", nifti_is_gzfile(path.c_str()) != 0);
  if (!file || !file.seek(header.iname_offset)) fail(path, "the voxels cannot be read");

  // Slice by slice: a damaged header cannot ask for more memory than the file holds.
  const std::size_t slice_bytes = static_cast<std::size_t>(header.nx) * static_cast<std::size_t>(header.ny) *
                                  static_cast<std::size_t>(header.nbyper);
  const auto total = slice_bytes * static_cast<std::size_t>(header.nz);
  if (!nifti_is_gzfile(path.c_str()) &&
      std::filesystem::file_size(path) < static_cast<std::size_t>(header.iname_offset) + total)
    fail(path, "the file is truncated: " + std::to_string(std::filesystem::file_size(path)) +
                   " bytes, its header asks "
                   "for " +
                   std::to_string(static_cast<std::size_t>(header.iname_offset) + total));
  std::vector<float> values;
  std::vector<char> bytes(slice_bytes);
  for (std::int64_t k = 0; k < header.nz; ++k) {
    const std::size_t count = file.read(bytes.data(), bytes.size());
    if (count != bytes.size()) {
      const std::size_t good = static_cast<std::size_t>(k) * slice_bytes + (count < slice_bytes ? count : 0);
      fail(path, "the file is truncated or damaged: " + std::to_string(good) + " of " + std::to_string(total) +
                     " bytes of voxels can be read");
    }
    if (header.swapsize > 1 && header.byteorder != nifti_short_order())
      nifti_swap_Nbytes(static_cast<std::int64_t>(slice_bytes) / header.swapsize, header.swapsize, bytes.data());
    append(bytes, values);
  }
  // The checksum of a compressed file is compared when its end is reached.
  char more = 0;
  if (file.read(&more, 1) > 1) fail(path, "the file is damaged: its checksum does not fit its content");

  // Slope 0 (or NaN, which niftilib turns into 0) means that the values are not scaled.
  if (header.scl_slope != 0.)
    for (float& value : values)
      value = static_cast<float>(static_cast<double>(value) * header.scl_slope + header.scl_inter);
  return values;
}

Eigen::Affine3d affine_of(const std::filesystem::path& path, const nifti_image& header) {
  if (header.sform_code <= 0 && header.qform_code <= 0) fail(path, "the header has neither sform nor qform");
  const nifti_dmat44& matrix = header.sform_code > 0 ? header.sto_xyz : header.qto_xyz;
  Eigen::Affine3d affine_ras = Eigen::Affine3d::Identity();
  for (int row = 0; row < 3; ++row)
    for (int column = 0; column < 4; ++column) affine_ras(row, column) = matrix.m[row][column];
  const Eigen::Vector3d lengths = affine_ras.linear().colwise().norm().transpose();
  if (!affine_ras.matrix().allFinite() || !(lengths.minCoeff() > 0.) ||
      !(std::abs(affine_ras.linear().determinant()) > 1e-6 * lengths.prod()))
    fail(path, header.sform_code > 0 ? "the sform is singular or not finite" : "the qform is singular or not finite");
  return lps_from_ras(affine_ras);
}

}  // namespace

NiftiImage read_nifti(const std::filesystem::path& path) {
  if (!std::filesystem::exists(path)) fail(path, "no such file");
  if (!std::filesystem::is_regular_file(path)) fail(path, "is not a file");
  if (!ends_with(path.string(), ".nii") && !ends_with(path.string(), ".nii.gz"))
    fail(path, "is not named .nii or .nii.gz");
  nifti_set_debug_level(0);  // errors are told by exceptions, not on the terminal
  const ImagePtr header(nifti_image_read(path.c_str(), 0));
  if (!header) fail(path, "is not a readable NIfTI file");

  if (header->nx < 1 || header->ny < 1 || header->nz < 1 || header->nx > std::numeric_limits<int>::max() ||
      header->ny > std::numeric_limits<int>::max() || header->nz > std::numeric_limits<int>::max())
    fail(path, "the header's dimensions are not usable");
  if (header->nvox != header->nx * header->ny * header->nz) {
    std::ostringstream message;
    message << "holds " << header->nvox / (header->nx * header->ny * header->nz) << " volumes, must be one";
    fail(path, message.str());
  }
  if (header->xyz_units != NIFTI_UNITS_MM && header->xyz_units != NIFTI_UNITS_UNKNOWN)
    fail(path, std::string("lengths are in '") + nifti_units_string(header->xyz_units) + "', must be mm");

  NiftiImage image;
  image.size =
      Eigen::Vector3i(static_cast<int>(header->nx), static_cast<int>(header->ny), static_cast<int>(header->nz));
  image.affine_lps = affine_of(path, *header);
  image.spacing = image.affine_lps.linear().colwise().norm().transpose();
  image.values = read_values(path, *header);
  return image;
}

void write_nifti(const std::filesystem::path& path, const Volume& volume) {
  const ImageGrid& grid = volume.grid;
  const bool compressed = ends_with(path.string(), ".nii.gz");
  if (!compressed && !ends_with(path.string(), ".nii")) fail(path, "must be named .nii or .nii.gz");
  if (grid.size.minCoeff() < 1 || grid.size.maxCoeff() > std::numeric_limits<std::int16_t>::max() ||
      volume.values.size() != grid.voxel_count()) {
    std::ostringstream message;
    message << "a volume of " << grid.size.transpose() << " voxels with " << volume.values.size()
            << " values cannot be written (1 to 32767 per axis, one value each)";
    fail(path, message.str());
  }

  Eigen::Affine3d affine_lps(grid.T_frame_grid.matrix());
  affine_lps.scale(grid.spacing);
  affine_lps.translate(-0.5 * (grid.size.cast<double>() - Eigen::Vector3d::Ones()));
  const Eigen::Affine3d affine_ras = ras_from_lps(affine_lps);

  nifti_set_debug_level(0);
  const std::int64_t dims[8] = {3, grid.size.x(), grid.size.y(), grid.size.z(), 1, 1, 1, 1};
  const ImagePtr image(nifti_make_new_nim(dims, NIFTI_TYPE_FLOAT32, 0));
  if (!image) fail(path, "niftilib refused the header");
  image->nifti_type = NIFTI_FTYPE_NIFTI1_1;
  image->xyz_units = NIFTI_UNITS_MM;
  // The brain's frame is an anatomical one, not the scanner's.
  image->sform_code = NIFTI_XFORM_ALIGNED_ANAT;
  image->qform_code = NIFTI_XFORM_ALIGNED_ANAT;
  for (int row = 0; row < 4; ++row)
    for (int column = 0; column < 4; ++column) image->sto_xyz.m[row][column] = affine_ras(row, column);
  image->qto_xyz = image->sto_xyz;
  nifti_dmat44_to_quatern(image->sto_xyz, &image->quatern_b, &image->quatern_c, &image->quatern_d, &image->qoffset_x,
                          &image->qoffset_y, &image->qoffset_z, nullptr, nullptr, nullptr, &image->qfac);
  image->pixdim[0] = image->qfac;
  image->pixdim[1] = image->dx = grid.spacing.x();
  image->pixdim[2] = image->dy = grid.spacing.y();
  image->pixdim[3] = image->dz = grid.spacing.z();
  nifti_1_header header;
  if (nifti_convert_nim2n1hdr(image.get(), &header) != 0) fail(path, "niftilib refused the header");
  constexpr int kDataOffset = 352;  // header and the four bytes that say "no extension"
  header.vox_offset = kDataOffset;
  const char no_extension[kDataOffset - sizeof(header)] = {};

  AtomicFile target(path);
  errno = 0;
  ZFile file(target.temporary(), "wb", compressed);
  const bool written = file && file.write(&header, sizeof(header)) && file.write(no_extension, sizeof(no_extension)) &&
                       file.write(volume.values.data(), volume.values.size() * sizeof(float)) && file.close();
  if (!written) fail(path, std::string("cannot write it: ") + std::strerror(errno));
  target.commit();
}

}  // namespace svort
