// Prefix sums, and sorting of tiles' lists by depth, and by Gaussian for equal depths.
#pragma once

#include "warp.h"

namespace globalsplat::cuda {

// Inclusive prefix sum over the threads of a block, and the sum over all of them. `of_warps` is shared memory that no other sum may use
// before the block's next barrier.
template <class T>
struct Sum {
  T inclusive, all;
};
template <class T, int warps>
inline Sum<T> block_sum(T value, T (&of_warps)[warps]) {
  Sum<T> sum{prefix_sum(value), 0};
  if (lane() == kWarp - 1) of_warps[warp()] = sum.inclusive;
  __syncthreads();
  for (int k = 0; k < warps; ++k) {
    if (k < warp()) sum.inclusive += of_warps[k];
    sum.all += of_warps[k];
  }
  return sum;
}

// Comparison of a bitonic network: returns true if two keys must be swapped. `low` is the key at the lower index, `place`. The order is
// ascending if bit `sorted` of that index is 0, and descending otherwise.
inline bool changes_places(uint64_t low, uint64_t high, int place, int sorted) { return (low > high) == ((place & sorted) == 0); }

// Runs the steps with distances up to 32 in registers, for the stages that produce sorted runs of `sorted` to `last` keys. A warp processes
// 64 keys from index `place` on, two per lane.
inline void sort_in_warp(uint64_t* keys, int place, int sorted, int last) {
  uint64_t own[2] = {keys[place + lane()], keys[place + kWarp + lane()]};
  for (; sorted <= last; sorted *= 2) {
    if (sorted > kWarp && changes_places(own[0], own[1], place, sorted)) {
      const uint64_t low = own[0];
      own[0] = own[1];
      own[1] = low;
    }
    for (int distance = sorted > kWarp ? kWarp / 2 : sorted / 2; distance > 0; distance /= 2)
      for (int k = 0; k < 2; ++k) {
        const uint64_t other = __shfl_xor_sync(kAll, own[k], distance);
        const bool is_lower = (lane() & distance) == 0, rises = ((place + k * kWarp + lane()) & sorted) == 0;
        if ((own[k] > other) == (is_lower == rises)) own[k] = other;
      }
  }
  keys[place + lane()] = own[0];
  keys[place + kWarp + lane()] = own[1];
}

// Sorts `size` keys, a power of two that is at least 64, with a bitonic network. Other warps may read them after the block's next barrier.
inline void sort_keys(uint64_t* keys, int size) {
  constexpr int kPart = 2 * kWarp, kSortWarps = kSortThreads / kWarp;
  for (int place = warp() * kPart; place < size; place += kSortWarps * kPart) sort_in_warp(keys, place, 2, kPart);
  for (int sorted = 2 * kPart; sorted <= size; sorted *= 2) {
    for (int distance = sorted / 2; distance > kWarp; distance /= 2) {
      __syncthreads();
      for (int pair = int(threadIdx.x); pair < size / 2; pair += kSortThreads) {
        const int place = 2 * pair - (pair & (distance - 1));
        const uint64_t low = keys[place], high = keys[place + distance];
        if (changes_places(low, high, place, sorted)) {
          keys[place] = high;
          keys[place + distance] = low;
        }
      }
    }
    __syncthreads();
    for (int place = warp() * kPart; place < size; place += kSortWarps * kPart) sort_in_warp(keys, place, sorted, sorted);
  }
}

extern "C" {

// Computes exclusive prefix sums of two rows of counts, one row of blocks for each, in `sums`; `total` receives the sum of the first row. A
// block has kScanThreads·kScanItems counts, and sums all preceding ones by itself, so that no block waits for another.
__global__ void __launch_bounds__(kScanThreads) gs_scan(Counts first, Counts second, uint64_t* total) {
  GS_SHARED(uint64_t, before_of_warps, [kScanThreads / kWarp]);
  GS_SHARED(uint64_t, of_warps, [kScanThreads / kWarp]);
  const Counts row = blockIdx.y == 0 ? first : second;
  const int64_t begin = int64_t(blockIdx.x) * (kScanThreads * kScanItems);
  if (begin >= row.length && begin > 0) return;
  uint64_t before_these = 0;
  for (int64_t k = threadIdx.x; k < begin; k += kScanThreads) before_these += row.counts[k];
  before_these = block_sum(before_these, before_of_warps).all;

  const int64_t own = begin + int64_t(threadIdx.x) * kScanItems;
  uint32_t items[kScanItems];
  uint64_t sum = 0;
  for (int k = 0; k < kScanItems; ++k) {
    items[k] = own + k < row.length ? row.counts[own + k] : 0;
    sum += items[k];
  }
  const Sum<uint64_t> sums = block_sum(sum, of_warps);
  // If 32 bits overflow, the host notices by the total.
  uint32_t next = uint32_t(before_these + sums.inclusive - sum);
  for (int k = 0; k < kScanItems && own + k < row.length; ++k) {
    row.sums[own + k] = next;
    next += items[k];
  }
  if (blockIdx.y == 0 && threadIdx.x == 0 && begin + kScanThreads * kScanItems >= row.length)
    *total = before_these + sums.all;
}

// Sorts the pairs of one tile per block into entries tile_start[tile] … tile_start[tile + 1] − 1. The same range of `keys` holds the pairs'
// keys in any order, and is overwritten; `spare` is scratch memory of the same size.
__global__ void __launch_bounds__(kSortThreads)
    gs_sort_lists(Call call, const uint32_t* tile_start, uint64_t* keys, uint64_t* spare, const TileEntry* pairs,
                  TileEntry* entries) {
  GS_SHARED(uint64_t, list, [kListKeys]);
  const int64_t tile = int64_t(blockIdx.y) * call.grid.tiles() + blockIdx.x;
  const uint32_t begin = tile_start[tile], length = tile_start[tile + 1] - begin;
  keys += begin;
  spare += begin;
  entries += begin;
  for (uint32_t done = 0; done < length; done += kListKeys) {
    const int count = int(length - done < kListKeys ? length - done : kListKeys);
    int size = 2 * kWarp;
    while (size < count) size *= 2;
    for (int k = int(threadIdx.x); k < size; k += kSortThreads) list[k] = k < count ? keys[done + uint32_t(k)] : ~uint64_t(0);
    __syncthreads();
    sort_keys(list, size);
    __syncthreads();
    for (int k = int(threadIdx.x); k < count; k += kSortThreads)
      if (length <= kListKeys)
        entries[k] = pairs[pair_of(list[k])];
      else
        keys[done + uint32_t(k)] = list[k];
    // The next round starts with each thread's own elements of `list`, so it needs no barrier.
  }
  if (length <= kListKeys) return;

  // Longer lists are merged from several: the new position of a key is the number of smaller keys in its own run and in the neighbouring
  // one.
  for (uint64_t run = kListKeys;; run *= 2) {
    __syncthreads();
    if (run >= length) break;
    for (uint64_t k = threadIdx.x; k < length; k += kSortThreads) {
      const uint64_t key = keys[k], own = k / run * run, both = k / (2 * run) * (2 * run), other = own == both ? own + run : both;
      uint64_t low = other < length ? other : length, high = low + run < length ? low + run : length;
      const uint64_t first = low;
      while (low < high) {
        const uint64_t middle = low + (high - low) / 2;
        if (keys[middle] < key)
          low = middle + 1;
        else
          high = middle;
      }
      spare[both + (k - own) + (low - first)] = key;
    }
    uint64_t* const merged = spare;
    spare = keys;
    keys = merged;
  }
  for (uint64_t k = threadIdx.x; k < length; k += kSortThreads) entries[k] = pairs[pair_of(keys[k])];
}

}  // extern "C"
}  // namespace globalsplat::cuda
