// Edge-aware smoothness of the depths of an image, and its gradient (unevenness.h), a few rows at a time.
#pragma once

#include "simd.h"
#include "types.h"
#include "unevenness.h"

namespace globalsplat::raster::GS_ISA {

// Depths and gray values of one row in `scratch`, preceded by one zero and followed by a vector of zeros for pixels beyond the border.
template <class T>
struct SmoothRow {
  T *depth, *gray;
};

template <class T>
GS_INLINE void load_row(const SmoothnessPlane<T>& plane, int row, const SmoothRow<T>& to) {
  constexpr int lanes = Simd<T>::lanes;
  const bool inside = row >= 0 && row < plane.height;
  const int64_t pixels = int64_t(plane.width) * plane.height, first = int64_t(row) * plane.width;
  to.depth[0] = to.gray[0] = 0;
  for (int i = 0; i < plane.width + lanes; i += lanes) {
    const int left = inside && i < plane.width ? plane.width - i : 0;
    Vector<T> depth{}, gray{};
    if (left > 0) {
      const T* photo = plane.photo + first + i;
      depth = load_partial<T>(plane.depth + first + i, left);
      gray = gray_of<T>(load_partial<T>(photo, left), load_partial<T>(photo + pixels, left), load_partial<T>(photo + 2 * pixels, left));
    }
    store<T>(to.depth + 1 + i, depth);
    store<T>(to.gray + 1 + i, gray);
  }
}

// Returns the sum over pairs whose first pixel is in the rows [begin, end). If requested, writes `factor` times the gradient of the sum
// over all pairs at the pixels of these rows. `scratch` has loss_scratch_size(width) elements.
template <class T>
double unevenness(const SmoothnessPlane<T>& plane, T factor, int begin, int end, T* scratch) {
  using V = Vector<T>;
  constexpr int lanes = Simd<T>::lanes;
  const int stride = plane.width + 1 + 2 * lanes;
  SmoothRow<T> rows[3];
  for (int k = 0; k < 3; ++k) rows[k] = {scratch + 2 * k * stride, scratch + (2 * k + 1) * stride};
  load_row(plane, begin - 1, rows[0]);
  load_row(plane, begin, rows[1]);
  V sum{};
  for (int row = begin; row < end; ++row) {
    const int at = row - begin;
    const SmoothRow<T>&above = rows[at % 3], &own = rows[(at + 1) % 3], &below = rows[(at + 2) % 3];
    load_row(plane, row + 1, below);
    for (int i = 0; i < plane.width; i += lanes) {
      const V a = load<T>(own.depth + 1 + i), g = load<T>(own.gray + 1 + i);
      V gradient{};
      // Returns the value of the pairs with a neighbour, and adds their gradient to `gradient`.
      const auto pair = [&](const SmoothRow<T>& of, int column) {
        return unevenness_of<T>(a, g, load<T>(of.depth + column), load<T>(of.gray + column), gradient);
      };
      sum = sum + pair(own, i + 2) + pair(below, i + 1);
      if (plane.gradient == nullptr) continue;
      pair(own, i);
      pair(above, i + 1);
      store_partial<T>(plane.gradient + int64_t(row) * plane.width + i, gradient * factor, plane.width - i);
    }
  }
  return sum_of_lanes<T>(sum);
}

}  // namespace globalsplat::raster::GS_ISA
