// Lists the tiles, and the 4×4 blocks of their pixels, that splats reach (raster/reach.h).
#pragma once

#include "reach.h"
#include "warp.h"

namespace globalsplat::cuda {
extern "C" {

// A warp takes 32 splats of a view, a group, and deals the tiles in their boxes to its lanes: most have a few tiles, and some
// hundreds. In the first pass, where `first` is null, it tells in group_pairs [views, groups] how many tiles its splats reach, and
// counts in of_tiles [views, tiles] the splats that reach each. In the second, group_pairs tells how many pairs are before the
// group's, and every (splat, tile) pair gets its place in `pairs`: those of a splat are neighbours. first[view·N + i] is where those
// of Gaussian i begin, first[views·N] where all end. of_tiles tells where the next key of a tile goes in `keys`, whose order, within
// a tile, is that in which warps came.
__global__ void __launch_bounds__(kGaussianThreads)
    gs_cover(Call call, const Splat<float>* splats, uint32_t* group_pairs, uint32_t* of_tiles, uint32_t* first, uint64_t* keys,
             TileEntry* pairs) {
  const int groups = parts(call.count, kWarp), group = int(blockIdx.x) * (int(blockDim.x) / kWarp) + warp();
  const int view = int(blockIdx.y);
  if (group >= groups) return;
  const Splat<float>* of_group = splats + int64_t(view) * call.count + group * kWarp;
  const int i = group * kWarp + lane();
  uint32_t& place = group_pairs[int64_t(view) * groups + group];
  const uint32_t pairs_before = first == nullptr ? 0 : place;

  raster::lane::Box box{0, 0, 0, 0};
  const bool any = i < call.count && raster::lane::box_of(of_group[lane()], call.grid, box);
  const uint32_t candidates = any ? uint32_t(box.tiles()) : 0, end = prefix_sum(candidates), begin = end - candidates;
  const uint32_t total = __shfl_sync(kAll, end, kWarp - 1);
  uint32_t reached = 0, own_first = 0;
  for (uint32_t base = 0; base < total; base += kWarp) {
    const uint32_t candidate = base + uint32_t(lane());
    int owner = 0;  // as many lanes have all of their candidates before this one
    for (int step = kWarp / 2; step > 0; step /= 2)
      if (__shfl_sync(kAll, end, owner + step - 1) <= candidate) owner += step;
    const uint32_t within = candidate - __shfl_sync(kAll, begin, owner);
    const int width = __shfl_sync(kAll, box.width(), owner);
    const int x = __shfl_sync(kAll, box.x0, owner) + int(within % uint32_t(width));
    const int y = __shfl_sync(kAll, box.y0, owner) + int(within / uint32_t(width));
    const Splat<float>& splat = of_group[owner];
    const uint32_t blocks =
        candidate < total
            ? raster::lane::reached_cells(splat, x * raster::kTile, y * raster::kTile, raster::kBlock)
            : 0;

    const unsigned reaching = __ballot_sync(kAll, blocks != 0);
    if (begin >= base) {
      const uint32_t earlier = begin - base;  // of these candidates
      own_first = reached + uint32_t(__popc(earlier < kWarp ? reaching & ((1u << earlier) - 1) : reaching));
    }
    if (blocks != 0) {
      const uint32_t slot = atomicAdd(&of_tiles[int64_t(view) * call.grid.tiles() + y * call.grid.columns + x], 1u);
      if (first != nullptr) {
        const uint32_t record = pairs_before + reached + uint32_t(__popc(reaching & before()));
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
