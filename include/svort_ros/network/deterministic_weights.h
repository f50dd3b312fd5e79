#pragma once

#include <torch/nn/module.h>

#include <cstdint>

namespace svort {

/// Fills every parameter of SVoRT version 1 or 2 with reproducible pseudo-random numbers: a network that computes, but
/// has learnt nothing. The golden numbers of the tests were made with these.
///
/// A value depends on the parameter's name and the element's index alone: an integer hash of both, scaled by the kind
/// of the parameter (He-uniform for convolutions, Glorot-like for linear layers, near 1 for normalisations). The last
/// normalisation of a residual block is scaled by 0.25, which keeps rounding errors small, and the last layer of a pose
/// network by 6, so that an iteration moves the anchor points by 5 to 20 mm.
///
/// @throws std::invalid_argument naming a parameter that no rule is for
void fill_deterministically(torch::nn::Module& network);

/// CRC-32 (IEEE 802.3) of all parameters' bytes as little-endian float32, in the order of their registration.
std::uint32_t parameter_checksum(const torch::nn::Module& network);

}  // namespace svort
