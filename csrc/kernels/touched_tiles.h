// Lists the tiles that splats touch, and in each tile the blocks of 4×4 pixels that they touch, by the exact test in touched_cells.h.
#pragma once

#include "simd.h"
#include "touched_cells.h"
#include "types.h"

namespace globalsplat::raster::GS_ISA {

// A splat and a tile that it may touch; the exact test is still to be made. The values fit into 16 bits, because an image has at most 2^20
// pixels per side and a call processes at most kSplatsPerTask splats.
struct Candidate {
  uint16_t x, y;     // column and row of the tile
  uint16_t unused;
  uint16_t splat;    // index among the splats of the call
};
static_assert(sizeof(Candidate) == sizeof(TilePair));

// Writes the candidate tiles of a splat to `out` and returns their number. The candidates include every tile that the splat touches and lie
// within its bounding box. If they might exceed `capacity`, sets `full` to true and returns 0.
template <class T>
GS_INLINE int64_t write_candidates(const Splat<T>& s, uint16_t index, const Grid& grid, int64_t capacity, Candidate* out,
                                   bool& full) {
  TileRange range;
  if (!compute_tile_range(s, grid, range)) return 0;
  const auto [x0, x1, y0, y1] = range;
  const int64_t tiles = range.tiles();
  if ((full = capacity < (tiles < 4 ? 4 : tiles))) return 0;
  const auto candidate = [&](int x, int y) { return Candidate{uint16_t(x), uint16_t(y), 0, index}; };
  if (x1 - x0 < 2 && y1 - y0 < 2) {
    // The most frequent case, at most 2×2 tiles. Always writing four candidates avoids mispredicted branches.
    out[0] = candidate(x0, y0);
    out[1] = candidate(x1, y0 + (x1 == x0));
    out[2] = candidate(x0, y1);
    out[3] = candidate(x1, y1);
    return tiles;
  }
  int64_t used = 0;
  for (int y = y0; y <= y1; y += 4)
    for (int x = x0; x <= x1; x += 4) {
      // Mask of the cells within the bounding box.
      const uint32_t row_mask = (1u << (x1 - x < 3 ? x1 - x + 1 : 4)) - 1;
      const uint32_t mask = (row_mask * 0x1111u) & (y1 - y < 3 ? (1u << 4 * (y1 - y + 1)) - 1 : 0xFFFFu);
      for (uint32_t cells = touched_cells(s, x * kTile, y * kTile, kTile) & mask; cells != 0; cells &= cells - 1) {
        const int cell = __builtin_ctz(cells);
        out[used++] = candidate(x + cell % 4, y + cell / 4);
      }
    }
  return used;
}

// Lists the tiles that the splats begin … end − 1 touch, splat by splat; they are at most kSplatsPerTask splats. Appends the pairs to the
// `used` existing ones and adds their number to `used`. The pairs of splat i start at pairs[first[i − begin]]. Stops before a splat whose
// pairs might exceed `capacity`, and returns its index, or else `end`. For one splat, a capacity of max(4, number of tiles) always
// suffices.
template <class T>
int64_t list_touched_tiles(const Splat<T>* splats, int64_t begin, int64_t end, const Grid& grid, TilePair* pairs, int64_t capacity,
                           int64_t& used, uint32_t* first) {
  // Ends of each splat's candidates and of its pairs. The pairs overwrite the candidates in `pairs`.
  uint32_t candidates_end[kSplatsPerTask], pairs_end[kSplatsPerTask];
  const auto at = [&](int64_t k) { return pairs + used + k; };
  int64_t count = 0, stop = begin;
  for (bool full = false; stop < end; ++stop) {
    const int64_t added = write_candidates(splats[stop], uint16_t(stop - begin), grid, capacity - used - count,
                                           reinterpret_cast<Candidate*>(at(count)), full);
    if (full) break;
    count += added;
    candidates_end[stop - begin] = uint32_t(count);
  }
  int64_t kept = 0;
  for (int64_t k = 0; k < count; ++k) {
    Candidate c;
    __builtin_memcpy(&c, at(k), sizeof c);
    const uint32_t blocks = touched_cells(splats[begin + c.splat], c.x * kTile, c.y * kTile, kBlock);
    *at(kept) = {uint32_t(c.y * grid.columns + c.x), blocks};
    kept += blocks != 0;
    pairs_end[c.splat] = uint32_t(kept);
  }
  uint32_t previous_candidates = 0, previous_pairs = 0;
  for (int64_t i = 0; i < stop - begin; ++i) {
    first[i] = uint32_t(used) + previous_pairs;
    if (candidates_end[i] != previous_candidates) previous_pairs = pairs_end[i];
    previous_candidates = candidates_end[i];
  }
  used += kept;
  return stop;
}

}  // namespace globalsplat::raster::GS_ISA
