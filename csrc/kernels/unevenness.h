// Unevenness of depths between two neighbouring pixels, weighted down at edges of the photo; used by smoothness.h and ../cuda/losses.h.
// With depths a and b and the photo's gray values g and h at the two pixels:
//
//   e^{−10 |g − h|} · 2 |a − b| / (a + b),    ∂/∂a = ± e^{−10 |g − h|} · 4b / (a + b)²
//
// Apart from the weight, this is approximately |ln a − ln b| for similar depths, and at most 2 at the border of an object (after Godard et
// al. 2017, eq. 3). Pairs with an empty pixel, z = 0, contribute 0.
#pragma once

#include "simd.h"
#include "types.h"

namespace globalsplat::raster::GS_ISA {

// Computes the mean of red, green and blue.
template <class T>
GS_INLINE Vector<T> gray_of(Vector<T> red, Vector<T> green, Vector<T> blue) {
  return (red + green + blue) * T(1. / 3);
}

// Returns the unevenness of a pair, and adds its gradient with respect to `a` to `gradient`.
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
