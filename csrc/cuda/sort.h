// A stable radix sort of pairs by tile and depth, eight bits at a time, and prefix sums.
//
// A pass: every block counts its keys' digits (gs_count_digits), into a table [256, blocks]; its rows are summed up (gs_scan);
// and every block puts its keys where their digit's begin, after those of the blocks, warps and lanes before (gs_scatter).
#pragma once

#include "warp.h"

namespace globalsplat::cuda {

inline constexpr int kDigits = 1 << kDigitBits;
inline constexpr int kSortWarps = kSortThreads / kWarp;
inline constexpr int kWarpKeys = kWarp * kSortItems;
static_assert(kSortThreads == kDigits, "a thread a digit");

inline int digit_of(uint64_t key, int shift) { return int(key >> shift) & (kDigits - 1); }

// Of a thread's number and those of the threads before it in the block, and of all of them. `of_warps` is shared memory that
// no other sum uses until the block has met once more.
struct Sum {
  uint32_t inclusive, all;
};
inline Sum block_sum(uint32_t value, uint32_t (&of_warps)[kSortWarps]) {
  Sum sum{prefix_sum(value), 0};
  if (lane() == kWarp - 1) of_warps[warp()] = sum.inclusive;
  __syncthreads();
  for (int k = 0; k < int(blockDim.x) / kWarp; ++k) {
    if (k < warp()) sum.inclusive += of_warps[k];
    sum.all += of_warps[k];
  }
  return sum;
}

extern "C" {

// A row of `length` counts a block of any size: each becomes the sum of those before it, and totals[row] that of all.
__global__ void __launch_bounds__(kSortThreads) gs_scan(int length, uint32_t* counts, uint64_t* totals) {
  GS_SHARED(uint32_t, of_warps, [kSortWarps]);
  uint32_t* row = counts + int64_t(blockIdx.x) * length;
  uint64_t before_these = 0;
  for (int base = 0; base < length; base += int(blockDim.x) * kScanItems) {
    const int own = base + int(threadIdx.x) * kScanItems;
    uint32_t items[kScanItems], total = 0;
    for (int k = 0; k < kScanItems; ++k) {
      items[k] = own + k < length ? row[own + k] : 0;
      total += items[k];
    }
    const Sum sum = block_sum(total, of_warps);
    uint32_t next = uint32_t(before_these) + sum.inclusive - total;
    for (int k = 0; k < kScanItems && own + k < length; ++k) {
      row[own + k] = next;
      next += items[k];
    }
    before_these += sum.all;
    __syncthreads();
  }
  if (threadIdx.x == 0) totals[blockIdx.x] = before_these;
}

__global__ void __launch_bounds__(kSortThreads)
    gs_count_digits(uint32_t count, int shift, const uint64_t* keys, uint32_t* table) {
  GS_SHARED(uint32_t, counts, [kDigits]);
  counts[threadIdx.x] = 0;
  __syncthreads();
  const uint64_t begin = uint64_t(blockIdx.x) * (kSortThreads * kSortItems);
  for (int k = 0; k < kSortItems; ++k) {
    const uint64_t at = begin + uint64_t(k) * kSortThreads + threadIdx.x;
    if (at < count) atomicAdd(&counts[digit_of(keys[at], shift)], 1u);
  }
  __syncthreads();
  table[uint64_t(threadIdx.x) * gridDim.x + blockIdx.x] = counts[threadIdx.x];
}

__global__ void __launch_bounds__(kSortThreads)
    gs_scatter(uint32_t count, int shift, const uint64_t* keys, const uint32_t* values, const uint32_t* table,
               const uint64_t* totals, uint64_t* sorted_keys, uint32_t* sorted_values) {
  // First how many of a digit a warp has, then where its first goes.
  GS_SHARED(uint32_t, places, [kSortWarps][kDigits]);
  GS_SHARED(uint32_t, of_warps, [kSortWarps]);
  const int digit = int(threadIdx.x);
  for (int k = 0; k < kSortWarps; ++k) places[k][digit] = 0;
  __syncthreads();

  const uint64_t begin = (uint64_t(blockIdx.x) * kSortWarps + uint64_t(warp())) * kWarpKeys + uint64_t(lane());
  uint32_t(&own)[kDigits] = places[warp()];
  uint64_t key[kSortItems];
  uint32_t rank[kSortItems];  // among the warp's of that digit
  for (int k = 0; k < kSortItems; ++k) {
    const uint64_t at = begin + uint64_t(k) * kWarp;
    key[k] = at < count ? keys[at] : 0;
    const int of_key = at < count ? digit_of(key[k], shift) : kDigits;
    const unsigned alike = __match_any_sync(kAll, of_key);
    if (at < count) rank[k] = own[of_key] + uint32_t(__popc(alike & before()));
    __syncwarp();
    if (at < count && (alike & before()) == 0) own[of_key] += uint32_t(__popc(alike));
    __syncwarp();
  }

  // The sum, in which the block meets, also waits for all warps' counts.
  const uint32_t of_digit = uint32_t(totals[digit]);
  uint32_t next = block_sum(of_digit, of_warps).inclusive - of_digit + table[uint64_t(digit) * gridDim.x + blockIdx.x];
  for (int k = 0; k < kSortWarps; ++k) {
    const uint32_t in_warp = places[k][digit];
    places[k][digit] = next;
    next += in_warp;
  }
  __syncthreads();
  for (int k = 0; k < kSortItems; ++k) {
    const uint64_t at = begin + uint64_t(k) * kWarp;
    if (at >= count) break;
    const uint32_t place = own[digit_of(key[k], shift)] + rank[k];
    sorted_keys[place] = key[k];
    sorted_values[place] = values[at];
  }
}

// The tiles' lists from the sorted pairs: entry k, and where tile k's begin; tile_start has one more than there are tiles.
__global__ void gs_list(uint32_t count, uint32_t tiles, const uint64_t* keys, const uint32_t* values, const TileEntry* pairs,
                        TileEntry* entries, uint32_t* tile_start) {
  const uint64_t k = uint64_t(blockIdx.x) * blockDim.x + threadIdx.x;
  if (k < count) entries[k] = pairs[values[k]];
  if (k > tiles) return;
  uint32_t low = 0, high = count;
  while (low < high) {
    const uint32_t middle = low + (high - low) / 2;
    if (keys[middle] < key_of(k))
      low = middle + 1;
    else
      high = middle;
  }
  tile_start[k] = low;
}

}  // extern "C"
}  // namespace globalsplat::cuda
