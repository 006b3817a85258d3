// Scalar replacement of simd.h for a thread of a GPU: each vector is one value. Except for reciprocal(), every function gives the same bits
// as a lane of any instruction set.
#pragma once

#include <cmath>
#include <cstdint>

#include "types.h"

#define GS_INLINE inline __attribute__((always_inline))

namespace globalsplat::raster::GS_ISA {

template <class T>
struct Simd {
  static constexpr int lanes = 1;
};
template <class T>
using Vector = T;
template <class T>
using Mask = bool;
template <class T>
using FusedSum = T;

template <class T>
GS_INLINE T broadcast(T value) {
  return value;
}

template <class T>
GS_INLINE T load(const T* from) {
  return *from;
}

template <class T>
GS_INLINE T load_partial(const T* from, int) {
  return *from;
}

template <class T>
GS_INLINE void store(T* to, T v) {
  *to = v;
}

GS_INLINE float fma(float a, float b, float c) { return ::fmaf(a, b, c); }
GS_INLINE float fnma(float a, float b, float c) { return ::fmaf(-a, b, c); }
GS_INLINE float add_fused(float weight, float number, float sum) { return fma(weight, number, sum); }
GS_INLINE float value_of(float sum) { return sum; }
GS_INLINE float add_product(float a, float b, float c) { return fma(a, b, c); }
GS_INLINE float subtract_product(float a, float b, float c) { return fnma(a, b, c); }
GS_INLINE float sqrt(float v) { return ::sqrtf(v); }
// Computes 1/v, accurate to the last bit but one like the vector version, in one instruction instead of ten.
GS_INLINE float reciprocal(float v) {
#ifdef __CUDACC__
  float result;
  asm("rcp.approx.ftz.f32 %0, %1;" : "=f"(result) : "f"(v));
  return result;
#else
  return 1.0f / v;
#endif
}

GS_INLINE float select(bool m, float a, float b) { return m ? a : b; }
GS_INLINE bool less(float a, float b) { return a < b; }
GS_INLINE bool less_equal(float a, float b) { return a <= b; }
GS_INLINE bool both(bool a, bool b) { return a & b; }
GS_INLINE bool any(bool m) { return m; }
GS_INLINE int lane_bits(bool m) { return m; }

// Both functions return the second operand if either is NaN.
GS_INLINE float smaller(float a, float b) { return a < b ? a : b; }
GS_INLINE float larger(float a, float b) { return a > b ? a : b; }
GS_INLINE float magnitude(float v) { return larger(v, -v); }
GS_INLINE float clamp(float v, float low, float high) { return smaller(larger(v, low), high); }

template <class T>
GS_INLINE T inverse_power_of_two(T v) {
  union {
    float number;
    uint32_t bits;
  } inverse{v};
  inverse.bits = 0x7F800000u - (inverse.bits & 0x7F800000u);
  return inverse.number;
}

struct Exp2Eighths {
  uint32_t operator()(uint32_t i) const { return kExp2Eighths[i % 8]; }
};
// Computes 2^x if `m` is true, and 0 otherwise. `eighths(i)` returns kExp2Eighths[i % 8].
template <class Eighths = Exp2Eighths>
GS_INLINE float exp2_where(bool m, float x, const Eighths& eighths = {}) {
  const float shifted = x + kToEighths, f = x - (shifted - kToEighths);
  const float p = ((kExp2[3] * f + kExp2[2]) * f + kExp2[1]) * f + kExp2[0];
  union {
    float number;
    uint32_t bits;
  } power, rounded{shifted};
  power.bits = eighths(rounded.bits) + (rounded.bits << 20);
  return m ? p * power.number : 0;
}

template <class T>
GS_INLINE T log2_of(T v) {
  return T(::log2(double(v)));
}

template <class T, int count>
GS_INLINE void sum_each(const T (&v)[count], T* out) {
  for (int k = 0; k < count; ++k) out[k] = v[k];
}

}  // namespace globalsplat::raster::GS_ISA
