#pragma once

#include <Eigen/Core>
#include <cstdint>
#include <vector>

namespace svort {

/// An image on a regular in-plane grid whose centre is the origin; row-major.
struct PlaneGrid {
  int columns = 0;
  int rows = 0;
  Eigen::Vector2d spacing = {1., 1.};  ///< between columns, between rows, mm
};

/// Values of `image` (on `source`) at the pixels of `target`, whose centre lies at `shift` (mm) in source coordinates.
///
/// Linear interpolation, exact for linear images. Along an axis on which pixels grow from s to r mm, the image is
/// first blurred by a Gaussian of FWHM 1.2 sqrt(r^2 - s^2): a pixel with the point spread function of the forward model
/// (1.2 s) turns into one with that of the larger pixel (1.2 r). Beyond the outermost pixel centres the border value
/// holds; pixels whose centre lies off the image (outside the outlines of its pixels) are 0 and not `inside`.
///
/// @param inside if not null, receives 1 for each target pixel on the image
std::vector<float> resample_plane(const std::vector<float>& image, const PlaneGrid& source, const PlaneGrid& target,
                                  const Eigen::Vector2d& shift, std::vector<std::uint8_t>* inside = nullptr);

}  // namespace svort
