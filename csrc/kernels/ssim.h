// Photometric distance of an image from a photo, and its gradient: L1 and structural similarity (ssim_window.h), for one
// channel, a few rows at a time.
#pragma once

#include "simd.h"
#include "ssim_window.h"
#include "types.h"

namespace globalsplat::raster::GS_ISA {

// Returns Σ SSIM over the windows whose first row is in [begin, end), and writes their slopes if requested. `scratch` has
// loss_scratch_size(width) elements, also in the functions below.
template <class T>
double ssim(const PhotometricPlane<T>& plane, int begin, int end, T* scratch) {
  using V = Vector<T>;
  constexpr int lanes = Simd<T>::lanes;
  const int width = plane.width, windows = width - kWindow + 1, stride = width + kWindow + lanes;
  const int64_t count = int64_t(windows) * (plane.height - kWindow + 1);
  V sum{};
  for (int row = begin; row < end; ++row) {
    // Sums along the columns: five rows of means are stored in `scratch`.
    for (int i = 0; i < width; i += lanes) {
      const T* x = plane.picture + int64_t(row) * width + i;
      const T* y = plane.photo + int64_t(row) * width + i;
      WindowMeans<T> means = {};
      for (int k = 0; k < kWindow; ++k, x += width, y += width)
        add_pixels<T>(broadcast<T>(plane.weights[k]), load_partial<T>(x, width - i), load_partial<T>(y, width - i), means);
      for (int j = 0; j < 5; ++j) store<T>(scratch + j * stride + i, means[j]);
    }
    // Sums along the row.
    for (int i = 0; i < windows; i += lanes) {
      WindowMeans<T> means = {};
      for (int k = 0; k < kWindow; ++k)
        for (int j = 0; j < 5; ++j)
          means[j] = add_product(broadcast<T>(plane.weights[k]), load<T>(scratch + j * stride + i + k), means[j]);
      WindowSlopes<T> of_window;
      V similarity = similarity_of<T>(means, plane.slopes != nullptr, of_window);
      const int left = windows - i;
      if (left < lanes) {
        T inside[lanes];
        store<T>(inside, similarity);
        similarity = load_partial<T>(inside, left);
      }
      sum = sum + similarity;
      if (plane.slopes == nullptr) continue;
      T* const slopes = plane.slopes + int64_t(row) * windows + i;
      for (int j = 0; j < 3; ++j) store_partial<T>(slopes + j * count, of_window[j], left);
    }
  }
  return sum_of_lanes<T>(sum);
}

// Returns Σ |x − y| over the rows [begin, end). If requested, writes the gradient there: `l1_weight` times that of Σ |x − y| plus
// `ssim_weight` times that of Σ SSIM. All slopes must be known unless `ssim_weight` is 0.
template <class T>
double photometric_gradient(const PhotometricPlane<T>& plane, T l1_weight, T ssim_weight, int begin, int end, T* scratch) {
  using V = Vector<T>;
  constexpr int lanes = Simd<T>::lanes;
  const int width = plane.width, windows = width - kWindow + 1, last = plane.height - kWindow;
  const int stride = width + kWindow + lanes;
  const int64_t count = int64_t(windows) * (last + 1);
  V sum{};
  // Windows before the first and after the last have zero slopes.
  for (int j = 0; j < 3 * stride; ++j) scratch[j] = 0;
  for (int row = begin; row < end; ++row) {
    // Sums along the columns of the windows that contain the row; the sum for window i is stored at index i + 10.
    const int first = row < kWindow ? 0 : row - kWindow + 1, stop = row < last ? row : last;
    for (int i = 0; ssim_weight != 0 && i < windows; i += lanes) {
      WindowSlopes<T> slopes = {};
      for (int at = first; at <= stop; ++at)
        for (int j = 0; j < 3; ++j)
          slopes[j] = add_product(broadcast<T>(plane.weights[row - at]),
                          load_partial<T>(plane.slopes + j * count + int64_t(at) * windows + i, windows - i), slopes[j]);
      for (int j = 0; j < 3; ++j) store<T>(scratch + j * stride + kWindow - 1 + i, slopes[j]);
    }
    // Sums along the row.
    for (int i = 0; i < width; i += lanes) {
      const int64_t at = int64_t(row) * width + i;
      const int left = width - i;
      const V x = load_partial<T>(plane.picture + at, left), y = load_partial<T>(plane.photo + at, left), d = x - y;
      V gradient = gradient_of_difference<T>(x, y, l1_weight);
      if (ssim_weight != 0) {
        WindowSlopes<T> slopes = {};
        for (int k = 0; k < kWindow; ++k)
          for (int j = 0; j < 3; ++j)
            slopes[j] = add_product(broadcast<T>(plane.weights[k]), load<T>(scratch + j * stride + i + k), slopes[j]);
        gradient = add_gradient_of_similarity<T>(x, y, ssim_weight, slopes, gradient);
      }
      sum = sum + larger(d, -d);
      if (plane.gradient != nullptr) store_partial<T>(plane.gradient + at, gradient, left);
    }
  }
  return sum_of_lanes<T>(sum);
}

}  // namespace globalsplat::raster::GS_ISA
