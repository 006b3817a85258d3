// One step of Adam (Kingma & Ba 2015) in one pass over memory, with decoupled weight decay (Loshchilov & Hutter 2019):
//
//   m ← m + (1 − β₁)(g − m),  v ← β₂ v + (1 − β₂) g²,  x ← (1 − decay) x − step_size · m / (√v / bias_correction2_sqrt + ε)
//
// where step_size is the learning rate over 1 − β₁ᵗ, bias_correction2_sqrt is √(1 − β₂ᵗ), and decay is the weight decay times the learning
// rate (spec 8.5).
#pragma once

#include "simd.h"
#include "types.h"

namespace globalsplat::raster::GS_ISA {

template <class T>
void adam(const AdamStep& step, const AdamState<T>& of, int64_t begin, int64_t end) {
  const T keep = T(1 - step.decay), step_size = T(step.step_size), fresh1 = T(1 - step.beta1), beta2 = T(step.beta2);
  const T fresh2 = T(1 - step.beta2), inverse_root = T(1 / step.bias_correction2_sqrt), epsilon = T(step.epsilon);
  T *const value = of.value, *const first = of.first, *const second = of.second;
  const T* const gradient = of.gradient;
#pragma GCC ivdep
  for (int64_t i = begin; i < end; ++i) {
    const T g = gradient[i];
    const T m = first[i] + fresh1 * (g - first[i]), v = beta2 * second[i] + fresh2 * g * g;
    first[i] = m;
    second[i] = v;
    value[i] = keep * value[i] - step_size * m / (T(__builtin_sqrt(v)) * inverse_root + epsilon);
  }
}

}  // namespace globalsplat::raster::GS_ISA
