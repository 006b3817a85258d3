#include "frame.h"

#include <limits>
#include <stdexcept>
#include <utility>

namespace globalsplat::cuda {
namespace {

template <class T>
T* as(const Memory& memory) {
  return static_cast<T*>(memory.get());
}

template <class T>
Memory room_for(const Device& device, int64_t count) {
  return device.allocate(size_t(count) * sizeof(T));
}

Blocks for_each(int64_t items, int threads, int64_t rows = 1) { return {parts(items, threads), rows}; }

// A view's Gaussians, or pixels, are counted by 32 bits, and a launch has so many rows of blocks at the most.
constexpr int64_t kMostRows = 65535;

Call call_of(const Arguments& of) {
  const int64_t views = of.scenes * of.cameras;
  const int columns = parts(of.width, raster::kTile), rows = parts(of.height, raster::kTile);
  constexpr int64_t most = std::numeric_limits<int32_t>::max();
  if (views > kMostRows || views * of.gaussians.count > most || views * columns * rows > most)
    throw std::length_error("a GPU draws at most 65535 views, and 2 billion tiles and splats of all views, in one go");
  return {int(views), int(of.cameras), int(of.gaussians.count), of.gaussians.bases, {of.width, of.height, columns, rows}};
}

// Turns each of `rows` rows of counts into sums of those before; `totals` receives a row's sum.
void scan(const Device& device, int64_t rows, int64_t length, const Memory& counts, const Memory& totals) {
  // A warp is enough for few, and need not wait for others.
  const int threads = length <= 4 * kWarp * kScanItems ? kWarp : kSortThreads;
  GS_LAUNCH(device, gs_scan, Blocks{rows}, threads, int(length), as<uint32_t>(counts), as<uint64_t>(totals));
}

// Sorts keys of `bits` bits, with their values; equal ones keep their order.
void sort(const Device& device, uint32_t count, int bits, Memory& keys, Memory& values) {
  constexpr int digits = 1 << kDigitBits;
  const int64_t blocks = parts(count, kSortThreads * kSortItems);
  Memory sorted_keys = room_for<uint64_t>(device, count), sorted_values = room_for<uint32_t>(device, count);
  const Memory table = room_for<uint32_t>(device, digits * blocks), totals = room_for<uint64_t>(device, digits);
  for (int shift = 0; shift < bits; shift += kDigitBits) {
    GS_LAUNCH(device, gs_count_digits, Blocks{blocks}, kSortThreads, count, shift, as<uint64_t>(keys), as<uint32_t>(table));
    scan(device, digits, blocks, table, totals);
    GS_LAUNCH(device, gs_scatter, Blocks{blocks}, kSortThreads, count, shift, as<uint64_t>(keys), as<uint32_t>(values),
              as<uint32_t>(table), as<uint64_t>(totals), as<uint64_t>(sorted_keys), as<uint32_t>(sorted_values));
    std::swap(keys, sorted_keys);
    std::swap(values, sorted_values);
  }
}

// As many as the numbers below `count` need.
int bits_of(int64_t count) {
  int bits = 0;
  while (int64_t(1) << bits < count) ++bits;
  return bits;
}

}  // namespace

Seen::Seen(const Device& device, const Arguments& of)
    : call(call_of(of)),
      lenses(room_for<Lens<float>>(device, call.views)),
      splats(room_for<Splat<float>>(device, int64_t(call.views) * call.count)) {
  GS_LAUNCH(device, gs_lenses, for_each(call.views, kWarp), kWarp, call, float(of.eps2d), of.w2c, of.intrinsics,
            as<Lens<float>>(lenses));
  GS_LAUNCH(device, gs_project, for_each(call.count, kGaussianThreads, call.views), kGaussianThreads, call, of.gaussians,
            as<Lens<float>>(lenses), as<Splat<float>>(splats));
}

void Seen::backward(const Device& device, const Arguments& of, const SplatGradient<float>* records, const uint32_t* first,
                    const GaussianGradients<float>& out, float* w2c) const {
  const int warps = parts(call.count, kWarp);
  const Memory asked = w2c == nullptr ? Memory() : room_for<CameraGradient<float>>(device, int64_t(call.views) * warps);
  // Where there are several cameras, all warps of a block have the same Gaussians.
  const int gaussians = call.cameras > 1 ? kWarp : kGaussianThreads;
  GS_LAUNCH(device, gs_project_backward, for_each(call.count, gaussians, of.scenes), kGaussianThreads, call, of.gaussians,
            as<Lens<float>>(lenses), as<Splat<float>>(splats), records, first, out, as<CameraGradient<float>>(asked));
  if (w2c != nullptr)
    GS_LAUNCH(device, gs_sum_cameras, for_each(int64_t(call.views) * 16 * kWarp, kGaussianThreads), kGaussianThreads, call.views,
              warps, as<CameraGradient<float>>(asked), w2c);
}

Frame::Frame(const Device& device, const Arguments& of, const Pictures<float>& out) : seen_(device, of), count_(0) {
  const Call& call = seen_.call;
  const int64_t splats = int64_t(call.views) * call.count, tiles = int64_t(call.views) * call.grid.tiles();
  const int64_t groups = parts(call.count, kWarp) * int64_t(call.views);
  const Blocks blocks = for_each(call.count, kGaussianThreads, call.views);

  const Memory group_pairs = room_for<uint32_t>(device, groups), total = room_for<uint64_t>(device, 1);
  GS_LAUNCH(device, gs_cover, blocks, kGaussianThreads, call, as<Splat<float>>(seen_.splats), as<uint32_t>(group_pairs), nullptr,
            nullptr, nullptr, nullptr);
  scan(device, 1, groups, group_pairs, total);
  // The one number that has to be known here: how much memory pairs take.
  const uint64_t count = device.read(as<uint64_t>(total));
  if (count >= std::numeric_limits<uint32_t>::max())
    throw std::length_error("more than 4 billion (Gaussian, tile) pairs in one go");
  count_ = uint32_t(count);

  first_ = room_for<uint32_t>(device, splats + 1);
  entries_ = room_for<TileEntry>(device, count_);
  tile_start_ = room_for<uint32_t>(device, tiles + 1);
  Memory keys = room_for<uint64_t>(device, count_), values = room_for<uint32_t>(device, count_);
  const Memory pairs = room_for<TileEntry>(device, count_);
  GS_LAUNCH(device, gs_cover, blocks, kGaussianThreads, call, as<Splat<float>>(seen_.splats), as<uint32_t>(group_pairs),
            as<uint32_t>(first_), as<uint64_t>(keys), as<uint32_t>(values), as<TileEntry>(pairs));
  sort(device, count_, kDepthBits + bits_of(tiles), keys, values);
  GS_LAUNCH(device, gs_list, for_each(count_ > tiles ? int64_t(count_) : tiles + 1, kSortThreads), kSortThreads, count_,
            uint32_t(tiles), as<uint64_t>(keys), as<uint32_t>(values), as<TileEntry>(pairs), as<TileEntry>(entries_),
            as<uint32_t>(tile_start_));
  GS_LAUNCH(device, gs_blend, (Blocks{call.grid.tiles(), call.views}), kTileThreads, call, as<Splat<float>>(seen_.splats),
            as<TileEntry>(entries_), as<uint32_t>(tile_start_), out);
}

void Frame::backward(const Device& device, const Arguments& of, const Pictures<const float>& pictures,
                     const Pictures<const float>& gradients, const GaussianGradients<float>& out, float* w2c) const {
  const Call& call = seen_.call;
  const Memory records = room_for<SplatGradient<float>>(device, count_);
  GS_LAUNCH(device, gs_blend_backward, (Blocks{call.grid.tiles(), call.views}), kTileThreads, call,
            as<Splat<float>>(seen_.splats), as<TileEntry>(entries_), as<uint32_t>(tile_start_), pictures, gradients,
            as<SplatGradient<float>>(records));
  seen_.backward(device, of, as<SplatGradient<float>>(records), as<uint32_t>(first_), out, w2c);
}

}  // namespace globalsplat::cuda
