// Lists the tiles, and the 4×4 blocks of their pixels, that splats touch; reach.h has the test.
#pragma once

#include "reach.h"
#include "simd.h"
#include "types.h"

namespace globalsplat::raster::GS_ISA {

// Tile that a splat may touch, before the exact test. The values fit into 16 bits: an image has at most 2^20 pixels per side, and a call
// covers at most kCoverTask splats.
struct Candidate {
  uint16_t x, y;     // of the tile
  uint16_t unused;
  uint16_t splat;    // relative to the first one of the call
};
static_assert(sizeof(Candidate) == sizeof(TilePair));

// Writes the tiles that overlap a splat's bounding box, or fewer, and returns their number. Returns 0 and sets `full` if there may be more
// than `capacity`.
template <class T>
GS_INLINE int64_t candidates_of(const Splat<T>& s, uint16_t index, const Grid& grid, int64_t capacity, Candidate* out,
                                bool& full) {
  Box box;
  if (!box_of(s, grid, box)) return 0;
  const auto [x0, x1, y0, y1] = box;
  const int64_t tiles = box.tiles();
  if ((full = capacity < (tiles < 4 ? 4 : tiles))) return 0;
  const auto candidate = [&](int x, int y) { return Candidate{uint16_t(x), uint16_t(y), 0, index}; };
  if (x1 - x0 < 2 && y1 - y0 < 2) {
    // The most frequent case. All four are written, whatever their number, which avoids mispredicted branches.
    out[0] = candidate(x0, y0);
    out[1] = candidate(x1, y0 + (x1 == x0));
    out[2] = candidate(x0, y1);
    out[3] = candidate(x1, y1);
    return tiles;
  }
  int64_t used = 0;
  for (int y = y0; y <= y1; y += 4)
    for (int x = x0; x <= x1; x += 4) {
      // Columns and rows beyond the last tile don't exist.
      const uint32_t in_row = (1u << (x1 - x < 3 ? x1 - x + 1 : 4)) - 1;
      const uint32_t exist = (in_row * 0x1111u) & (y1 - y < 3 ? (1u << 4 * (y1 - y + 1)) - 1 : 0xFFFFu);
      for (uint32_t tiles = reached_cells(s, x * kTile, y * kTile, kTile) & exist; tiles != 0; tiles &= tiles - 1) {
        const int tile = __builtin_ctz(tiles);
        out[used++] = candidate(x + tile % 4, y + tile / 4);
      }
    }
  return used;
}

// Lists the tiles that splats begin … end − 1, at most kCoverTask of them, touch, splat by splat. The new pairs are appended to the `used`
// existing ones; those of splat i start at pairs[first[i − begin]]. Stops before a splat for which `capacity` might not suffice; every
// splat fits into as many pairs as there are tiles, or four. Returns the first splat that isn't listed, and the number of pairs in `used`.
template <class T>
int64_t cover(const Splat<T>* splats, int64_t begin, int64_t end, const Grid& grid, TilePair* pairs, int64_t capacity,
              int64_t& used, uint32_t* first) {
  // Ends of each splat's candidates, and then of its touched tiles, which are stored in the same memory.
  uint32_t candidates_end[kCoverTask], reached_end[kCoverTask];
  const auto at = [&](int64_t k) { return pairs + used + k; };
  int64_t count = 0, stop = begin;
  for (bool full = false; stop < end; ++stop) {
    const int64_t more = candidates_of(splats[stop], uint16_t(stop - begin), grid, capacity - used - count,
                                       reinterpret_cast<Candidate*>(at(count)), full);
    if (full) break;
    count += more;
    candidates_end[stop - begin] = uint32_t(count);
  }
  int64_t kept = 0;
  for (int64_t k = 0; k < count; ++k) {
    Candidate c;
    __builtin_memcpy(&c, at(k), sizeof c);
    const uint32_t blocks = reached_cells(splats[begin + c.splat], c.x * kTile, c.y * kTile, kBlock);
    *at(kept) = {uint32_t(c.y * grid.columns + c.x), blocks};
    kept += blocks != 0;
    reached_end[c.splat] = uint32_t(kept);
  }
  uint32_t previous_candidates = 0, previous = 0;
  for (int64_t i = 0; i < stop - begin; ++i) {
    first[i] = uint32_t(used) + previous;
    if (candidates_end[i] != previous_candidates) previous = reached_end[i];
    previous_candidates = candidates_end[i];
  }
  used += kept;
  return stop;
}

}  // namespace globalsplat::raster::GS_ISA
