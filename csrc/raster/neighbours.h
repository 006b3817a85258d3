// How uneven depths are between two neighbouring pixels of which the photo tells little; smooth.h goes through pictures with it, and
// ../cuda/losses.h. With depths a and b and the photo's greys g and h there:
//
//   e^{−10 |g − h|} · 2 |a − b| / (a + b),    ∂/∂a = ± e^{−10 |g − h|} · 4b / (a + b)²
//
// which is |ln a − ln b| where depths are alike, and at most 2 where one thing ends before another (after Godard et al. 2017,
// eq. 3). A pair of which one shows nothing, z = 0, counts for nothing.
#pragma once

#include "simd.h"
#include "types.h"

namespace globalsplat::raster::GS_ISA {

// The mean of red, green and blue.
template <class T>
GS_INLINE Vector<T> grey_of(Vector<T> red, Vector<T> green, Vector<T> blue) {
  return (red + green + blue) * T(1. / 3);
}

// The value of a pair; its gradient with respect to `a` is added to `gradient`.
template <class T>
GS_INLINE Vector<T> unevenness_of(Vector<T> a, Vector<T> g, Vector<T> b, Vector<T> h, Vector<T>& gradient) {
  using V = Vector<T>;
  const V difference = a - b, total = a + b, step = g - h;
  const V exponent = larger(broadcast<T>(T(-kEdge * kLog2E)) * larger(step, -step), broadcast<T>(T(-126)));
  const Mask<T> counts = both(less(V{}, a), less(V{}, b));
  const V weight = exp2_where(counts, exponent);
  const V inverse = select(counts, broadcast<T>(1) / total, V{});
  const V slope = T(4) * weight * b * inverse * inverse;
  gradient = gradient + select(less(V{}, difference), slope, select(less(difference, V{}), -slope, V{}));
  return T(2) * weight * larger(difference, -difference) * inverse;
}

}  // namespace globalsplat::raster::GS_ISA
