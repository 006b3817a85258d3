// Arithmetic of structural similarity (spec 9.4) for windows and pixels; used by ssim.h and ../cuda/losses.h. For a window w of 11×11, x is
// the image, y the photo, m, n, p, q, r are the means of x, y, x², y² and xy, and s = 121/120:
//
//   SSIM = N C / (M V),   N = 2mn + C₁,  C = 2s(r − mn) + C₂,  M = m² + n² + C₁,  V = s(p − m² + q − n²) + C₂
//
//   ∂/∂p = −s SSIM / V,   ∂/∂r = 2s N / (M V),   ∂/∂m = 2n C/(M V) − 2m SSIM/M − 2m ∂/∂p − n ∂/∂r
//
// The gradient at a pixel sums over the windows that contain it:  w∗∂m + 2x (w∗∂p) + y (w∗∂r).
#pragma once

#include "simd.h"
#include "types.h"

namespace globalsplat::raster::GS_ISA {

// Means m, n, p, q and r of a window, in this order.
template <class T>
using WindowMeans = Vector<T>[5];
// Slopes ∂SSIM/∂m, ∂/∂p and ∂/∂r of a window, or their sums over the windows that contain a pixel.
template <class T>
using WindowSlopes = Vector<T>[3];

// Adds weighted pixels of the image and of the photo to the means.
template <class T>
GS_INLINE void add_pixels(Vector<T> weight, Vector<T> x, Vector<T> y, WindowMeans<T>& means) {
  const Vector<T> wx = weight * x, wy = weight * y;
  means[0] = means[0] + wx;
  means[1] = means[1] + wy;
  means[2] = add_product(wx, x, means[2]);
  means[3] = add_product(wy, y, means[3]);
  means[4] = add_product(wx, y, means[4]);
}

// Computes SSIM of a window, and its slopes if requested.
template <class T>
GS_INLINE Vector<T> similarity_of(const WindowMeans<T>& means, bool with_slopes, WindowSlopes<T>& slopes) {
  using V = Vector<T>;
  const V c1 = broadcast<T>(T(kSsimC1)), c2 = broadcast<T>(T(kSsimC2)), s = broadcast<T>(T(kSsimSample));
  const V m = means[0], n = means[1], squares = add_product(m, m, n * n);
  const V like = add_product(m + m, n, c1), varied = add_product(s + s, subtract_product(m, n, means[4]), c2);
  const V bright = squares + c1, variance = add_product(s, means[2] + means[3] - squares, c2);
  const V inverse = broadcast<T>(1) / (bright * variance);
  const V similarity = like * varied * inverse;
  if (!with_slopes) return similarity;
  const V to_p = -s * similarity * inverse * bright;
  const V to_r = (s + s) * like * inverse;
  const V half_to_m = n * varied * inverse - m * similarity * inverse * variance - m * to_p;
  slopes[0] = half_to_m + half_to_m - n * to_r;
  slopes[1] = to_p;
  slopes[2] = to_r;
  return similarity;
}

// Computes the gradient of `l1_weight` · |x − y| at a pixel, which is 0 if they are equal.
template <class T>
GS_INLINE Vector<T> gradient_of_difference(Vector<T> x, Vector<T> y, T l1_weight) {
  using V = Vector<T>;
  const V d = x - y, up = select(less(V{}, d), broadcast<T>(l1_weight), V{});
  return select(less(d, V{}), broadcast<T>(-l1_weight), up);
}

// Adds `ssim_weight` times the gradient of Σ SSIM at a pixel, from the weighted sums of the slopes of the windows that contain it.
template <class T>
GS_INLINE Vector<T> add_gradient_of_similarity(Vector<T> x, Vector<T> y, T ssim_weight, const WindowSlopes<T>& slopes, Vector<T> gradient) {
  return add_product(broadcast<T>(ssim_weight), add_product(x + x, slopes[1], add_product(y, slopes[2], slopes[0])), gradient);
}

}  // namespace globalsplat::raster::GS_ISA
