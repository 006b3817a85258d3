// Blends tiles, forward and backward: the maths of kernels/pixel.h with one pixel per thread and one tile per block (spec 6.4 and 6.5).
//
// Each half-warp has one of the tile's 4×4 blocks of pixels, and processes the splats that touch this block.
#pragma once

#include "pixel.h"
#include "warp.h"

namespace globalsplat::cuda {

inline constexpr int kTileWarps = kTileThreads / kWarp;
inline constexpr int kHalf = kWarp / 2;       // lanes per block of pixels
inline constexpr int kBatch = kWarp;          // entries per batch
inline constexpr int kInvisible = kBatch;     // index after a batch, at which a splat without effect is stored
static_assert(sizeof(Splat<float>) == 64 && kTileThreads * 2 == kBatch * 16, "a batch's splats are two numbers a thread");
static_assert(raster::kBlocks == 2 * kTileWarps && raster::kBlock * raster::kBlock == kHalf, "two blocks a warp");

// Minimum number of blocks per multiprocessor, chosen so that threads have enough registers. In the forward pass, compilers for other
// architectures do better without a bound.
#if defined(__CUDA_ARCH__) && __CUDA_ARCH__ == 900
#define GS_FORWARD_BOUNDS __launch_bounds__(kTileThreads, 8)
inline constexpr int kBackwardBlocks = 5;
#else
#define GS_FORWARD_BOUNDS __launch_bounds__(kTileThreads)
inline constexpr int kBackwardBlocks = 4;
#endif

using Evaluated = raster::lane::Evaluated<float>;

// Return the index of a thread's half-warp, and the block of the tile that this half has: warps are in row-major order, with two blocks
// each.
inline int half() { return lane() / kHalf; }
inline int own_block() { return 2 * warp() + half(); }

// Pixel of this thread.
struct Pixel {
  int x, y;
  bool inside;    // of the image
  int64_t place;  // index in a plane
  uint32_t eighth;

  explicit Pixel(const Grid& grid) : eighth(raster::kExp2Eighths[lane() % 8]) {
    const int tile = int(blockIdx.x), block = own_block(), own = lane() % kHalf;
    x = tile % grid.columns * raster::kTile + block % 4 * raster::kBlock + own % raster::kBlock;
    y = tile / grid.columns * raster::kTile + block / 4 * raster::kBlock + own / raster::kBlock;
    inside = x < grid.width && y < grid.height;
    place = int64_t(y) * grid.width + x;
  }
  // Evaluates a splat; all threads of a warp must call it together. The lanes hold the table of 2^(i/8), because a shuffle is faster than a
  // memory access.
  Evaluated evaluate(const Splat<float>& splat) const {
    Evaluated e;
    raster::lane::evaluate(splat, float(x) + 0.5f, float(y) + 0.5f, e,
                           [&](uint32_t i) { return __shfl_sync(kAll, eighth, int(i % kWarp)); });
    return e;
  }
};

// Returns a splat whose α is 0 and whose values are all finite.
inline Splat<float> invisible_splat() {
  Splat<float> splat{};
  splat.log2_opacity = -1e30f;
  return splat;
}

// For each half-warp, the indices of a batch's items that touch its block, in order.
using Order = uint8_t[2][kBatch];

// Builds the lists of both half-warps. In each lane, two bits of `blocks` tell which of the warp's blocks its item touches. Entries of
// `order` after the last item are kInvisible; returns the length of the longer list. The warp must synchronize before it reads them.
inline int list_items(uint32_t blocks, Order& order) {
  int longest = 0;
  for (int k = 0; k < 2; ++k) {
    const bool reaches = (blocks >> k & 1) != 0;
    const unsigned reaching = __ballot_sync(kAll, reaches);
    const int count = __popc(reaching);
    order[k][__popc((reaches ? reaching : ~reaching) & lanemask_lt()) + (reaches ? 0 : count)] = uint8_t(reaches ? lane() : kInvisible);
    if (count > longest) longest = count;
  }
  return longest;
}

extern "C" {

// Blends tiles. Warps are independent: each loads the items of a batch that touch its pixels.
__global__ void GS_FORWARD_BOUNDS
    gs_blend(Call call, const Splat<float>* splats, const TileEntry* entries, const uint32_t* tile_start,
             RenderOutput<float> pictures) {
  struct Shared {
    Splat<float> batch[kBatch + 1];
    Order order;
  };
  GS_SHARED(Shared, of_warps, [kTileWarps]);
  auto& [batch, orders] = of_warps[warp()];
  if (lane() == 0) batch[kInvisible] = invisible_splat();
  const int64_t tile = int64_t(blockIdx.y) * call.grid.tiles() + blockIdx.x;
  const Pixel pixel(call.grid);
  raster::lane::Pixels<float> sums{pixel.inside ? 1.0f : 0.0f};
  const uint32_t end = tile_start[tile + 1];
  for (uint32_t begin = tile_start[tile]; begin < end; begin += kBatch) {
    if (!__any_sync(kAll, sums.transmittance > 0)) break;
    const uint32_t at = begin + uint32_t(lane());
    const uint32_t blocks = at < end ? entries[at].blocks >> (2 * warp()) & 3 : 0;
    if (blocks != 0) batch[lane()] = splats[entries[at].splat];
    const int count = list_items(blocks, orders);
    __syncwarp();
    const uint8_t(&order)[kBatch] = orders[half()];
    for (int k = 0; k < count; ++k) {
      const Splat<float>& splat = batch[order[k]];
      raster::lane::add(splat, raster::lane::blend<float>(sums.transmittance, pixel.evaluate(splat).raw), sums);
    }
    __syncwarp();
  }
  if (!pixel.inside) return;
  const int64_t plane = int64_t(call.grid.width) * call.grid.height;
  const RenderOutput<float> out = pictures.of_view(blockIdx.y, plane);
  out.rgb[pixel.place] = sums.red;
  out.rgb[pixel.place + plane] = sums.green;
  out.rgb[pixel.place + 2 * plane] = sums.blue;
  out.alpha[pixel.place] = sums.alpha;
  out.depth[pixel.place] = raster::lane::expected_depth(sums);
}

// Computes gradients of splats and writes one record per entry. `pictures` are outputs of the forward pass, and `gradients` the loss's
// gradients with respect to them. A splat's sums are added over each block's pixels, then over blocks, always in the same order.
__global__ void __launch_bounds__(kTileThreads, kBackwardBlocks)
    gs_blend_backward(Call call, const Splat<float>* splats, const TileEntry* entries, const uint32_t* tile_start,
                      RenderOutput<const float> pictures, RenderOutput<const float> gradients, SplatGradient<float>* records) {
  constexpr int kNumbers = raster::kSplatGradientNumbers;
  // Each thread handles two values of a splat, and of a sum.
  constexpr int kParts = int(sizeof(Splat<float>) / sizeof(FloatPair)), kSums = kNumbers / 2;
  // A single struct, so that one address is kept instead of one per array.
  struct Shared {
    Splat<float> batch[kBatch + 1];
    FloatPair sums[raster::kBlocks][kBatch][kSums];
    uint32_t has_sums[raster::kBlocks];  // bit k: the block has sums of item k
    Order orders[kTileWarps];
  };
  GS_SHARED(Shared, shared, [1]);
  auto& [batch, of_blocks, summed, orders] = shared[0];
  const int64_t tile = int64_t(blockIdx.y) * call.grid.tiles() + blockIdx.x;
  const int64_t plane = int64_t(call.grid.width) * call.grid.height;
  const Pixel pixel(call.grid);
  raster::lane::PixelGradients<float> state{};
  if (pixel.inside) {
    const RenderOutput<const float> outputs = pictures.of_view(blockIdx.y, plane), output_gradients = gradients.of_view(blockIdx.y, plane);
    const int64_t at = pixel.place;
    const float color[3] = {outputs.rgb[at], outputs.rgb[at + plane], outputs.rgb[at + 2 * plane]};
    const float g_color[3] = {output_gradients.rgb[at], output_gradients.rgb[at + plane], output_gradients.rgb[at + 2 * plane]};
    state = raster::lane::pixel_gradients<float>(1, color, outputs.alpha[at], outputs.depth[at], g_color, output_gradients.alpha[at],
                                                 output_gradients.depth[at]);
  }

  const uint32_t end = tile_start[tile + 1];
  // Every warp holds a batch's entries, one per lane; all warps share the loading of its splats.
  const auto fetch_entry = [&](uint32_t begin) {
    const uint32_t at = begin + uint32_t(lane());
    return at < end ? entries[at] : TileEntry{0, 0, 0};
  };
  const int item = int(threadIdx.x) / kParts, part = int(threadIdx.x) % kParts;
  const auto fetch_part = [&](const TileEntry& entry, uint32_t begin) {
    const uint32_t splat = __shfl_sync(kAll, entry.splat, item);
    return begin + uint32_t(item) < end ? reinterpret_cast<const FloatPair*>(splats + splat)[part] : FloatPair{};
  };
  const WarpReduction<kNumbers, kHalf> fold;
  // Indices of the sums of a batch that this thread adds over blocks.
  const int sum_item = int(threadIdx.x) / kSums, sum_part = int(threadIdx.x) % kSums;

  uint32_t begin = tile_start[tile];
  if (begin >= end) return;
  if (threadIdx.x == 0) batch[kInvisible] = invisible_splat();
  TileEntry entry = fetch_entry(begin), next = fetch_entry(begin + kBatch);
  FloatPair own = fetch_part(entry, begin);
  // The next batch is stored while some threads still add the previous sums, which no thread overwrites before all have stored theirs.
  for (; begin < end; begin += kBatch) {
    reinterpret_cast<FloatPair*>(batch + item)[part] = own;
    // Once all pixels have ended, the remaining splats get zero gradients.
    if (!__syncthreads_or(state.transmittance > 0)) {
      for (uint64_t k = uint64_t(begin) * kNumbers + threadIdx.x; k < uint64_t(end) * kNumbers; k += kTileThreads)
        (&records[entries[k / kNumbers].record].power)[k % kNumbers] = 0;
      return;
    }
    // The next batch is loaded in the meantime.
    own = fetch_part(next, begin + kBatch);
    const TileEntry later = fetch_entry(begin + 2 * kBatch);

    const bool goes_on = __any_sync(kAll, state.transmittance > 0);
    const int count = list_items(goes_on ? entry.blocks >> (2 * warp()) & 3 : 0, orders[warp()]);
    __syncwarp();
    const uint8_t(&order)[kBatch] = orders[warp()][half()];
    unsigned has_sums = 0;
    for (int k = 0; k < count; ++k) {
      const int at = order[k];
      const Splat<float>& splat = batch[at];
      const Evaluated e = pixel.evaluate(splat);
      // A splat that touches a block may miss all of its active pixels.
      if (!__any_sync(kAll, e.raw > 0 && state.transmittance > 0)) continue;
      // Sums start at −0, so that the first addition is exact and can be optimized away.
      float sums[kNumbers];
      for (float& sum : sums) sum = -0.0f;
      raster::lane::accumulate_gradient(splat, e, state, sums);
      const float sum = fold(sums);
      if (at != kInvisible) {
        if (fold.which >= 0) (&of_blocks[own_block()][at][0].numbers[0])[fold.which] = sum;
        has_sums |= 1u << at;
      }
    }
    if (lane() % kHalf == 0) summed[own_block()] = has_sums;
    __syncthreads();

    if (warp() < kBatch * kSums / kWarp) {
      const uint32_t record = __shfl_sync(kAll, entry.record, sum_item);
      FloatPair sum{};
      for (int of = 0; of < raster::kBlocks; ++of)
        if (summed[of] >> sum_item & 1)
          for (int k = 0; k < 2; ++k) sum.numbers[k] += of_blocks[of][sum_item][sum_part].numbers[k];
      if (begin + uint32_t(sum_item) < end) reinterpret_cast<FloatPair*>(records + record)[sum_part] = sum;
    }
    entry = next;
    next = later;
  }
}

}  // extern "C"
}  // namespace globalsplat::cuda
