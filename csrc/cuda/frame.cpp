#include "frame.h"

#include <algorithm>
#include <limits>
#include <stdexcept>

namespace globalsplat::cuda {
namespace {

template <class T>
T* as(const Memory& memory) {
  return static_cast<T*>(memory.get());
}

template <class T>
Memory allocate_array(const Device& device, int64_t count) {
  return device.allocate(size_t(count) * sizeof(T));
}

Blocks for_each(int64_t items, int threads_per_block, int64_t rows = 1) { return {ceil_div(items, threads_per_block), rows}; }

// Maximum number of rows of blocks in a launch. A view's Gaussians, or pixels, are counted by 32 bits.
constexpr int64_t kMaxRows = 65535;

Call call_of(const Arguments& of) {
  const int64_t views = of.scenes * of.cameras;
  const int columns = ceil_div(of.width, raster::kTile), rows = ceil_div(of.height, raster::kTile);
  constexpr int64_t most = std::numeric_limits<int32_t>::max();
  if (views > kMaxRows || views * of.gaussians.count > most || views * columns * rows > most)
    throw std::length_error("a call renders at most 65535 views, and at most 2 billion tiles or splats over all views");
  return {int(views), int(of.cameras), int(of.gaussians.count), of.gaussians.bases, {of.width, of.height, columns, rows}};
}

// Returns the number of starts of the tiles' lists, including the end of the last one.
int64_t places_of_tiles(const Call& call) { return int64_t(call.views) * call.grid.tiles() + 1; }

PhotometricPlanes planes_of(const raster::LossJob<float>& job) {
  PhotometricPlanes planes{job.images, job.photos, job.width, job.height, {}};
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

ProjectedScenes::ProjectedScenes(const Device& device, const Arguments& of, bool counts_tiles)
    : call(call_of(of)),
      params(allocate_array<ProjectionParams<float>>(device, call.views)),
      splats(allocate_array<Splat<float>>(device, int64_t(call.views) * call.count)),
      tile_counts(counts_tiles ? allocate_array<uint32_t>(device, places_of_tiles(call)) : Memory()) {
  const int64_t num_threads = counts_tiles ? std::max<int64_t>(call.views, places_of_tiles(call)) : call.views;
  GS_LAUNCH(device, gs_lenses, for_each(num_threads, kWarp), kWarp, call, of.projection, of.w2c,
            of.intrinsics, as<ProjectionParams<float>>(params), as<uint32_t>(tile_counts));
  GS_LAUNCH(device, gs_project, for_each(call.count, kGaussianThreads, call.views), kGaussianThreads, call, of.gaussians,
            as<ProjectionParams<float>>(params), as<Splat<float>>(splats));
}

void ProjectedScenes::backward(const Device& device, const Arguments& of, const SplatGradient<float>* records, const uint32_t* first,
                    const GaussianGradients<float>& out, float* w2c) const {
  const int warps = ceil_div(call.count, kWarp);
  const Memory camera_gradients = w2c == nullptr ? Memory() : allocate_array<CameraGradient<float>>(device, int64_t(call.views) * warps);
  // With several cameras, all warps of a block process the same Gaussians.
  const int gaussians = call.cameras > 1 ? kWarp : kGaussianThreads;
  GS_LAUNCH(device, gs_project_backward, for_each(call.count, gaussians, of.scenes), kGaussianThreads, call, of.gaussians,
            as<ProjectionParams<float>>(params), as<Splat<float>>(splats), records, first, out,
            as<CameraGradient<float>>(camera_gradients));
  if (w2c != nullptr)
    GS_LAUNCH(device, gs_sum_cameras, for_each(int64_t(call.views) * 16 * kWarp, kGaussianThreads), kGaussianThreads, call.views,
              warps, as<CameraGradient<float>>(camera_gradients), w2c);
}

Frame::Frame(const Device& device, const Arguments& of, const RenderOutput<float>& out) : projected_(device, of, true), count_(0) {
  const Call& call = projected_.call;
  const int64_t splats = int64_t(call.views) * call.count, places = places_of_tiles(call);
  const int64_t groups = ceil_div(call.count, kWarp) * int64_t(call.views);
  const Blocks blocks = for_each(call.count, kGaussianThreads, call.views);

  const Memory group_pairs = allocate_array<uint32_t>(device, groups), pairs_before = allocate_array<uint32_t>(device, groups);
  const Memory total = allocate_array<uint64_t>(device, 1);
  uint32_t* const tile_counts = as<uint32_t>(projected_.tile_counts);
  tile_start_ = allocate_array<uint32_t>(device, places);
  GS_LAUNCH(device, gs_cover, blocks, kGaussianThreads, call, as<Splat<float>>(projected_.splats), as<uint32_t>(group_pairs),
            tile_counts + 1, nullptr, nullptr, nullptr);
  // The prefix sum for a tile is stored one index after the tile's own, where it grows to that of the next tile.
  GS_LAUNCH(device, gs_scan, for_each(std::max(groups, places), kScanThreads * kScanItems, 2), kScanThreads,
            (Counts{groups, as<uint32_t>(group_pairs), as<uint32_t>(pairs_before)}),
            (Counts{places, tile_counts, as<uint32_t>(tile_start_)}), as<uint64_t>(total));
  // The only value that the host has to wait for: the number of pairs, which determines their memory.
  const uint64_t count = device.read(as<uint64_t>(total));
  // The margin lets indices run past the last pair by a few batches.
  if (count > std::numeric_limits<uint32_t>::max() - 1024)
    throw std::length_error("more than 4 billion (Gaussian, tile) pairs in one call");
  count_ = uint32_t(count);
  projected_.tile_counts.reset();

  first_ = allocate_array<uint32_t>(device, splats + 1);
  entries_ = allocate_array<TileEntry>(device, count_);
  const Memory keys = allocate_array<uint64_t>(device, count_), spare = allocate_array<uint64_t>(device, count_);
  const Memory pairs = allocate_array<TileEntry>(device, count_);
  GS_LAUNCH(device, gs_cover, blocks, kGaussianThreads, call, as<Splat<float>>(projected_.splats), as<uint32_t>(pairs_before),
            as<uint32_t>(tile_start_) + 1, as<uint32_t>(first_), as<uint64_t>(keys), as<TileEntry>(pairs));
  const Blocks tiles{call.grid.tiles(), call.views};
  GS_LAUNCH(device, gs_sort_lists, tiles, kSortThreads, call, as<uint32_t>(tile_start_), as<uint64_t>(keys),
            as<uint64_t>(spare), as<TileEntry>(pairs), as<TileEntry>(entries_));
  GS_LAUNCH(device, gs_blend, tiles, kTileThreads, call, as<Splat<float>>(projected_.splats), as<TileEntry>(entries_),
            as<uint32_t>(tile_start_), out);
}

void Frame::backward(const Device& device, const Arguments& of, const RenderOutput<const float>& pictures,
                     const RenderOutput<const float>& gradients, const GaussianGradients<float>& out, float* w2c) const {
  const Call& call = projected_.call;
  const Memory records = allocate_array<SplatGradient<float>>(device, count_);
  GS_LAUNCH(device, gs_blend_backward, (Blocks{call.grid.tiles(), call.views}), kTileThreads, call,
            as<Splat<float>>(projected_.splats), as<TileEntry>(entries_), as<uint32_t>(tile_start_), pictures, gradients,
            as<SplatGradient<float>>(records));
  projected_.backward(device, of, as<SplatGradient<float>>(records), as<uint32_t>(first_), out, w2c);
}

PartialSums photometric(const Device& device, const raster::LossJob<float>& job, double l1_weight, double ssim_weight,
                        float* gradient) {
  const PhotometricPlanes planes = planes_of(job);
  const int columns = job.width - raster::kWindow + 1, rows = job.height - raster::kWindow + 1;
  const int64_t windows = int64_t(columns) * rows * job.count, pixels = int64_t(job.width) * job.height * job.count;
  const double each_window = ssim_weight / double(windows), each_pixel = l1_weight / double(pixels);
  const Blocks of_windows = ssim_weight != 0 ? tiles_of(job.count, columns, rows) : Blocks{0};
  const Blocks of_pixels = l1_weight != 0 || gradient != nullptr ? tiles_of(job.count, job.width, job.height) : Blocks{0};
  const int64_t count = of_windows.x + of_pixels.x;
  const Memory numbers = allocate_array<double>(device, count);
  const Memory slopes =
      ssim_weight != 0 && gradient != nullptr ? allocate_array<float>(device, 3 * windows) : Memory();
  double* const of_block = as<double>(numbers);
  float* const of_window = as<float>(slopes);
  GS_LAUNCH(device, gs_ssim, of_windows, kLossThreads, planes, each_window, of_window, of_block);
  GS_LAUNCH(device, gs_fit_gradient, of_pixels, kLossThreads, planes, of_window, each_pixel, float(each_window), gradient,
            of_block + of_windows.x);
  return {numbers, count};
}

PartialSums depth_smoothness(const Device& device, const raster::LossJob<float>& job, double factor, float* gradient) {
  const int64_t width = job.width, height = job.height;
  const int64_t pairs = job.count * ((width - 1) * height + width * (height - 1));
  const Blocks blocks = blocks_of((job.count * width * height + kLossThreads - 1) / kLossThreads);
  const Memory numbers = allocate_array<double>(device, blocks.x);
  GS_LAUNCH(device, gs_unevenness, blocks, kLossThreads, job, pairs > 0 ? factor / double(pairs) : 0, gradient,
            as<double>(numbers));
  return {numbers, blocks.x};
}

}  // namespace globalsplat::cuda
