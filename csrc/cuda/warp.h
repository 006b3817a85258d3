// What the 32 threads of a warp do together. All of them call these at the same time.
#pragma once

#include "call.h"

namespace globalsplat::cuda {

inline constexpr unsigned kAll = 0xFFFFFFFFu;

inline int lane() { return int(threadIdx.x) % kWarp; }
inline int warp() { return int(threadIdx.x) / kWarp; }  // of the block

// Bits of the lanes before this one.
inline unsigned before() { return (1u << lane()) - 1; }

// Of this lane's and those of the lanes before it.
template <class T>
inline T prefix_sum(T value) {
  for (int step = 1; step < kWarp; step *= 2) {
    const T other = __shfl_up_sync(kAll, value, step);
    if (lane() >= step) value += other;
  }
  return value;
}

// Which of some sums a lane has, −1: none, and the sum.
struct Folded {
  int which;
  float sum;
};

// Adds up each of `count` ≤ 16 numbers over all lanes, always in the same order. In every step one half of the lanes that
// still share their numbers keeps the first half of them, the other one the rest, so that there is little left to exchange:
// ten numbers take 12 shuffles instead of 50.
template <int count, int distance = kWarp / 2>
inline Folded fold(const float (&numbers)[count], int first = 0, int left = count) {
  if constexpr (distance == 1) {
    static_assert(count == 1);
    const float sum = numbers[0] + __shfl_xor_sync(kAll, numbers[0], 1);
    return {left > 0 && lane() % 2 == 0 ? first : -1, sum};
  } else {
    constexpr int half = (count + 1) / 2;
    const bool upper = (lane() & distance) != 0;
    float kept[half];
    for (int k = 0; k < half; ++k) {
      const float low = numbers[k], high = k + half < count ? numbers[k + half] : 0;
      kept[k] = (upper ? high : low) + __shfl_xor_sync(kAll, upper ? low : high, distance);
    }
    // One call for both halves, or the compiler makes lanes take turns.
    return fold<half, distance / 2>(kept, upper ? first + half : first, upper ? left - half : left < half ? left : half);
  }
}

}  // namespace globalsplat::cuda
