// Which tiles, and which 4×4 blocks of their pixels, a splat reaches: exactly those where s = (aΔx + bΔy)² + (cΔy)² is at
// most `reach` for some point between a block's outermost pixel centres.
//
// s is convex with its minimum 0 at Δ = 0. Over a rectangle that doesn't hold Δ = 0, its minimum lies on a side that faces
// it: on x = x*, the value nearest to 0 among the rectangle's, or on y = y*. On either side s is a parabola, least at
// −slope_y·x* (or −slope_x·y*), clamped to the side. Sixteen rectangles, four by four, are tested at a time: first tiles,
// then the blocks of each tile reached.
#pragma once

#include "simd.h"
#include "types.h"

namespace globalsplat::raster::GS_ISA {

// Bit 4·j + i tells whether the splat reaches cell (i, j) of a 4×4 array of cells of size × size pixels, whose first pixel
// is (x0, y0).
template <class T>
GS_INLINE uint32_t reached_cells(const Splat<T>& s, int x0, int y0, int size) {
  using V = Vector<T>;
  constexpr int lanes = Simd<T>::lanes;
  constexpr auto columns = [] {
    struct { T x[16], y[16]; } cells{};
    for (int i = 0; i < 16; ++i) {
      cells.x[i] = T(i % 4);
      cells.y[i] = T(i / 4);
    }
    return cells;
  }();
  const T right = s.u - (T(x0) + T(0.5)), bottom = s.v - (T(y0) + T(0.5));  // Δ at the first pixel: the largest
  const V zero{}, extent = broadcast<T>(T(size - 1)), step = broadcast<T>(T(size));
  uint32_t bits = 0;
  for (int first = 0; first < 16; first += lanes) {
    const V x_high = right - step * load<T>(columns.x + first), x_low = x_high - extent;
    const V y_high = bottom - step * load<T>(columns.y + first), y_low = y_high - extent;
    const V x_near = clamp(zero, x_low, x_high), y_near = clamp(zero, y_low, y_high);
    const V y = clamp(-s.slope_y * x_near, y_low, y_high), x = clamp(-s.slope_x * y_near, x_low, x_high);
    const auto value = [&](V x, V y) {
      const V p = fma(broadcast<T>(s.a), x, s.b * y), r = s.c * y;
      return fma(p, p, r * r);
    };
    const V least = smaller(value(x_near, y), value(x, y_near));
    bits |= uint32_t(lane_bits(at_most(least, broadcast<T>(s.reach)))) << first;
  }
  return bits;
}

// Lists the tiles that splats begin … end − 1 reach, splat by splat: the pairs of splat i start at pairs[first[i − begin]].
// Stops before a splat for which `capacity` might not suffice; any splat fits into as many pairs as there are tiles.
// Returns the first splat that isn't listed, and in `used` how many pairs there are.
template <class T>
int64_t cover(const Splat<T>* splats, int64_t begin, int64_t end, const Grid& grid, TilePair* pairs, int64_t capacity,
              int64_t& used, uint32_t* first) {
  for (int64_t i = begin; i < end; ++i) {
    first[i - begin] = uint32_t(used);
    const Splat<T>& s = splats[i];
    const T left = s.u - s.half_width, right = s.u + s.half_width;
    const T top = s.v - s.half_height, bottom = s.v + s.half_height;
    if (s.z == 0 || !(right > 0 && left < T(grid.width) && bottom > 0 && top < T(grid.height))) continue;
    const int x0 = left > 0 ? int(left) / kTile : 0, x1 = right < T(grid.width) ? int(right) / kTile : grid.columns - 1;
    const int y0 = top > 0 ? int(top) / kTile : 0, y1 = bottom < T(grid.height) ? int(bottom) / kTile : grid.rows - 1;
    if (used + int64_t(x1 - x0 + 1) * (y1 - y0 + 1) > capacity) return i;

    const auto visit = [&](int x, int y) {
      const uint32_t blocks = reached_cells(s, x * kTile, y * kTile, kBlock);
      pairs[used] = {uint32_t(y * grid.columns + x), blocks};
      used += blocks != 0;
    };
    if (x0 == x1 && y0 == y1) {
      visit(x0, y0);
      continue;
    }
    for (int y = y0; y <= y1; y += 4)
      for (int x = x0; x <= x1; x += 4) {
        // Columns and rows beyond the last tile don't exist.
        const uint32_t in_row = (1u << (x1 - x < 3 ? x1 - x + 1 : 4)) - 1;
        const uint32_t exist = (in_row * 0x1111u) & (y1 - y < 3 ? (1u << 4 * (y1 - y + 1)) - 1 : 0xFFFFu);
        for (uint32_t tiles = reached_cells(s, x * kTile, y * kTile, kTile) & exist; tiles != 0; tiles &= tiles - 1) {
          const int tile = __builtin_ctz(tiles);
          visit(x + tile % 4, y + tile / 4);
        }
      }
  }
  return end;
}

}  // namespace globalsplat::raster::GS_ISA
