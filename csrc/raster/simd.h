// Vectors of pixels. GCC's and Clang's vector extensions give arithmetic and comparisons on every machine; what they
// lack (fused multiply-add, mask tests) is here, once per instruction set. This file is compiled several times with
// different instruction sets, so everything is inside the namespace that the including kernel file names.
#pragma once

#include <cmath>
#include <cstdint>

#if defined(__AVX2__) || defined(__AVX512F__)
#include <immintrin.h>
#elif defined(__aarch64__)
#include <arm_neon.h>
#endif

#define GS_INLINE inline __attribute__((always_inline))

namespace globalsplat::raster::GS_ISA {

#if defined(__AVX512F__)
inline constexpr int kVectorBytes = 64;
#elif defined(__AVX2__)
inline constexpr int kVectorBytes = 32;
#else
inline constexpr int kVectorBytes = 16;
#endif

template <class T>
struct Simd;

template <>
struct Simd<float> {
  static constexpr int lanes = kVectorBytes / 4;
  typedef float vector __attribute__((vector_size(kVectorBytes)));
  typedef int32_t mask __attribute__((vector_size(kVectorBytes)));  // −1 where true, 0 where false
};

template <>
struct Simd<double> {
  static constexpr int lanes = kVectorBytes / 8;
  typedef double vector __attribute__((vector_size(kVectorBytes)));
  typedef int64_t mask __attribute__((vector_size(kVectorBytes)));
};

template <class T>
using Vector = typename Simd<T>::vector;
template <class T>
using Mask = typename Simd<T>::mask;

// a·b + c in one rounding where the machine can. Kernels are compiled without contraction, so this is the only source
// of fused operations and a forward pass and its backward replay take the same decisions bit for bit.
GS_INLINE Vector<float> fma(Vector<float> a, Vector<float> b, Vector<float> c) {
#if defined(__AVX512F__)
  return _mm512_fmadd_ps(a, b, c);
#elif defined(__AVX2__)
  return _mm256_fmadd_ps(a, b, c);
#elif defined(__aarch64__)
  return vfmaq_f32(c, a, b);
#else
  return a * b + c;
#endif
}

GS_INLINE Vector<double> fma(Vector<double> a, Vector<double> b, Vector<double> c) {
#if defined(__AVX512F__)
  return _mm512_fmadd_pd(a, b, c);
#elif defined(__AVX2__)
  return _mm256_fmadd_pd(a, b, c);
#elif defined(__aarch64__)
  return vfmaq_f64(c, a, b);
#else
  return a * b + c;
#endif
}

GS_INLINE bool any(Mask<float> m) {
#if defined(__AVX512F__)
  return _mm512_movepi32_mask((__m512i)m) != 0;
#elif defined(__AVX2__)
  return _mm256_movemask_ps((__m256)m) != 0;
#else
  return (m[0] | m[1] | m[2] | m[3]) != 0;
#endif
}

GS_INLINE bool any(Mask<double> m) {
#if defined(__AVX512F__)
  return _mm512_movepi64_mask((__m512i)m) != 0;
#elif defined(__AVX2__)
  return _mm256_movemask_pd((__m256d)m) != 0;
#else
  return (m[0] | m[1]) != 0;
#endif
}

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

// Lane sum by halving, the same order on every call.
template <class T>
GS_INLINE T sum(Vector<T> v) {
  T lane[Simd<T>::lanes];
  store<T>(lane, v);
  for (int half = Simd<T>::lanes / 2; half > 0; half /= 2)
    for (int i = 0; i < half; ++i) lane[i] += lane[i + half];
  return lane[0];
}

// e^x for x in [−87, 0]: x = n·ln 2 + r with |r| ≤ ln 2 / 2, Taylor to r⁷ (remainder 5e-9), exponent bits plus n.
// Measured over the whole range: relative error below 1.2e-7.
GS_INLINE Vector<float> exp(Vector<float> x) {
  using V = Vector<float>;
  const V magic = broadcast<float>(12582912.0f);  // 1.5·2²³: adding it rounds to an integer in the low bits
  const V shifted = fma(x, broadcast<float>(1.44269504089f), magic);
  const V n = shifted - magic;
  V r = fma(n, broadcast<float>(-0.693359375f), x);       // ln 2 in two parts, the first exact in few bits
  r = fma(n, broadcast<float>(2.12194440055e-4f), r);
  V p = broadcast<float>(1.0f / 5040);
  p = fma(p, r, broadcast<float>(1.0f / 720));
  p = fma(p, r, broadcast<float>(1.0f / 120));
  p = fma(p, r, broadcast<float>(1.0f / 24));
  p = fma(p, r, broadcast<float>(1.0f / 6));
  p = fma(p, r, broadcast<float>(0.5f));
  p = fma(p, r, broadcast<float>(1.0f));
  p = fma(p, r, broadcast<float>(1.0f));
  return (V)((Mask<float>)p + ((Mask<float>)shifted << 23));
}

// float64 exists to prove gradients, so it takes the library's exponential.
GS_INLINE Vector<double> exp(Vector<double> x) {
  for (int i = 0; i < Simd<double>::lanes; ++i) x[i] = std::exp(x[i]);
  return x;
}

}  // namespace globalsplat::raster::GS_ISA
