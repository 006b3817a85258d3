// Stable parallel counting sort: of splats by depth, and of (splat, tile) pairs into the tiles' lists.
#pragma once

#include <cstring>
#include <memory>
#include <type_traits>
#include <vector>

#include "parallel.h"
#include "types.h"

namespace globalsplat::raster {

// Uninitialized array.
template <class T>
struct Buffer {
  std::unique_ptr<T[]> data;
  size_t size = 0;

  Buffer() = default;
  explicit Buffer(size_t n) : data(new T[n]), size(n) {}
  T& operator[](size_t i) { return data[i]; }
  const T& operator[](size_t i) const { return data[i]; }
};

// Distributes the items of several lists among buckets, each list by itself, keeping the order within a bucket. Each list is split into
// `chunks` consecutive chunks, which are counted and placed in parallel.
//   count(list, chunk, visit)  calls visit(bucket) for the chunk's items, in any order
//   each(list, chunk, visit)   calls visit(bucket, item) for them in order
//   place(list, at, item)      stores the item at its position in the sorted list
// Returns the start of every bucket for every list, followed by the end of the last one.
template <class Count, class Each, class Place>
std::vector<Buffer<uint32_t>> counting_sort(int num_threads, int64_t lists, int64_t chunks, int64_t buckets, const Count& count,
                                            const Each& each, const Place& place) {
  std::vector<Buffer<uint32_t>> starts(lists), next(lists);
  for (int64_t list = 0; list < lists; ++list) {
    starts[size_t(list)] = Buffer<uint32_t>(size_t(buckets + 1));
    next[size_t(list)] = Buffer<uint32_t>(size_t(chunks * buckets));
  }
  parallel_for(num_threads, lists * chunks, [&](int64_t task) {
    const int64_t list = task / chunks, chunk = task % chunks;
    uint32_t* counts = next[size_t(list)].data.get() + chunk * buckets;
    std::memset(counts, 0, size_t(buckets) * sizeof(uint32_t));
    count(list, chunk, [&](int64_t bucket) { ++counts[bucket]; });
  });
  parallel_for(num_threads, lists, [&](int64_t list) {
    Buffer<uint32_t>&start = starts[size_t(list)], &at = next[size_t(list)];
    uint32_t sum = 0;
    for (int64_t bucket = 0; bucket < buckets; ++bucket) {
      start[size_t(bucket)] = sum;
      for (int64_t chunk = 0; chunk < chunks; ++chunk) {
        const uint32_t count = at[size_t(chunk * buckets + bucket)];
        at[size_t(chunk * buckets + bucket)] = sum;
        sum += count;
      }
    }
    start[size_t(buckets)] = sum;
  });
  parallel_for(num_threads, lists * chunks, [&](int64_t task) {
    const int64_t list = task / chunks, chunk = task % chunks;
    uint32_t* at = next[size_t(list)].data.get() + chunk * buckets;
    each(list, chunk, [&](int64_t bucket, const auto& item) { place(list, at[bucket]++, item); });
  });
  return starts;
}

// Item of a list that is sorted by depth.
template <class T>
struct DepthItem {
  std::conditional_t<sizeof(T) == 4, uint32_t, uint64_t> key;  // bits of z, whose order is that of the positive numbers
  uint32_t splat;
};

// Sorts every list of items by key with a stable radix sort, 11 bits at a time.
template <class T>
void sort_by_depth(int num_threads, std::vector<Buffer<DepthItem<T>>>& lists, int64_t chunks) {
  constexpr int kBits = 11;
  std::vector<Buffer<DepthItem<T>>> sorted(lists.size());
  for (size_t i = 0; i < lists.size(); ++i) sorted[i] = Buffer<DepthItem<T>>(lists[i].size);
  for (int shift = 0; shift < int(8 * sizeof(T)); shift += kBits) {
    const auto each = [&](int64_t list, int64_t chunk, const auto& visit) {
      const Buffer<DepthItem<T>>& items = lists[size_t(list)];
      const size_t begin = items.size * size_t(chunk) / size_t(chunks);
      const size_t end = items.size * size_t(chunk + 1) / size_t(chunks);
      for (size_t i = begin; i < end; ++i) visit(int64_t(items[i].key >> shift) & ((1 << kBits) - 1), items[i]);
    };
    counting_sort(
        num_threads, int64_t(lists.size()), chunks, int64_t(1) << kBits,
        [&](int64_t list, int64_t chunk, const auto& visit) {
          each(list, chunk, [&](int64_t bucket, const auto&) { visit(bucket); });
        },
        each,
        [&](int64_t list, uint32_t at, const DepthItem<T>& item) { sorted[size_t(list)][at] = item; });
    lists.swap(sorted);
  }
}

}  // namespace globalsplat::raster
