// Exact test of which tiles, and which 4×4 blocks of their pixels, a splat touches: those where s = (aΔx + bΔy)² + (cΔy)² is at most
// `reach` for some point between a block's outermost pixel centers.
//
// s is convex with its minimum 0 at Δ = 0. Over a rectangle that doesn't contain Δ = 0, its minimum lies on a side that faces it: on x =
// x*, the value nearest to 0 within the rectangle, or on y = y*. On either side s is a parabola, minimal at −slope_y·x* (or −slope_x·y*),
// clamped to the side. Sixteen rectangles, four by four, are tested at a time: first tiles, then the blocks of each touched tile.
#pragma once

#include "simd.h"
#include "types.h"

namespace globalsplat::raster::GS_ISA {

// Returns bits that tell which cells of a 4×4 array the splat touches, bit 4·j + i for cell (i, j). Cells have size × size pixels, and the
// first pixel is (x0, y0).
template <class T>
GS_INLINE uint32_t touched_cells(const Splat<T>& s, int x0, int y0, int size) {
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
      const V p = fma(s.a, x, s.b * y), r = s.c * y;
      return fma(p, p, r * r);
    };
    const V least = smaller(value(x_near, y), value(x, y_near));
    bits |= uint32_t(lane_bits(less_equal(least, broadcast<T>(s.reach)))) << first;
  }
  return bits;
}

// Range of tiles: columns x0 … x1 and rows y0 … y1.
struct TileRange {
  int x0, x1, y0, y1;
  int width() const { return x1 - x0 + 1; }
  int64_t tiles() const { return int64_t(width()) * (y1 - y0 + 1); }
};

// Computes the range of tiles that overlap a splat's bounding box; returns false if there are none.
template <class T>
GS_INLINE bool compute_tile_range(const Splat<T>& s, const Grid& grid, TileRange& range) {
  const T left = s.u - s.half_width, right = s.u + s.half_width;
  const T top = s.v - s.half_height, bottom = s.v + s.half_height;
  if (!(s.z > 0 && right > 0 && left < T(grid.width) && bottom > 0 && top < T(grid.height))) return false;
  range = {left > 0 ? int(left) / kTile : 0, right < T(grid.width) ? int(right) / kTile : grid.columns - 1,
           top > 0 ? int(top) / kTile : 0, bottom < T(grid.height) ? int(bottom) / kTile : grid.rows - 1};
  return true;
}

}  // namespace globalsplat::raster::GS_ISA
