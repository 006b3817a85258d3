// Lists the tiles, and the 4×4 blocks of their pixels, that splats touch (kernels/touched_cells.h).
#pragma once

#include "touched_cells.h"
#include "warp.h"

namespace globalsplat::cuda {
extern "C" {

// Lists tiles in two passes. A warp takes a group of 32 splats of a view and distributes the tiles in their bounding boxes to its lanes,
// because most splats have a few tiles and some have hundreds. The first pass, in which `first` is null, writes the number of tiles that
// the group's splats touch to group_pairs [views, groups], and counts the splats that touch each tile in of_tiles [views, tiles]. In the
// second pass, group_pairs holds the number of pairs before the group's, and every (splat, tile) pair is stored in `pairs`, with those of a
// splat adjacent. first[view·N + i] is the index of the first pair of Gaussian i, and first[views·N] the end of the last. of_tiles holds
// the index of a tile's next key in `keys`; within a tile, keys are in the order in which warps arrived.
__global__ void __launch_bounds__(kGaussianThreads)
    gs_cover(Call call, const Splat<float>* splats, uint32_t* group_pairs, uint32_t* of_tiles, uint32_t* first, uint64_t* keys,
             TileEntry* pairs) {
  const int groups = ceil_div(call.count, kWarp), group = int(blockIdx.x) * (int(blockDim.x) / kWarp) + warp();
  const int view = int(blockIdx.y);
  if (group >= groups) return;
  const Splat<float>* of_group = splats + int64_t(view) * call.count + group * kWarp;
  const int i = group * kWarp + lane();
  uint32_t& place = group_pairs[int64_t(view) * groups + group];
  const uint32_t pairs_before = first == nullptr ? 0 : place;

  raster::lane::TileRange range{0, 0, 0, 0};
  const bool any = i < call.count && raster::lane::compute_tile_range(of_group[lane()], call.grid, range);
  const uint32_t candidates = any ? uint32_t(range.tiles()) : 0, end = prefix_sum(candidates), begin = end - candidates;
  const uint32_t total = __shfl_sync(kAll, end, kWarp - 1);
  uint32_t reached = 0, own_first = 0;
  for (uint32_t base = 0; base < total; base += kWarp) {
    const uint32_t candidate = base + uint32_t(lane());
    int owner = 0;  // number of lanes whose candidates all precede this one
    for (int step = kWarp / 2; step > 0; step /= 2)
      if (__shfl_sync(kAll, end, owner + step - 1) <= candidate) owner += step;
    const uint32_t within = candidate - __shfl_sync(kAll, begin, owner);
    const int width = __shfl_sync(kAll, range.width(), owner);
    const int x = __shfl_sync(kAll, range.x0, owner) + int(within % uint32_t(width));
    const int y = __shfl_sync(kAll, range.y0, owner) + int(within / uint32_t(width));
    const Splat<float>& splat = of_group[owner];
    const uint32_t blocks =
        candidate < total
            ? raster::lane::touched_cells(splat, x * raster::kTile, y * raster::kTile, raster::kBlock)
            : 0;

    const unsigned reaching = __ballot_sync(kAll, blocks != 0);
    if (begin >= base) {
      const uint32_t earlier = begin - base;  // among these candidates
      own_first = reached + uint32_t(__popc(earlier < kWarp ? reaching & ((1u << earlier) - 1) : reaching));
    }
    if (blocks != 0) {
      const uint32_t slot = atomicAdd(&of_tiles[int64_t(view) * call.grid.tiles() + y * call.grid.columns + x], 1u);
      if (first != nullptr) {
        const uint32_t record = pairs_before + reached + uint32_t(__popc(reaching & lanemask_lt()));
        keys[slot] = key_of(__float_as_uint(splat.z), record);
        pairs[record] = {uint32_t(&splat - splats), record, blocks};
      }
    }
    reached += uint32_t(__popc(reaching));
  }

  if (first == nullptr) {
    if (lane() == 0) place = reached;
    return;
  }
  if (i < call.count) first[int64_t(view) * call.count + i] = pairs_before + own_first;
  if (view == call.views - 1 && group == groups - 1 && lane() == 0)
    first[int64_t(call.views) * call.count] = pairs_before + reached;
}

}  // extern "C"
}  // namespace globalsplat::cuda
