// Blends tiles, forward and backward: the maths of raster/pixel.h, a pixel a thread and a tile a block (spec 6.4 and 6.5).
//
// A warp has 8×4 pixels, two of a tile's 4×4 blocks side by side, and passes by the splats that reach neither.
#pragma once

#include "pixel.h"
#include "warp.h"

namespace globalsplat::cuda {

inline constexpr int kTileWarps = kTileThreads / kWarp;
inline constexpr int kBatch = kWarp;  // entries that are taken at a time
static_assert(sizeof(Splat<float>) == 64 && kTileThreads * 2 == kBatch * 16, "a batch's splats are two numbers a thread");

using Evaluated = raster::lane::Evaluated<float>;

// Bits of TileEntry::blocks that are this warp's: warps go by rows, two in each.
inline uint32_t own_blocks() { return 3u << (2 * warp()); }

// This thread's pixel.
struct Pixel {
  int x, y;
  bool inside;    // the picture
  int64_t place;  // in a plane

  explicit Pixel(const Grid& grid) {
    const int tile = int(blockIdx.x);
    x = tile % grid.columns * raster::kTile + warp() % 2 * 8 + lane() % 8;
    y = tile / grid.columns * raster::kTile + warp() / 2 * 4 + lane() / 8;
    inside = x < grid.width && y < grid.height;
    place = int64_t(y) * grid.width + x;
  }
  Evaluated evaluate(const Splat<float>& splat) const {
    Evaluated e;
    raster::lane::evaluate(splat, float(x) + 0.5f, float(y) + 0.5f, e);
    return e;
  }
};

// Of one view.
template <class Number>
inline Pictures<Number> pictures_of(const Pictures<Number>& all, const Grid& grid, int64_t view) {
  const int64_t plane = int64_t(grid.width) * grid.height;
  return {all.rgb + 3 * plane * view, all.alpha + plane * view, all.depth + plane * view};
}

extern "C" {

// Warps go on by themselves: each keeps those of a batch that reach its pixels.
__global__ void __launch_bounds__(kTileThreads)
    gs_blend(Call call, const Splat<float>* splats, const TileEntry* entries, const uint32_t* tile_start,
             Pictures<float> pictures) {
  GS_SHARED(Splat<float>, batches, [kTileWarps][kBatch]);
  Splat<float>(&batch)[kBatch] = batches[warp()];
  const int64_t tile = int64_t(blockIdx.y) * call.grid.tiles() + blockIdx.x;
  const Pixel pixel(call.grid);
  raster::lane::Pixels<float> sums{pixel.inside ? 1.0f : 0.0f};
  const uint32_t end = tile_start[tile + 1];
  for (uint32_t begin = tile_start[tile]; begin < end; begin += kBatch) {
    if (!__any_sync(kAll, sums.transmittance > 0)) break;
    const uint32_t at = begin + uint32_t(lane());
    const bool reaches = at < end && (entries[at].blocks & own_blocks()) != 0;
    const unsigned reaching = __ballot_sync(kAll, reaches);
    if (reaches) batch[__popc(reaching & before())] = splats[entries[at].splat];
    __syncwarp();
    for (int k = 0; k < __popc(reaching); ++k)
      raster::lane::add(batch[k], raster::lane::blend<float>(sums.transmittance, pixel.evaluate(batch[k]).raw), sums);
    __syncwarp();
  }
  if (!pixel.inside) return;
  const Pictures<float> out = pictures_of(pictures, call.grid, blockIdx.y);
  const int64_t plane = int64_t(call.grid.width) * call.grid.height;
  out.rgb[pixel.place] = sums.red;
  out.rgb[pixel.place + plane] = sums.green;
  out.rgb[pixel.place + 2 * plane] = sums.blue;
  out.alpha[pixel.place] = sums.alpha;
  out.depth[pixel.place] = raster::lane::expected_depth(sums);
}

// `pictures` are the forward pass's own, `gradients` the loss's with respect to them; one record per entry is written. A splat's
// sums are added up over each warp's pixels, then over warps, always in the same order.
__global__ void __launch_bounds__(kTileThreads)
    gs_blend_backward(Call call, const Splat<float>* splats, const TileEntry* entries, const uint32_t* tile_start,
                      Pictures<const float> pictures, Pictures<const float> gradients, SplatGradient<float>* records) {
  constexpr int kNumbers = raster::kSplatGradientNumbers;
  GS_SHARED(Splat<float>, batch, [kBatch]);
  GS_SHARED(float, of_warps, [kTileWarps][kBatch][kNumbers]);
  GS_SHARED(uint32_t, summed, [kTileWarps]);  // bit k: the warp has sums of item k
  const int64_t tile = int64_t(blockIdx.y) * call.grid.tiles() + blockIdx.x;
  const int64_t plane = int64_t(call.grid.width) * call.grid.height;
  const Pixel pixel(call.grid);
  raster::lane::PixelGradients<float> state{};
  if (pixel.inside) {
    const Pictures<const float> drawn = pictures_of(pictures, call.grid, blockIdx.y);
    const Pictures<const float> asked = pictures_of(gradients, call.grid, blockIdx.y);
    const int64_t at = pixel.place;
    const float colour[3] = {drawn.rgb[at], drawn.rgb[at + plane], drawn.rgb[at + 2 * plane]};
    const float g_colour[3] = {asked.rgb[at], asked.rgb[at + plane], asked.rgb[at + 2 * plane]};
    state = raster::lane::pixel_gradients<float>(1, colour, drawn.alpha[at], drawn.depth[at], g_colour, asked.alpha[at],
                                                 asked.depth[at]);
  }

  // A batch is fetched while some still add up the last one's sums, which nobody changes before all have fetched theirs.
  const uint32_t end = tile_start[tile + 1];
  for (uint32_t begin = tile_start[tile]; begin < end; begin += kBatch) {
    const uint32_t count = end - begin < kBatch ? end - begin : kBatch;
    for (int k = int(threadIdx.x); k < int(count) * 16; k += kTileThreads)
      (&batch[k / 16].u)[k % 16] = (&splats[entries[begin + uint32_t(k / 16)].splat].u)[k % 16];
    // Behind what ended all pixels nothing is asked.
    if (!__syncthreads_or(state.transmittance > 0)) {
      for (uint64_t k = uint64_t(begin) * kNumbers + threadIdx.x; k < uint64_t(end) * kNumbers; k += kTileThreads)
        (&records[entries[k / kNumbers].record].power)[k % kNumbers] = 0;
      return;
    }

    const bool goes_on = __any_sync(kAll, state.transmittance > 0);
    const uint32_t own = uint32_t(lane()) < count ? entries[begin + uint32_t(lane())].blocks & own_blocks() : 0;
    unsigned has_sums = 0;
    for (unsigned left = __ballot_sync(kAll, goes_on && own != 0); left != 0; left &= left - 1) {
      const int item = __ffs(int(left)) - 1;
      const Evaluated e = pixel.evaluate(batch[item]);
      // What reaches a block may miss all of its pixels that go on.
      if (!__any_sync(kAll, e.raw > 0 && state.transmittance > 0)) continue;
      float sums[kNumbers] = {};
      raster::lane::pass(batch[item], e, state, sums);
      const Folded folded = fold(sums);
      if (folded.which >= 0) of_warps[warp()][item][folded.which] = folded.sum;
      has_sums |= 1u << item;
    }
    if (lane() == 0) summed[warp()] = has_sums;
    __syncthreads();

    for (int k = int(threadIdx.x); k < int(count) * kNumbers; k += kTileThreads) {
      const int item = k / kNumbers, number = k % kNumbers;
      float sum = 0;
      for (int of = 0; of < kTileWarps; ++of)
        if (summed[of] >> item & 1) sum += of_warps[of][item][number];
      (&records[entries[begin + uint32_t(item)].record].power)[number] = sum;
    }
  }
}

}  // extern "C"
}  // namespace globalsplat::cuda
