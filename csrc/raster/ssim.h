// How far a picture is from a photo, and the gradient: absolute differences and structural similarity (spec 9.4), one channel, a
// few rows at a time. Under a window w of 11×11 with x the picture, y the photo, m, n, p, q, r the means of x, y, x², y² and xy,
// and s = 121/120:
//
//   SSIM = N C / (M V),   N = 2mn + C₁,  C = 2s(r − mn) + C₂,  M = m² + n² + C₁,  V = s(p − m² + q − n²) + C₂
//
//   ∂/∂p = −s SSIM / V,   ∂/∂r = 2s N / (M V),   ∂/∂m = 2n C/(M V) − 2m SSIM/M − 2m ∂/∂p − n ∂/∂r
//
// and a pixel's gradient gathers those of the windows that it is in:  w∗∂m + 2x (w∗∂p) + y (w∗∂r).
#pragma once

#include "simd.h"
#include "types.h"

namespace globalsplat::raster::GS_ISA {

// Σ SSIM over the windows whose first row is in [begin, end), and their slopes where these are asked for. `room` has
// fit_room(width) numbers, and so below.
template <class T>
double ssim(const FitPlane<T>& plane, int begin, int end, T* room) {
  using V = Vector<T>;
  constexpr int lanes = Simd<T>::lanes;
  const int width = plane.width, windows = width - kWindow + 1, stride = width + kWindow + lanes;
  const int64_t count = int64_t(windows) * (plane.height - kWindow + 1);
  const V c1 = broadcast<T>(T(kSsimC1)), c2 = broadcast<T>(T(kSsimC2)), s = broadcast<T>(T(kSsimSample));
  V sum{};
  for (int row = begin; row < end; ++row) {
    // Down the columns: five rows of means go to `room`.
    for (int i = 0; i < width; i += lanes) {
      const T* x = plane.picture + int64_t(row) * width + i;
      const T* y = plane.photo + int64_t(row) * width + i;
      V m{}, n{}, p{}, q{}, r{};
      for (int k = 0; k < kWindow; ++k, x += width, y += width) {
        const V a = load_some<T>(x, width - i), b = load_some<T>(y, width - i), w = broadcast<T>(plane.weights[k]);
        const V wa = w * a, wb = w * b;
        m = m + wa;
        n = n + wb;
        p = add_product(wa, a, p);
        q = add_product(wb, b, q);
        r = add_product(wa, b, r);
      }
      const V means[] = {m, n, p, q, r};
      for (int j = 0; j < 5; ++j) store<T>(room + j * stride + i, means[j]);
    }
    // Along the row.
    for (int i = 0; i < windows; i += lanes) {
      V means[5] = {};
      for (int k = 0; k < kWindow; ++k)
        for (int j = 0; j < 5; ++j)
          means[j] = add_product(broadcast<T>(plane.weights[k]), load<T>(room + j * stride + i + k), means[j]);
      const V m = means[0], n = means[1], squares = add_product(m, m, n * n);
      const V like = add_product(m + m, n, c1), varied = add_product(s + s, take_product(m, n, means[4]), c2);
      const V bright = squares + c1, variance = add_product(s, means[2] + means[3] - squares, c2);
      const V inverse = broadcast<T>(1) / (bright * variance);
      const V similarity = like * varied * inverse;
      const int left = windows - i;
      sum = sum + (left < lanes ? select(first_lanes<T>(left), similarity, V{}) : similarity);
      if (plane.slopes == nullptr) continue;
      const V to_p = -s * similarity * inverse * bright;
      const V to_r = (s + s) * like * inverse;
      const V half_to_m = n * varied * inverse - m * similarity * inverse * variance - m * to_p;
      T* const slopes = plane.slopes + int64_t(row) * windows + i;
      store_some<T>(slopes, half_to_m + half_to_m - n * to_r, left);
      store_some<T>(slopes + count, to_p, left);
      store_some<T>(slopes + 2 * count, to_r, left);
    }
  }
  return sum_of_lanes<T>(sum);
}

// Σ |x − y| over the rows [begin, end), and, where it is asked for, the gradient there: `absolute` times that of Σ |x − y| plus
// `similar` times that of Σ SSIM, for which all slopes are known unless `similar` is 0.
template <class T>
double fit_gradient(const FitPlane<T>& plane, T absolute, T similar, int begin, int end, T* room) {
  using V = Vector<T>;
  constexpr int lanes = Simd<T>::lanes;
  const int width = plane.width, windows = width - kWindow + 1, last = plane.height - kWindow;
  const int stride = width + kWindow + lanes;
  const int64_t count = int64_t(windows) * (last + 1);
  V sum{};
  // Windows before the first and behind the last have no slope.
  for (int j = 0; j < 3 * stride; ++j) room[j] = 0;
  for (int row = begin; row < end; ++row) {
    // Down the columns of windows that the row is in; that of window i goes to place i + 10.
    const int first = row < kWindow ? 0 : row - kWindow + 1, stop = row < last ? row : last;
    for (int i = 0; similar != 0 && i < windows; i += lanes) {
      V slopes[3] = {};
      for (int at = first; at <= stop; ++at)
        for (int j = 0; j < 3; ++j)
          slopes[j] = add_product(broadcast<T>(plane.weights[row - at]),
                          load_some<T>(plane.slopes + j * count + int64_t(at) * windows + i, windows - i), slopes[j]);
      for (int j = 0; j < 3; ++j) store<T>(room + j * stride + kWindow - 1 + i, slopes[j]);
    }
    // Along the row.
    for (int i = 0; i < width; i += lanes) {
      const int64_t at = int64_t(row) * width + i;
      const int left = width - i;
      const V x = load_some<T>(plane.picture + at, left), y = load_some<T>(plane.photo + at, left), d = x - y;
      const V up = select(less(V{}, d), broadcast<T>(absolute), V{});
      V gradient = select(less(d, V{}), broadcast<T>(-absolute), up);
      if (similar != 0) {
        V slopes[3] = {};
        for (int k = 0; k < kWindow; ++k)
          for (int j = 0; j < 3; ++j)
            slopes[j] = add_product(broadcast<T>(plane.weights[k]), load<T>(room + j * stride + i + k), slopes[j]);
        gradient = add_product(broadcast<T>(similar), add_product(x + x, slopes[1], add_product(y, slopes[2], slopes[0])), gradient);
      }
      sum = sum + larger(d, -d);
      if (plane.gradient != nullptr) store_some<T>(plane.gradient + at, gradient, left);
    }
  }
  return sum_of_lanes<T>(sum);
}

}  // namespace globalsplat::raster::GS_ISA
