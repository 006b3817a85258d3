// Which tiles a splat can touch, and the order of splats by depth.
#pragma once

#include <cmath>
#include <cstdint>
#include <cstring>
#include <type_traits>
#include <vector>

#include "types.h"

namespace globalsplat::raster {

// The region σ = (aΔx + bΔy)² + (cΔy)² ≤ m, m = max_power, is an ellipse. For every row of tiles that it crosses, calls
// visit(tile_y, first tile_x, one past the last tile_x). The range is exact for the strip of pixel centres of a row of
// tiles, plus a little room for rounding: no pixel whose α reaches 1/255 is lost.
template <class T, class Visit>
inline void for_each_tile_row(const Splat<T>& s, int tiles_x, int tiles_y, int width, int height, Visit visit) {
  const T room = T(1e-3);
  const T top = s.v - s.half_height, bottom = s.v + s.half_height;
  if (!(bottom >= T(0.5)) || !(top <= height - T(0.5))) return;
  const int first_row = top > 0 ? int(top / kTile) : 0;
  const int last_row = bottom < height ? int(bottom / kTile) : tiles_y - 1;
  // At height y the ellipse reaches x = (−by ± √(m − c²y²)) / a. It is furthest right at y = −(b/c)·√(m / (b² + c²)) and
  // furthest left at the opposite point; inside a strip the nearest y to it counts.
  const T furthest_y = -s.b / s.c * std::sqrt(s.max_power / (s.b * s.b + s.c * s.c));
  for (int row = first_row; row <= last_row && row < tiles_y; ++row) {
    const T low = T(row * kTile) + T(0.5) - s.v - room, high = low + T(kTile - 1) + 2 * room;
    const auto reach = [&](T y, T sign) {
      const T nearest = y < low ? low : y > high ? high : y;
      const T left_over = s.max_power - s.c * nearest * (s.c * nearest);
      return (-s.b * nearest + sign * std::sqrt(left_over > 0 ? left_over : T(0))) / s.a;
    };
    T right = reach(furthest_y, T(1)), left = reach(-furthest_y, T(-1));
    const T slack = room + T(1e-5) * (right - left);
    right += s.u + slack;
    left += s.u - slack;
    if (!(right >= T(0.5)) || !(left <= width - T(0.5))) continue;
    // Tile x holds centres from 16x + ½ to 16x + 15½.
    const T first = (left - T(kTile) + T(0.5)) / kTile;
    const int begin = first > 0 ? int(std::ceil(first)) : 0;
    const int end = right < width ? int((right - T(0.5)) / kTile) + 1 : tiles_x;
    if (begin < end) visit(row, begin, end < tiles_x ? end : tiles_x);
  }
}

// Indices of `depths` (all positive) in ascending order, equal ones by index: radix sort, least significant byte first,
// on the bits, whose order is the numbers' own for positive IEEE floats.
template <class T>
inline std::vector<uint32_t> order_by_depth(const std::vector<T>& depths) {
  using Key = std::conditional_t<sizeof(T) == 4, uint32_t, uint64_t>;
  struct Item {
    Key key;
    uint32_t index;
  };
  const size_t n = depths.size();
  std::vector<Item> items(n), other(n);
  for (size_t i = 0; i < n; ++i) {
    std::memcpy(&items[i].key, &depths[i], sizeof(T));
    items[i].index = uint32_t(i);
  }
  for (size_t shift = 0; shift < 8 * sizeof(Key); shift += 8) {
    size_t start[257] = {};
    for (const Item& item : items) ++start[((item.key >> shift) & 255) + 1];
    for (int digit = 0; digit < 256; ++digit) start[digit + 1] += start[digit];
    for (const Item& item : items) other[start[(item.key >> shift) & 255]++] = item;
    items.swap(other);
  }
  std::vector<uint32_t> order(n);
  for (size_t i = 0; i < n; ++i) order[i] = items[i].index;
  return order;
}

}  // namespace globalsplat::raster
