#include "launch_losses.h"

#include <algorithm>
#include <limits>
#include <stdexcept>

namespace globalsplat::cuda {
namespace {

PhotometricPlanes planes_of(const raster::PhotometricJob<float>& job) {
  PhotometricPlanes planes{job.pictures, job.photos, job.width, job.height, {}};
  std::copy_n(raster::ssim_window<float>(), raster::kWindow, planes.window);
  return planes;
}

// Throws if there are more blocks than a launch may have.
Blocks blocks_of(int64_t count) {
  if (count > std::numeric_limits<int32_t>::max()) throw std::length_error("a call compares at most 2 billion tiles of images");
  return {count};
}

Blocks tiles_of(int64_t planes, int columns, int rows) {
  return blocks_of(planes * ceil_div(columns, kLossColumns) * ceil_div(rows, kLossRows));
}

}  // namespace

PartialSums photometric(const Device& device, const raster::PhotometricJob<float>& job, double l1_weight, double ssim_weight,
                        float* gradient) {
  const PhotometricPlanes planes = planes_of(job);
  const int columns = job.width - raster::kWindow + 1, rows = job.height - raster::kWindow + 1;
  const int64_t windows = int64_t(columns) * rows * job.planes, pixels = int64_t(job.width) * job.height * job.planes;
  const double each_window = ssim_weight / double(windows), each_pixel = l1_weight / double(pixels);
  const Blocks of_windows = ssim_weight != 0 ? tiles_of(job.planes, columns, rows) : Blocks{0};
  const Blocks of_pixels = l1_weight != 0 || gradient != nullptr ? tiles_of(job.planes, job.width, job.height) : Blocks{0};
  const int64_t count = of_windows.x + of_pixels.x;
  const Memory numbers = device.allocate(size_t(count) * sizeof(double));
  const Memory slopes =
      ssim_weight != 0 && gradient != nullptr ? device.allocate(size_t(3 * windows) * sizeof(float)) : Memory();
  auto* const of_block = static_cast<double*>(numbers.get());
  auto* const of_window = static_cast<float*>(slopes.get());
  GS_LAUNCH(device, gs_ssim, of_windows, kLossThreads, planes, each_window, of_window, of_block);
  GS_LAUNCH(device, gs_fit_gradient, of_pixels, kLossThreads, planes, of_window, each_pixel, float(each_window), gradient,
            of_block + of_windows.x);
  return {numbers, count};
}

PartialSums depth_smoothness(const Device& device, const raster::SmoothnessJob<float>& job, double factor, float* gradient) {
  const int64_t width = job.width, height = job.height;
  const int64_t pairs = job.views * ((width - 1) * height + width * (height - 1));
  const Blocks blocks = blocks_of((job.views * width * height + kLossThreads - 1) / kLossThreads);
  const Memory numbers = device.allocate(size_t(blocks.x) * sizeof(double));
  GS_LAUNCH(device, gs_unevenness, blocks, kLossThreads, job, pairs > 0 ? factor / double(pairs) : 0, gradient,
            static_cast<double*>(numbers.get()));
  return {numbers, blocks.x};
}

}  // namespace globalsplat::cuda
