// Portable SIMD vectors. The vector extensions of GCC and Clang provide arithmetic and comparisons on every machine. This file adds what
// they lack (fused multiply-add, masks in each machine's preferred form, approximations), once per instruction set. It is compiled several
// times with different instruction sets, so everything is in the namespace that the including kernel file names, and no templates of the
// standard library are instantiated: the linker would keep one copy for all instruction sets. If GS_LANE is defined, a vector is a single
// value.
#pragma once

#ifdef GS_LANE
#include "lane.h"
#else

#include <cmath>
#include <cstdint>

#include "types.h"

#if defined(__x86_64__)
#include <immintrin.h>
#elif defined(__aarch64__)
#include <arm_neon.h>
#endif

#define GS_INLINE inline __attribute__((always_inline))

namespace globalsplat::raster::GS_ISA {

// GS_X86(name) is the function of x86's intrinsics for vectors of kVectorBytes.
#if defined(__AVX512F__)
inline constexpr int kVectorBytes = 64;
#define GS_X86(name) _mm512_##name
#elif defined(__AVX2__)
inline constexpr int kVectorBytes = 32;
#define GS_X86(name) _mm256_##name
#else
inline constexpr int kVectorBytes = 16;
#define GS_X86(name) _mm_##name
#endif

// `bits` is the result of a comparison of vectors: −1 or 0 in every lane. `mask` is the form that the machine computes with: one bit per
// lane in a mask register on AVX-512, and `bits` elsewhere. `sum` is the type of a sum of products in add_fused(): a vector, or float64
// values if fused multiply-add is emulated.
template <class T>
struct Simd;

template <>
struct Simd<float> {
  static constexpr int lanes = kVectorBytes / 4;
  typedef float vector __attribute__((vector_size(kVectorBytes)));
  typedef int32_t bits __attribute__((vector_size(kVectorBytes)));
#if defined(__AVX512F__)
  typedef __mmask16 mask;
#else
  typedef bits mask;
#endif
#if defined(__SSE2__) && !defined(__AVX2__)
  struct sum {
    __m128d low, high;
  };
#else
  typedef vector sum;
#endif
};

template <>
struct Simd<double> {
  static constexpr int lanes = kVectorBytes / 8;
  typedef double vector __attribute__((vector_size(kVectorBytes)));
  typedef int64_t bits __attribute__((vector_size(kVectorBytes)));
#if defined(__AVX512F__)
  typedef __mmask8 mask;
#else
  typedef bits mask;
#endif
  typedef vector sum;
};

template <class T>
using Vector = typename Simd<T>::vector;
template <class T>
using Mask = typename Simd<T>::mask;
template <class T>
using FusedSum = typename Simd<T>::sum;

template <class T>
GS_INLINE Vector<T> broadcast(T value) {
  return value - Vector<T>{};
}

template <class T>
GS_INLINE Vector<T> load(const T* from) {
  Vector<T> v;
  __builtin_memcpy(&v, from, sizeof v);
  return v;
}

template <class T>
GS_INLINE void store(T* to, Vector<T> v) {
  __builtin_memcpy(to, &v, sizeof v);
}

// Loads a 4×4 block of values, with a stride of `stride` between rows, as vectors in row-major order.
template <class T>
GS_INLINE void load_rows(const T* first, int64_t stride, Vector<T>* out) {
  T rows[16];
  for (int j = 0; j < 4; ++j) __builtin_memcpy(rows + 4 * j, first + stride * j, 4 * sizeof(T));
  for (int k = 0; k < 16 / Simd<T>::lanes; ++k) out[k] = load<T>(rows + k * Simd<T>::lanes);
}

template <class T>
GS_INLINE void store_rows(const Vector<T>* in, T* first, int64_t stride) {
  T rows[16];
  for (int k = 0; k < 16 / Simd<T>::lanes; ++k) store<T>(rows + k * Simd<T>::lanes, in[k]);
  for (int j = 0; j < 4; ++j) __builtin_memcpy(first + stride * j, rows + 4 * j, 4 * sizeof(T));
}

#if defined(__AVX512F__)
// Kept in registers: the processor can't load in one piece what was just stored in four.
GS_INLINE void load_rows(const float* first, int64_t stride, Vector<float>* out) {
  const auto two = [&](const float* row) {
    return _mm256_insertf128_ps(_mm256_castps128_ps256(_mm_loadu_ps(row)), _mm_loadu_ps(row + stride), 1);
  };
  out[0] = _mm512_insertf32x8(_mm512_castps256_ps512(two(first)), two(first + 2 * stride), 1);
}
#elif defined(__AVX2__)
GS_INLINE void load_rows(const float* first, int64_t stride, Vector<float>* out) {
  for (int k = 0; k < 2; ++k, first += 2 * stride)
    out[k] = _mm256_insertf128_ps(_mm256_castps128_ps256(_mm_loadu_ps(first)), _mm_loadu_ps(first + stride), 1);
}
#endif

// fma(a, b, c) = a·b + c and fnma(a, b, c) = c − a·b, with one rounding on every machine, so that all machines agree which splats reach
// which pixels. Kernels are compiled without contraction, so nothing else is fused. float64 exists to verify gradients, and is rounded
// twice on machines without fused instructions.
#if defined(__AVX2__)
GS_INLINE Vector<float> fma(Vector<float> a, Vector<float> b, Vector<float> c) { return GS_X86(fmadd_ps)(a, b, c); }
GS_INLINE Vector<float> fnma(Vector<float> a, Vector<float> b, Vector<float> c) { return GS_X86(fnmadd_ps)(a, b, c); }
GS_INLINE Vector<double> fma(Vector<double> a, Vector<double> b, Vector<double> c) { return GS_X86(fmadd_pd)(a, b, c); }
GS_INLINE Vector<double> fnma(Vector<double> a, Vector<double> b, Vector<double> c) { return GS_X86(fnmadd_pd)(a, b, c); }
#elif defined(__aarch64__)
GS_INLINE Vector<float> fma(Vector<float> a, Vector<float> b, Vector<float> c) { return vfmaq_f32(c, a, b); }
GS_INLINE Vector<float> fnma(Vector<float> a, Vector<float> b, Vector<float> c) { return vfmsq_f32(c, a, b); }
GS_INLINE Vector<double> fma(Vector<double> a, Vector<double> b, Vector<double> c) { return vfmaq_f64(c, a, b); }
GS_INLINE Vector<double> fnma(Vector<double> a, Vector<double> b, Vector<double> c) { return vfmsq_f64(c, a, b); }
#else
#if defined(__SSE2__)
// The product of two floats is exact in float64. The sum rounded to float64 and then to float is nearly always equal to the sum rounded
// once.
GS_INLINE FusedSum<float> widened(Vector<float> v) { return {_mm_cvtps_pd(v), _mm_cvtps_pd(_mm_movehl_ps(v, v))}; }
GS_INLINE FusedSum<float> widened(float v) { return {_mm_set1_pd(v), _mm_set1_pd(v)}; }
GS_INLINE Vector<float> value_of(const FusedSum<float>& sum) { return _mm_movelh_ps(_mm_cvtpd_ps(sum.low), _mm_cvtpd_ps(sum.high)); }
GS_INLINE Vector<float> fused(const FusedSum<float>& a, const FusedSum<float>& b, const FusedSum<float>& c) {
  return value_of({a.low * b.low + c.low, a.high * b.high + c.high});
}
GS_INLINE Vector<float> fused_subtract(const FusedSum<float>& a, const FusedSum<float>& b, const FusedSum<float>& c) {
  return value_of({c.low - a.low * b.low, c.high - a.high * b.high});
}
GS_INLINE Vector<float> fma(Vector<float> a, Vector<float> b, Vector<float> c) { return fused(widened(a), widened(b), widened(c)); }
GS_INLINE Vector<float> fma(float a, Vector<float> b, Vector<float> c) { return fused(widened(a), widened(b), widened(c)); }
GS_INLINE Vector<float> fnma(Vector<float> a, Vector<float> b, Vector<float> c) {
  return fused_subtract(widened(a), widened(b), widened(c));
}
GS_INLINE Vector<float> fnma(Vector<float> a, Vector<float> b, float c) { return fused_subtract(widened(a), widened(b), widened(c)); }
GS_INLINE FusedSum<float> add_fused(Vector<float> weight, float number, FusedSum<float> sum) {
  const FusedSum<float> w = widened(weight), x = widened(number);
  const auto rounded = [](__m128d v) { return _mm_cvtps_pd(_mm_cvtpd_ps(v)); };
  return {rounded(w.low * x.low + sum.low), rounded(w.high * x.high + sum.high)};
}
#else
GS_INLINE Vector<float> fma(Vector<float> a, Vector<float> b, Vector<float> c) {
  for (int i = 0; i < Simd<float>::lanes; ++i) a[i] = __builtin_fmaf(a[i], b[i], c[i]);
  return a;
}
GS_INLINE Vector<float> fnma(Vector<float> a, Vector<float> b, Vector<float> c) { return fma(-a, b, c); }
#endif
GS_INLINE Vector<double> fma(Vector<double> a, Vector<double> b, Vector<double> c) { return a * b + c; }
GS_INLINE Vector<double> fnma(Vector<double> a, Vector<double> b, Vector<double> c) { return c - a * b; }
#endif

// Overloads with the same value in every lane.
template <class T>
GS_INLINE Vector<T> fma(T a, Vector<T> b, Vector<T> c) { return fma(broadcast<T>(a), b, c); }
template <class T>
GS_INLINE Vector<T> fnma(Vector<T> a, Vector<T> b, T c) { return fnma(a, b, broadcast<T>(c)); }

// Returns sum + weight·number.
template <class T>
GS_INLINE Vector<T> add_fused(Vector<T> weight, T number, Vector<T> sum) { return fma(number, weight, sum); }
template <class V>
GS_INLINE V value_of(V sum) { return sum; }

// fma() and fnma() for results whose last bit affects neither decisions nor images: rounded twice on machines that would have to emulate
// fusing.
#if defined(__AVX2__) || defined(__AVX512F__) || defined(__aarch64__)
template <class V>
GS_INLINE V add_product(V a, V b, V c) { return fma(a, b, c); }
template <class V>
GS_INLINE V subtract_product(V a, V b, V c) { return fnma(a, b, c); }
#else
template <class V>
GS_INLINE V add_product(V a, V b, V c) { return c + a * b; }
template <class V>
GS_INLINE V subtract_product(V a, V b, V c) { return c - a * b; }
#endif

// Comparisons are false if an operand is NaN.
#if defined(__AVX512F__)
GS_INLINE Mask<float> less(Vector<float> a, Vector<float> b) { return _mm512_cmp_ps_mask(a, b, _CMP_LT_OQ); }
GS_INLINE Mask<float> less_equal(Vector<float> a, Vector<float> b) { return _mm512_cmp_ps_mask(a, b, _CMP_LE_OQ); }
GS_INLINE Mask<double> less(Vector<double> a, Vector<double> b) { return _mm512_cmp_pd_mask(a, b, _CMP_LT_OQ); }
GS_INLINE Mask<double> less_equal(Vector<double> a, Vector<double> b) { return _mm512_cmp_pd_mask(a, b, _CMP_LE_OQ); }
GS_INLINE Vector<float> select(Mask<float> m, Vector<float> a, Vector<float> b) { return _mm512_mask_blend_ps(m, b, a); }
GS_INLINE Vector<double> select(Mask<double> m, Vector<double> a, Vector<double> b) { return _mm512_mask_blend_pd(m, b, a); }
GS_INLINE int lane_bits(Mask<float> m) { return m; }
GS_INLINE int lane_bits(Mask<double> m) { return m; }
#else
GS_INLINE Mask<float> less(Vector<float> a, Vector<float> b) { return a < b; }
GS_INLINE Mask<float> less_equal(Vector<float> a, Vector<float> b) { return a <= b; }
GS_INLINE Mask<double> less(Vector<double> a, Vector<double> b) { return a < b; }
GS_INLINE Mask<double> less_equal(Vector<double> a, Vector<double> b) { return a <= b; }
GS_INLINE Vector<float> select(Mask<float> m, Vector<float> a, Vector<float> b) { return m ? a : b; }
GS_INLINE Vector<double> select(Mask<double> m, Vector<double> a, Vector<double> b) { return m ? a : b; }
#if defined(__AVX2__)
GS_INLINE int lane_bits(Mask<float> m) { return _mm256_movemask_ps((__m256)m); }
GS_INLINE int lane_bits(Mask<double> m) { return _mm256_movemask_pd((__m256d)m); }
#elif defined(__SSE2__)
GS_INLINE int lane_bits(Mask<float> m) { return __builtin_ia32_movmskps((Vector<float>)m); }
GS_INLINE int lane_bits(Mask<double> m) { return __builtin_ia32_movmskpd((Vector<double>)m); }
#else
GS_INLINE int lane_bits(Mask<float> m) { return (m[0] & 1) | (m[1] & 2) | (m[2] & 4) | (m[3] & 8); }
GS_INLINE int lane_bits(Mask<double> m) { return int((m[0] & 1) | (m[1] & 2)); }
#endif
#endif

template <class M>
GS_INLINE M both(M a, M b) {
  return M(a & b);
}

template <class M>
GS_INLINE bool any(M m) {
  return lane_bits(m) != 0;
}

// Both functions return the second operand if either is NaN.
template <class V>
GS_INLINE V smaller(V a, V b) {
  return a < b ? a : b;
}
template <class V>
GS_INLINE V larger(V a, V b) {
  return a > b ? a : b;
}
// Single instructions, which compilers don't generate for the code above.
#if defined(__SSE2__)
GS_INLINE Vector<float> smaller(Vector<float> a, Vector<float> b) { return GS_X86(min_ps)(a, b); }
GS_INLINE Vector<float> larger(Vector<float> a, Vector<float> b) { return GS_X86(max_ps)(a, b); }
#endif
#if defined(__AVX512F__)
GS_INLINE Vector<double> smaller(Vector<double> a, Vector<double> b) { return _mm512_min_pd(a, b); }
GS_INLINE Vector<double> larger(Vector<double> a, Vector<double> b) { return _mm512_max_pd(a, b); }
#endif

// Returns |v|.
template <class V>
GS_INLINE V magnitude(V v) {
  return larger(v, -v);
}

// Returns 2^(1−k) for v in [2^k, 2^(k+1)), so that their product is in [2, 4). The result is infinite if v is 0 or subnormal, and 0 if v
// isn't finite.
template <class T>
GS_INLINE Vector<T> inverse_power_of_two(Vector<T> v) {
  typedef typename Simd<T>::bits Integers;
  const Integers exponents = (Integers)broadcast<T>(T(__builtin_inf()));
  return (Vector<T>)(exponents - ((Integers)v & exponents));
}

template <class V>
GS_INLINE V clamp(V v, V low, V high) {
  return smaller(larger(v, low), high);
}

#if defined(__AVX2__)
GS_INLINE Vector<float> sqrt(Vector<float> v) { return GS_X86(sqrt_ps)(v); }
GS_INLINE Vector<double> sqrt(Vector<double> v) { return GS_X86(sqrt_pd)(v); }
#elif defined(__aarch64__)
GS_INLINE Vector<float> sqrt(Vector<float> v) { return vsqrtq_f32(v); }
GS_INLINE Vector<double> sqrt(Vector<double> v) { return vsqrtq_f64(v); }
#else
GS_INLINE Vector<float> sqrt(Vector<float> v) {
  for (int i = 0; i < Simd<float>::lanes; ++i) v[i] = __builtin_sqrtf(v[i]);
  return v;
}
GS_INLINE Vector<double> sqrt(Vector<double> v) {
  for (int i = 0; i < Simd<double>::lanes; ++i) v[i] = __builtin_sqrt(v[i]);
  return v;
}
#endif

// Transposes four rows of four 32-bit elements of any type. `stride` and `to_stride` are distances between rows in elements.
GS_INLINE void transpose4(const void* from, int64_t stride, void* to, int64_t to_stride) {
  const char* const rows = static_cast<const char*>(from);
  char* const columns = static_cast<char*>(to);
#if defined(__SSE2__)
  __m128 row[4];
  for (int i = 0; i < 4; ++i) __builtin_memcpy(row + i, rows + 4 * i * stride, 16);
  _MM_TRANSPOSE4_PS(row[0], row[1], row[2], row[3]);
  for (int i = 0; i < 4; ++i) __builtin_memcpy(columns + 4 * i * to_stride, row + i, 16);
#elif defined(__aarch64__)
  uint32x4_t row[4];
  for (int i = 0; i < 4; ++i) __builtin_memcpy(row + i, rows + 4 * i * stride, 16);
  for (int i = 0; i < 2; ++i) {
    // Columns i and i + 2 of the upper and of the lower two rows.
    const uint64x2_t upper = (uint64x2_t)(i ? vtrn2q_u32(row[0], row[1]) : vtrn1q_u32(row[0], row[1]));
    const uint64x2_t lower = (uint64x2_t)(i ? vtrn2q_u32(row[2], row[3]) : vtrn1q_u32(row[2], row[3]));
    const uint64x2_t column[2] = {vtrn1q_u64(upper, lower), vtrn2q_u64(upper, lower)};
    for (int k = 0; k < 2; ++k) __builtin_memcpy(columns + 4 * (i + 2 * k) * to_stride, column + k, 16);
  }
#else
  for (int i = 0; i < 4; ++i)
    for (int j = 0; j < 4; ++j) __builtin_memcpy(columns + 4 * (j * to_stride + i), rows + 4 * (i * stride + j), 4);
#endif
}

// Computes 1/v with an error of 2e-7: an estimate of 12 or 14 bits and one step of Newton's method. No decision depends on it.
#if defined(__AVX2__)
GS_INLINE Vector<float> reciprocal(Vector<float> v) {
#if defined(__AVX512F__)
  const Vector<float> estimate = _mm512_rcp14_ps(v);
#else
  const Vector<float> estimate = _mm256_rcp_ps(v);
#endif
  return fma(fnma(v, estimate, broadcast<float>(1)), estimate, estimate);
}
#else
GS_INLINE Vector<float> reciprocal(Vector<float> v) { return 1.0f / v; }
#endif
GS_INLINE Vector<double> reciprocal(Vector<double> v) { return 1.0 / v; }

// Unsigned 32-bit lanes, which may overflow.
typedef uint32_t Bits __attribute__((vector_size(kVectorBytes)));

// Returns element i mod 8 of kExp2Eighths for each lane i.
#if defined(__AVX512F__)
GS_INLINE Bits eighth(Bits i) {
  return (Bits)_mm512_permutexvar_epi32((__m512i)i, _mm512_broadcast_i64x4(_mm256_loadu_si256((const __m256i*)kExp2Eighths)));
}
#elif defined(__AVX2__)
GS_INLINE Bits eighth(Bits i) {
  return (Bits)_mm256_permutevar8x32_epi32(_mm256_loadu_si256((const __m256i*)kExp2Eighths), (__m256i)i);
}
#elif defined(__x86_64__)
GS_INLINE Bits eighth(Bits i) {
  const __m128i wanted = (__m128i)(i % 8);
  const uint64_t low = uint64_t(_mm_cvtsi128_si64(wanted)), high = uint64_t(_mm_cvtsi128_si64(_mm_unpackhi_epi64(wanted, wanted)));
  return Bits{kExp2Eighths[uint32_t(low)], kExp2Eighths[low >> 32], kExp2Eighths[uint32_t(high)], kExp2Eighths[high >> 32]};
}
#elif defined(__aarch64__)
GS_INLINE Bits eighth(Bits i) {
  const uint8x16_t bytes = (uint8x16_t)(i % 8 * 0x04040404 + 0x03020100);  // the positions of an element's four bytes
  return (Bits)vqtbl2q_u8(vld1q_u8_x2((const uint8_t*)kExp2Eighths), bytes);
}
#else
GS_INLINE Bits eighth(Bits i) {
  for (int lane = 0; lane < Simd<float>::lanes; ++lane) i[lane] = kExp2Eighths[i[lane] % 8];
  return i;
}
#endif

// 2^x in two steps, so that other work can be done in between. x = i/8 + f with |f| ≤ 1/16; 2^f is a polynomial of degree 3, and 2^(i/8) is
// a table entry to whose exponent the integer part of i/8 is added. The relative error is below 1.7e-7 for x ≥ −126; results for smaller x
// are undefined. Nothing is fused, so that all machines give the same bits, including those without fused instructions. This costs little:
// an addition takes no longer than a multiplication, and runs on another execution unit.
template <class T>
struct Exp2;
template <>
struct Exp2<float> {
  Vector<float> f, power;
};
template <>
struct Exp2<double> {
  Vector<double> x;
};

GS_INLINE Exp2<float> begin_exp2(Vector<float> x) {
  const Vector<float> magic = broadcast<float>(kToEighths), shifted = x + magic;  // rounds to eighths; the low bits hold their number
  const Bits i = (Bits)shifted;
  return {x - (shifted - magic), (Vector<float>)(eighth(i) + (i << 20))};
}

// Returns the power for lanes in which `m` is true, and 0 for others.
GS_INLINE Vector<float> end_exp2(Mask<float> m, const Exp2<float>& of) {
  const auto c = [](int k) { return broadcast<float>(kExp2[k]); };
  const Vector<float> p = ((c(3) * of.f + c(2)) * of.f + c(1)) * of.f + c(0);
  return select(m, p * of.power, Vector<float>{});
}

// float64 exists to verify gradients, so it uses the library's exponential.
GS_INLINE Exp2<double> begin_exp2(Vector<double> x) { return {x}; }
GS_INLINE Vector<double> end_exp2(Mask<double> m, const Exp2<double>& of) {
  Vector<double> power;
  for (int i = 0; i < Simd<double>::lanes; ++i) power[i] = __builtin_exp2(of.x[i]);
  return select(m, power, Vector<double>{});
}

// Computes 2^x for lanes in which `m` is true, and 0 for others.
template <class M, class V>
GS_INLINE V exp2_where(M m, V x) {
  return end_exp2(m, begin_exp2(x));
}

// Computes the logarithm to base 2 in float64 and rounds it.
template <class T>
GS_INLINE Vector<T> log2_of(Vector<T> v) {
  for (int lane = 0; lane < Simd<T>::lanes; ++lane) v[lane] = T(__builtin_log2(double(v[lane])));
  return v;
}

// Copies to `out`, in order, those of `count` values whose flags have bit `bit` set, and returns their number. `out` must have kListPadding
// additional elements.
inline constexpr int kListPadding = 16;
#if defined(__AVX512F__)
GS_INLINE int compress(const uint32_t* values, const uint32_t* flags, int count, int bit, uint32_t* out) {
  const __m512i wanted = _mm512_set1_epi32(1 << bit);
  int length = 0;
  for (int i = 0; i < count; i += 16) {
    const __mmask16 valid = __mmask16(count - i < 16 ? (1u << (count - i)) - 1 : 0xFFFFu);
    const __mmask16 chosen = _mm512_mask_test_epi32_mask(valid, _mm512_maskz_loadu_epi32(valid, flags + i), wanted);
    _mm512_storeu_si512(out + length, _mm512_maskz_compress_epi32(chosen, _mm512_maskz_loadu_epi32(valid, values + i)));
    length += __builtin_popcount(chosen);
  }
  return length;
}
#else
GS_INLINE int compress(const uint32_t* values, const uint32_t* flags, int count, int bit, uint32_t* out) {
  int length = 0;
  for (int i = 0; i < count; ++i) {
    out[length] = values[i];
    length += (flags[i] >> bit) & 1;
  }
  return length;
}
#endif

// Loads `count` values and sets the other lanes to 0.
template <class T>
GS_INLINE Vector<T> load_partial(const T* from, int count) {
  if (count >= Simd<T>::lanes) return load<T>(from);
  T lane[Simd<T>::lanes] = {};
  __builtin_memcpy(lane, from, size_t(count) * sizeof(T));
  return load<T>(lane);
}

#if defined(__AVX512F__)
template <>
GS_INLINE Vector<float> load_partial<float>(const float* from, int count) {
  return _mm512_maskz_loadu_ps(__mmask16(count >= 16 ? 0xFFFF : (1 << count) - 1), from);
}
#elif defined(__AVX2__)
template <>
GS_INLINE Vector<float> load_partial<float>(const float* from, int count) {
  if (count >= 8) return load<float>(from);
  const __m256i lane = _mm256_setr_epi32(0, 1, 2, 3, 4, 5, 6, 7);
  return _mm256_maskload_ps(from, _mm256_cmpgt_epi32(_mm256_set1_epi32(count), lane));
}
#endif

// Loads the element of each lane's index.
GS_INLINE Vector<float> gather(const float* from, Simd<float>::bits index) {
#if defined(__AVX512F__)
  return _mm512_i32gather_ps((__m512i)index, from, 4);
#elif defined(__AVX2__)
  return _mm256_i32gather_ps(from, (__m256i)index, 4);
#else
  Vector<float> v;
  for (int i = 0; i < Simd<float>::lanes; ++i) v[i] = from[index[i]];
  return v;
#endif
}

template <class T>
GS_INLINE void store_partial(T* to, Vector<T> v, int count) {
  if (count >= Simd<T>::lanes) return store<T>(to, v);
  T lane[Simd<T>::lanes];
  store<T>(lane, v);
  __builtin_memcpy(to, lane, size_t(count) * sizeof(T));
}

template <class T>
GS_INLINE double sum_of_lanes(Vector<T> v) {
  T lane[Simd<T>::lanes];
  store<T>(lane, v);
  double sum = 0;
  for (const T value : lane) sum += double(value);
  return sum;
}

#if defined(__AVX512F__)
GS_INLINE float largest_lane(Vector<float> v) { return _mm512_reduce_max_ps(v); }
#else
GS_INLINE float largest_lane(Vector<float> v) {
  float largest = v[0];
  for (int lane = 1; lane < Simd<float>::lanes; ++lane) largest = v[lane] > largest ? v[lane] : largest;
  return largest;
}
#endif

// Computes out[k] = the sum of v[k]'s lanes, in an order that is the same in every call.
template <class T, int count>
GS_INLINE void sum_each(const Vector<T> (&v)[count], T* out) {
  for (int k = 0; k < count; ++k) {
    T lane[Simd<T>::lanes];
    store<T>(lane, v[k]);
    for (int half = Simd<T>::lanes / 2; half > 0; half /= 2)
      for (int i = 0; i < half; ++i) lane[i] += lane[i + half];
    out[k] = lane[0];
  }
}

#if defined(__AVX512F__)
// Folds pairs of vectors into one that holds the sums of both: 16 vectors become one vector of 16 sums in four levels.
template <int count>
GS_INLINE void sum_each(const Vector<float> (&v)[count], float* out) {
  static_assert(count <= 16);
  __m512 level[16];
  for (int k = 0; k < 16; ++k) level[k] = k < count ? (__m512)v[k] : _mm512_setzero_ps();
  // Vectors k and k + 4, and then the result and that of k + 8 and k + 12, share a vector, with a quarter of it each.
  __m512 quarter[4];
  for (int k = 0; k < 4; ++k) {
    const auto fold = [](__m512 a, __m512 b) {
      return _mm512_add_ps(_mm512_shuffle_f32x4(a, b, 0x44), _mm512_shuffle_f32x4(a, b, 0xEE));
    };
    const __m512 low = fold(level[k], level[k + 4]), high = fold(level[k + 8], level[k + 12]);
    quarter[k] = _mm512_add_ps(_mm512_shuffle_f32x4(low, high, 0x88), _mm512_shuffle_f32x4(low, high, 0xDD));
  }
  const auto interleave = [](__m512 a, __m512 b) {
    return _mm512_add_ps(_mm512_unpacklo_ps(a, b), _mm512_unpackhi_ps(a, b));
  };
  const __m512 even = interleave(quarter[0], quarter[1]), odd = interleave(quarter[2], quarter[3]);
  const __m512 sums = _mm512_add_ps(_mm512_shuffle_ps(even, odd, 0x44), _mm512_shuffle_ps(even, odd, 0xEE));
  _mm512_mask_storeu_ps(out, __mmask16((1 << count) - 1), sums);
}
#elif defined(__AVX2__)
template <int count>
GS_INLINE void sum_each(const Vector<float> (&v)[count], float* out) {
  static_assert(count <= 12 && count > 8);
  const auto at = [&](int k) { return k < count ? (__m256)v[k] : _mm256_setzero_ps(); };
  float sums[12];
  for (int k = 0; k < 12; k += 4) {
    const __m256 four = _mm256_hadd_ps(_mm256_hadd_ps(at(k), at(k + 1)), _mm256_hadd_ps(at(k + 2), at(k + 3)));
    _mm_storeu_ps(sums + k, _mm_add_ps(_mm256_castps256_ps128(four), _mm256_extractf128_ps(four, 1)));
  }
  __builtin_memcpy(out, sums, count * sizeof(float));
}
#endif

}  // namespace globalsplat::raster::GS_ISA
#endif
