// Losses that compare images with photos, and their gradients: the kernels of ../kernels/ssim.h and smoothness.h for GPUs. Results have the
// same bits as on the CPU except for sums over blocks. Each block writes one weighted partial sum to `parts`.
#pragma once

#include "call.h"
#include "ssim_window.h"
#include "unevenness.h"
#include "warp.h"

namespace globalsplat::cuda {

// Number of columns that a tile's windows read, or whose windows contain its pixels.
inline constexpr int kLossReach = kLossColumns + raster::kWindow - 1;

// Sums over a block's threads in a fixed order; the result is valid in the first thread.
inline double block_sum(double value) {
  GS_SHARED(double, sums, [kLossThreads / kWarp]);
  for (int step = kWarp / 2; step > 0; step /= 2) value += __shfl_xor_sync(kAll, value, step);
  if (lane() == 0) sums[warp()] = value;
  __syncthreads();
  double total = 0;
  if (threadIdx.x == 0)
    for (const double sum : sums) total += sum;
  return total;
}

// Tile of a block: a part of a plane of `columns` × `rows` windows or pixels.
struct LossTile {
  LossTile(int columns, int rows) {
    const int across = ceil_div(columns, kLossColumns), tiles = across * ceil_div(rows, kLossRows), tile = int(blockIdx.x) % tiles;
    plane = int(blockIdx.x) / tiles;
    left = tile % across * kLossColumns;
    top = tile / across * kLossRows;
  }
  int64_t plane;
  int left, top;
};

extern "C" {

// Computes Σ SSIM of a tile of windows times `each`; writes the slopes to `slopes`, [planes, 3, H − 10, W − 10], if it isn't null. Windows
// are summed first along columns, then along rows.
__global__ void __launch_bounds__(kLossThreads) gs_ssim(PhotometricPlanes of, double each, float* slopes, double* parts) {
  const int columns = of.width - raster::kWindow + 1, rows = of.height - raster::kWindow + 1;
  const LossTile tile(columns, rows);
  const int64_t pixels = int64_t(of.width) * of.height, windows = int64_t(columns) * rows;
  GS_SHARED(float, sums, [5][kLossRows][kLossReach]);
  for (int k = int(threadIdx.x); k < kLossRows * kLossReach; k += kLossThreads) {
    const int row = tile.top + k / kLossReach, column = tile.left + k % kLossReach;
    raster::lane::WindowMeans<float> means = {};
    if (row < rows && column < of.width)
      for (int n = 0; n < raster::kWindow; ++n) {
        const int64_t at = tile.plane * pixels + int64_t(row + n) * of.width + column;
        raster::lane::add_pixels<float>(of.window[n], of.pictures[at], of.photos[at], means);
      }
    for (int j = 0; j < 5; ++j) sums[j][k / kLossReach][k % kLossReach] = means[j];
  }
  __syncthreads();
  double sum = 0;
  for (int k = int(threadIdx.x); k < kLossRows * kLossColumns; k += kLossThreads) {
    const int row = k / kLossColumns, column = k % kLossColumns;
    if (tile.top + row >= rows || tile.left + column >= columns) continue;
    raster::lane::WindowMeans<float> means = {};
    for (int n = 0; n < raster::kWindow; ++n)
      for (int j = 0; j < 5; ++j) means[j] = raster::lane::add_product(of.window[n], sums[j][row][column + n], means[j]);
    raster::lane::WindowSlopes<float> of_window;
    sum += raster::lane::similarity_of<float>(means, slopes != nullptr, of_window);
    if (slopes == nullptr) continue;
    float* const place = slopes + tile.plane * 3 * windows + int64_t(tile.top + row) * columns + tile.left + column;
    for (int j = 0; j < 3; ++j) place[j * windows] = of_window[j];
  }
  const double total = block_sum(sum);
  if (threadIdx.x == 0) parts[blockIdx.x] = each * total;
}

// Computes Σ |x − y| of a tile of pixels times `l1_weight`, and its gradient plus `ssim_weight` times that of Σ SSIM, from all windows'
// slopes if they aren't null. `gradient`, [planes, H, W], may be null.
__global__ void __launch_bounds__(kLossThreads)
    gs_fit_gradient(PhotometricPlanes of, const float* slopes, double l1_weight, float ssim_weight, float* gradient, double* parts) {
  const int columns = of.width - raster::kWindow + 1, last = of.height - raster::kWindow;
  const LossTile tile(of.width, of.height);
  const int64_t pixels = int64_t(of.width) * of.height, windows = int64_t(columns) * (last + 1);
  GS_SHARED(float, sums, [3][kLossRows][kLossReach]);
  if (slopes != nullptr) {
    for (int k = int(threadIdx.x); k < kLossRows * kLossReach; k += kLossThreads) {
      const int row = tile.top + k / kLossReach, column = tile.left + k % kLossReach - (raster::kWindow - 1);
      raster::lane::WindowSlopes<float> down = {};
      if (column >= 0 && column < columns)
        for (int at = row < raster::kWindow ? 0 : row - raster::kWindow + 1; at <= row && at <= last; ++at)
          for (int j = 0; j < 3; ++j)
            down[j] = raster::lane::add_product(
                of.window[row - at], slopes[(tile.plane * 3 + j) * windows + int64_t(at) * columns + column], down[j]);
      for (int j = 0; j < 3; ++j) sums[j][k / kLossReach][k % kLossReach] = down[j];
    }
    __syncthreads();
  }
  double sum = 0;
  for (int k = int(threadIdx.x); k < kLossRows * kLossColumns; k += kLossThreads) {
    const int row = k / kLossColumns, column = k % kLossColumns;
    if (tile.top + row >= of.height || tile.left + column >= of.width) continue;
    const int64_t at = tile.plane * pixels + int64_t(tile.top + row) * of.width + tile.left + column;
    const float x = of.pictures[at], y = of.photos[at];
    sum += raster::lane::magnitude(x - y);
    if (gradient == nullptr) continue;
    float slope = raster::lane::gradient_of_difference<float>(x, y, float(l1_weight));
    if (slopes != nullptr) {
      raster::lane::WindowSlopes<float> along = {};
      for (int n = 0; n < raster::kWindow; ++n)
        for (int j = 0; j < 3; ++j) along[j] = raster::lane::add_product(of.window[n], sums[j][row][column + n], along[j]);
      slope = raster::lane::add_gradient_of_similarity<float>(x, y, ssim_weight, along, slope);
    }
    gradient[at] = slope;
  }
  const double total = block_sum(sum);
  if (threadIdx.x == 0) parts[blockIdx.x] = l1_weight * total;
}

// Computes the unevenness of the pairs of one pixel per thread with the pixels to the right and below, times `each`; and the gradient from
// all four pairs, [views, H, W], if it isn't null.
__global__ void __launch_bounds__(kLossThreads) gs_unevenness(LossJob<float> of, double each, float* gradient, double* parts) {
  const int64_t k = int64_t(blockIdx.x) * kLossThreads + threadIdx.x, pixels = int64_t(of.width) * of.height;
  double sum = 0;
  if (k < of.count * pixels) {
    const int64_t view = k / pixels;
    const int row = int(k % pixels / of.width), column = int(k % of.width);
    const auto gray = [&](int64_t at) {
      const float* const photo = of.photos + 3 * view * pixels + at - view * pixels;
      return raster::lane::gray_of<float>(photo[0], photo[pixels], photo[2 * pixels]);
    };
    const float a = of.images[k], g = gray(k);
    float slope = 0;
    // Pixels beyond the border are empty.
    const auto pair = [&](bool is_there, int64_t other) {
      return raster::lane::unevenness_of<float>(a, g, is_there ? of.images[other] : 0, is_there ? gray(other) : 0, slope);
    };
    sum = pair(column + 1 < of.width, k + 1) + pair(row + 1 < of.height, k + of.width);
    if (gradient != nullptr) {
      pair(column > 0, k - 1);
      pair(row > 0, k - of.width);
      gradient[k] = slope * float(each);
    }
  }
  const double total = block_sum(sum);
  if (threadIdx.x == 0) parts[blockIdx.x] = each * total;
}

}  // extern "C"
}  // namespace globalsplat::cuda
