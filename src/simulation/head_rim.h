#pragma once

#include "svort_ros/simulation/anatomy.h"
#include "svort_ros/simulation/random_stream.h"

namespace svort {

/// Lets the mask reach beyond the brain, into a dark skull and a grey scalp, as masks that were drawn generously do.
/// How far differs from side to side: a mean drawn from 0 to largest_mm, times a smooth field.
/// @param anatomy a brain without a rim; image and mask change, the extent does not
void add_head_rim(double largest_mm, double resolution_mm, RandomStream* random, Anatomy* anatomy);

}  // namespace svort
