// The inner loops of the acquisition operator. Included once per instruction set, inside a namespace of its own and
// with the compiler set to that instruction set; SVORT_WIDE_LANES says whether 8 floats fit into a register.

using Float4 = float __attribute__((vector_size(16)));

inline Float4 load_pairs(const float* a, const float* b) {  // {a[0], a[1], b[0], b[1]}, by two loads of eight bytes
  using Double2 = double __attribute__((vector_size(16)));
  double first, second;
  std::memcpy(&first, a, sizeof(first));
  std::memcpy(&second, b, sizeof(second));
  const Double2 bits = {first, second};
  Float4 value;
  std::memcpy(&value, &bits, sizeof(value));
  return value;
}

inline void store_pairs(const Float4& value, float* a, float* b) {
  std::memcpy(a, &value, 2 * sizeof(float));
  std::memcpy(b, reinterpret_cast<const char*>(&value) + 2 * sizeof(float), 2 * sizeof(float));
}

#if SVORT_WIDE_LANES

using Lanes = float __attribute__((vector_size(32)));
using Ints = std::int32_t __attribute__((vector_size(32)));

inline Lanes load(const float* source) {
  Lanes value;
  std::memcpy(&value, source, sizeof(value));
  return value;
}
inline void store(const Lanes& value, float* target) { std::memcpy(target, &value, sizeof(value)); }
inline void store(const Ints& value, std::int32_t* target) { std::memcpy(target, &value, sizeof(value)); }
inline Ints truncate(const Lanes& value) { return __builtin_convertvector(value, Ints); }
inline Lanes to_float(const Ints& value) { return __builtin_convertvector(value, Lanes); }
inline Ints both(const Ints& a, const Ints& b) { return a & b; }
inline Ints at_least_zero(const Lanes& a) { return a >= 0.F; }
inline Ints below(const Lanes& a, float limit) { return a < limit; }
inline Lanes keep(const Ints& mask, const Lanes& value) {  // value where the mask is set, else 0
  Ints bits;
  std::memcpy(&bits, &value, sizeof(bits));
  bits &= mask;
  Lanes kept;
  std::memcpy(&kept, &bits, sizeof(kept));
  return kept;
}

// The first and the second of each pair, of eight pairs at base + index[lane].
inline void load_pairs(const float* base, const std::int32_t* index, Lanes* first, Lanes* second) {
  const Float4 ab = load_pairs(base + index[0], base + index[1]), cd = load_pairs(base + index[2], base + index[3]);
  const Float4 ef = load_pairs(base + index[4], base + index[5]), gh = load_pairs(base + index[6], base + index[7]);
  const Lanes left = __builtin_shufflevector(ab, ef, 0, 1, 2, 3, 4, 5, 6, 7);
  const Lanes right = __builtin_shufflevector(cd, gh, 0, 1, 2, 3, 4, 5, 6, 7);
  *first = __builtin_shufflevector(left, right, 0, 2, 8, 10, 4, 6, 12, 14);
  *second = __builtin_shufflevector(left, right, 1, 3, 9, 11, 5, 7, 13, 15);
}

// out[lane] = {a[lane], b[lane], c[lane], d[lane]}
inline void transpose(const Lanes& a, const Lanes& b, const Lanes& c, const Lanes& d, Float4* out) {
  const Lanes ab_low = __builtin_shufflevector(a, b, 0, 8, 1, 9, 4, 12, 5, 13);
  const Lanes ab_high = __builtin_shufflevector(a, b, 2, 10, 3, 11, 6, 14, 7, 15);
  const Lanes cd_low = __builtin_shufflevector(c, d, 0, 8, 1, 9, 4, 12, 5, 13);
  const Lanes cd_high = __builtin_shufflevector(c, d, 2, 10, 3, 11, 6, 14, 7, 15);
  const Lanes l04 = __builtin_shufflevector(ab_low, cd_low, 0, 1, 8, 9, 4, 5, 12, 13);
  const Lanes l15 = __builtin_shufflevector(ab_low, cd_low, 2, 3, 10, 11, 6, 7, 14, 15);
  const Lanes l26 = __builtin_shufflevector(ab_high, cd_high, 0, 1, 8, 9, 4, 5, 12, 13);
  const Lanes l37 = __builtin_shufflevector(ab_high, cd_high, 2, 3, 10, 11, 6, 7, 14, 15);
  out[0] = __builtin_shufflevector(l04, l04, 0, 1, 2, 3);
  out[1] = __builtin_shufflevector(l15, l15, 0, 1, 2, 3);
  out[2] = __builtin_shufflevector(l26, l26, 0, 1, 2, 3);
  out[3] = __builtin_shufflevector(l37, l37, 0, 1, 2, 3);
  out[4] = __builtin_shufflevector(l04, l04, 4, 5, 6, 7);
  out[5] = __builtin_shufflevector(l15, l15, 4, 5, 6, 7);
  out[6] = __builtin_shufflevector(l26, l26, 4, 5, 6, 7);
  out[7] = __builtin_shufflevector(l37, l37, 4, 5, 6, 7);
}

#else

using Int4 = std::int32_t __attribute__((vector_size(16)));

// Two registers of four. The same notation as the wide variant above.
struct Ints {
  Int4 low, high;
};
struct Lanes {
  Float4 low, high;
};

inline Lanes operator+(const Lanes& a, const Lanes& b) { return {a.low + b.low, a.high + b.high}; }
inline Lanes operator-(const Lanes& a, const Lanes& b) { return {a.low - b.low, a.high - b.high}; }
inline Lanes operator*(const Lanes& a, const Lanes& b) { return {a.low * b.low, a.high * b.high}; }
inline Lanes operator+(const Lanes& a, float b) { return {a.low + b, a.high + b}; }
inline Lanes operator*(const Lanes& a, float b) { return {a.low * b, a.high * b}; }
inline Lanes operator-(float a, const Lanes& b) { return {a - b.low, a - b.high}; }
inline Ints operator+(const Ints& a, const Ints& b) { return {a.low + b.low, a.high + b.high}; }
inline Ints operator*(const Ints& a, std::int32_t b) { return {a.low * b, a.high * b}; }

inline Lanes load(const float* source) {
  Lanes value;
  std::memcpy(&value, source, sizeof(value));
  return value;
}
inline void store(const Lanes& value, float* target) { std::memcpy(target, &value, sizeof(value)); }
inline void store(const Ints& value, std::int32_t* target) { std::memcpy(target, &value, sizeof(value)); }
inline Ints truncate(const Lanes& value) {
  return {__builtin_convertvector(value.low, Int4), __builtin_convertvector(value.high, Int4)};
}
inline Lanes to_float(const Ints& value) {
  return {__builtin_convertvector(value.low, Float4), __builtin_convertvector(value.high, Float4)};
}
inline Ints both(const Ints& a, const Ints& b) { return {a.low & b.low, a.high & b.high}; }
inline Ints at_least_zero(const Lanes& a) { return {a.low >= 0.F, a.high >= 0.F}; }
inline Ints below(const Lanes& a, float limit) { return {a.low < limit, a.high < limit}; }
inline Lanes keep(const Ints& mask, const Lanes& value) {
  Ints bits;
  std::memcpy(&bits, &value, sizeof(bits));
  bits = both(bits, mask);
  Lanes kept;
  std::memcpy(&kept, &bits, sizeof(kept));
  return kept;
}

inline void load_pairs(const float* base, const std::int32_t* index, Lanes* first, Lanes* second) {
  const Float4 ab = load_pairs(base + index[0], base + index[1]), cd = load_pairs(base + index[2], base + index[3]);
  const Float4 ef = load_pairs(base + index[4], base + index[5]), gh = load_pairs(base + index[6], base + index[7]);
  *first = {__builtin_shufflevector(ab, cd, 0, 2, 4, 6), __builtin_shufflevector(ef, gh, 0, 2, 4, 6)};
  *second = {__builtin_shufflevector(ab, cd, 1, 3, 5, 7), __builtin_shufflevector(ef, gh, 1, 3, 5, 7)};
}

inline void transpose(const Float4& a, const Float4& b, const Float4& c, const Float4& d, Float4* out) {
  const Float4 ab_low = __builtin_shufflevector(a, b, 0, 4, 1, 5), ab_high = __builtin_shufflevector(a, b, 2, 6, 3, 7);
  const Float4 cd_low = __builtin_shufflevector(c, d, 0, 4, 1, 5), cd_high = __builtin_shufflevector(c, d, 2, 6, 3, 7);
  out[0] = __builtin_shufflevector(ab_low, cd_low, 0, 1, 4, 5);
  out[1] = __builtin_shufflevector(ab_low, cd_low, 2, 3, 6, 7);
  out[2] = __builtin_shufflevector(ab_high, cd_high, 0, 1, 4, 5);
  out[3] = __builtin_shufflevector(ab_high, cd_high, 2, 3, 6, 7);
}

inline void transpose(const Lanes& a, const Lanes& b, const Lanes& c, const Lanes& d, Float4* out) {
  transpose(a.low, b.low, c.low, d.low, out);
  transpose(a.high, b.high, c.high, d.high, out + 4);
}

#endif

// One tap of eight pixels.
struct Placed {
  alignas(32) std::int32_t index[kLanes];   // array offset of the cell's first voxel
  alignas(32) std::int32_t inside[kLanes];  // rim only: -1 if the tap counts, else 0 (and index 0)
  Ints mask;
  Lanes x, y, z;  // position within the cell, [0, 1)
};

template <bool kRim>
inline void place(const TapList& taps, std::size_t t, const Lanes& cx, const Lanes& cy, const Lanes& cz,
                  Placed* placed) {
  Lanes x = ((cx + taps.term[0][t]) + taps.term[1][t]) + taps.term[2][t];
  Lanes y = ((cy + taps.term[3][t]) + taps.term[4][t]) + taps.term[5][t];
  Lanes z = ((cz + taps.term[6][t]) + taps.term[7][t]) + taps.term[8][t];
  if (kRim) {
    placed->mask =
        both(both(both(at_least_zero(x), below(x, taps.limit[0])), both(at_least_zero(y), below(y, taps.limit[1]))),
             both(at_least_zero(z), below(z, taps.limit[2])));
    store(placed->mask, placed->inside);
    x = keep(placed->mask, x);
    y = keep(placed->mask, y);
    z = keep(placed->mask, z);
  }
  // Positions are not negative: truncation is floor().
  const Ints ix = truncate(x), iy = truncate(y), iz = truncate(z);
  placed->x = x - to_float(ix);
  placed->y = y - to_float(iy);
  placed->z = z - to_float(iz);
  store(iz * taps.stride_z + iy * taps.stride_y + ix, placed->index);
}

template <bool kRim>
inline void gather_taps(const TapList& taps, const PixelBatch& batch, const float* volume, float* sums) {
  const Lanes cx = load(batch.x), cy = load(batch.y), cz = load(batch.z);
  Lanes sum = {};
  Placed placed;
  for (std::size_t t = 0; t < taps.count; ++t) {
    place<kRim>(taps, t, cx, cy, cz, &placed);
    // Products of weights, not v + w (u - v): a voxel outside a mask then cancels exactly, and a tiny share inside
    // keeps its relative accuracy.
    const Lanes x0 = 1.F - placed.x, y0 = 1.F - placed.y;
    const Lanes lower = (1.F - placed.z) * taps.value[t], upper = placed.z * taps.value[t];
    Lanes a, b, c, d;
    load_pairs(volume, placed.index, &a, &b);
    load_pairs(volume + taps.stride_y, placed.index, &c, &d);
    const Lanes below_tap = (x0 * a + placed.x * b) * y0 + (x0 * c + placed.x * d) * placed.y;
    load_pairs(volume + taps.stride_z, placed.index, &a, &b);
    load_pairs(volume + taps.stride_z + taps.stride_y, placed.index, &c, &d);
    const Lanes above_tap = (x0 * a + placed.x * b) * y0 + (x0 * c + placed.x * d) * placed.y;
    const Lanes term = below_tap * lower + above_tap * upper;
    sum = sum + (kRim ? keep(placed.mask, term) : term);
  }
  store(sum, sums);
}

void gather(const TapList& taps, const PixelBatch& batch, const float* volume, float* sums) {
  if (batch.rim) {
    gather_taps<true>(taps, batch, volume, sums);
  } else {
    gather_taps<false>(taps, batch, volume, sums);
  }
}

void weigh(const TapList& taps, const PixelBatch& batch, float* sums) {
  const Lanes cx = load(batch.x), cy = load(batch.y), cz = load(batch.z);
  Lanes sum = {};
  Placed placed;
  for (std::size_t t = 0; t < taps.count; ++t) {
    place<true>(taps, t, cx, cy, cz, &placed);
    sum = sum + keep(placed.mask, Lanes{} + taps.value[t]);
  }
  store(sum, sums);
}

// Calls add(lane, cell offset, shares of the lower plane, shares of the upper plane) for every tap inside; shares are
// {x0 y0, x1 y0, x0 y1, x1 y1} times PSF value and `scale` of the lane.
template <bool kRim, class Add>
inline void for_each_share(const TapList& taps, const PixelBatch& batch, const float* scale, const Add& add) {
  const Lanes cx = load(batch.x), cy = load(batch.y), cz = load(batch.z), scales = load(scale);
  Placed placed;
  Float4 lower[kLanes], upper[kLanes];
  for (std::size_t t = 0; t < taps.count; ++t) {
    place<kRim>(taps, t, cx, cy, cz, &placed);
    const Lanes value = scales * taps.value[t];
    const Lanes x0 = 1.F - placed.x, y0 = 1.F - placed.y;
    const Lanes a = x0 * y0, b = placed.x * y0, c = x0 * placed.y, d = placed.x * placed.y;
    const Lanes below_tap = (1.F - placed.z) * value, above_tap = placed.z * value;
    transpose(a * below_tap, b * below_tap, c * below_tap, d * below_tap, lower);
    transpose(a * above_tap, b * above_tap, c * above_tap, d * above_tap, upper);
    for (std::size_t lane = 0; lane < batch.count; ++lane) {
      if (!kRim || placed.inside[lane] != 0) add(lane, placed.index[lane], lower[lane], upper[lane]);
    }
  }
}

template <class Add>
inline void for_each_share(const TapList& taps, const PixelBatch& batch, const float* scale, const Add& add) {
  if (batch.rim) {
    for_each_share<true>(taps, batch, scale, add);
  } else {
    for_each_share<false>(taps, batch, scale, add);
  }
}

void scatter(const TapList& taps, const PixelBatch& batch, const float* value, float* volume) {
  const std::ptrdiff_t stride_y = taps.stride_y, stride_z = taps.stride_z;
  for_each_share(taps, batch, value, [=](std::size_t, std::ptrdiff_t index, const Float4& lower, const Float4& upper) {
    float* cell = volume + index;
    store_pairs(load_pairs(cell, cell + stride_y) + lower, cell, cell + stride_y);
    cell += stride_z;
    store_pairs(load_pairs(cell, cell + stride_y) + upper, cell, cell + stride_y);
  });
}

// Two neighbours' pairs (sum, weight) at `cell`.
inline void add_pairs(const Float4& terms, float* cell) {
  Float4 sum;
  std::memcpy(&sum, cell, sizeof(sum));
  sum += terms;
  std::memcpy(cell, &sum, sizeof(sum));
}

inline void add_pairs(const Float4& terms, double* cell) {
  for (int i = 0; i < 4; ++i) cell[i] += static_cast<double>(terms[i]);
}

template <class Real>
inline void scatter_any_pairs(const TapList& taps, const PixelBatch& batch, const float* value, const float* scale,
                              Real* pairs) {
  const std::ptrdiff_t stride_y = 2 * taps.stride_y, stride_z = 2 * std::ptrdiff_t{taps.stride_z};
  for_each_share(taps, batch, scale,
                 [=](std::size_t lane, std::ptrdiff_t index, const Float4& lower, const Float4& upper) {
                   const float v = value[lane];
                   const Float4 pattern = {v, 1.F, v, 1.F};
                   Real* cell = pairs + 2 * index;
                   add_pairs(__builtin_shufflevector(lower, lower, 0, 0, 1, 1) * pattern, cell);
                   add_pairs(__builtin_shufflevector(lower, lower, 2, 2, 3, 3) * pattern, cell + stride_y);
                   add_pairs(__builtin_shufflevector(upper, upper, 0, 0, 1, 1) * pattern, cell + stride_z);
                   add_pairs(__builtin_shufflevector(upper, upper, 2, 2, 3, 3) * pattern, cell + stride_z + stride_y);
                 });
}

void scatter_pairs(const TapList& taps, const PixelBatch& batch, const float* value, const float* scale, float* pairs) {
  scatter_any_pairs(taps, batch, value, scale, pairs);
}

void scatter_double_pairs(const TapList& taps, const PixelBatch& batch, const float* value, const float* scale,
                          double* pairs) {
  scatter_any_pairs(taps, batch, value, scale, pairs);
}

void combine_rows(const float* const* rows, const float* weight, std::size_t row_count, std::int64_t count,
                  float* out) {
  constexpr std::int64_t kStep = 4 * static_cast<std::int64_t>(kLanes);  // sums that fit into registers
  std::int64_t i = 0;
  for (; i + kStep <= count; i += kStep) {
    Lanes a = {}, b = {}, c = {}, d = {};
    for (std::size_t row = 0; row < row_count; ++row) {
      const float* source = rows[row] + i;
      a = a + load(source) * weight[row];
      b = b + load(source + kLanes) * weight[row];
      c = c + load(source + 2 * kLanes) * weight[row];
      d = d + load(source + 3 * kLanes) * weight[row];
    }
    store(a, out + i);
    store(b, out + i + kLanes);
    store(c, out + i + 2 * kLanes);
    store(d, out + i + 3 * kLanes);
  }
  for (; i < count; ++i) {
    float sum = 0.F;
    for (std::size_t row = 0; row < row_count; ++row) sum += rows[row][i] * weight[row];
    out[i] = sum;
  }
}

// Rounded as SliceTaps::centre(), which this is for several pixels.
void place_pixels(const SlicePlane& plane, const std::uint16_t* columns, const std::uint16_t* rows, PixelBatch* batch) {
  const float* m = plane.transform;
  float x[kLanes], y[kLanes];
  for (std::size_t lane = 0; lane < kLanes; ++lane) {
    x[lane] = static_cast<float>((static_cast<double>(columns[lane]) - plane.column_origin) * plane.resolution_ratio +
                                 static_cast<double>(m[3]));
    y[lane] = static_cast<float>((static_cast<double>(rows[lane]) - plane.row_origin) * plane.resolution_ratio +
                                 static_cast<double>(m[7]));
  }
  const float z = m[11];
  float* const target[3] = {batch->x, batch->y, batch->z};
  for (std::size_t axis = 0; axis < 3; ++axis) {
    for (std::size_t lane = 0; lane < kLanes; ++lane) {
      const float rotated = m[4 * axis] * x[lane] + m[4 * axis + 1] * y[lane] + m[4 * axis + 2] * z;
      target[axis][lane] = static_cast<float>(static_cast<double>(rotated) + plane.middle[axis]);
    }
  }
}

const TapKernels kKernels = {gather, weigh, scatter, scatter_pairs, scatter_double_pairs, combine_rows, place_pixels};
