// Operations of the 32 threads of a warp, which all must call them together.
#pragma once

#include "call.h"

namespace globalsplat::cuda {

inline constexpr unsigned kAll = 0xFFFFFFFFu;

inline int lane() { return int(threadIdx.x) % kWarp; }
inline int warp() { return int(threadIdx.x) / kWarp; }  // index within the block

// Two values that are read or written in one memory access.
struct alignas(8) FloatPair {
  float numbers[2];
};

// Returns the bits of the lanes before this one.
inline unsigned lanemask_lt() { return (1u << lane()) - 1; }

// Returns the inclusive prefix sum of the lanes' values.
template <class T>
inline T prefix_sum(T value) {
  for (int step = 1; step < kWarp; step *= 2) {
    const T other = __shfl_up_sync(kAll, value, step);
    if (lane() >= step) value += other;
  }
  return value;
}

// Returns the same value, but makes the compiler keep it instead of recomputing it repeatedly in a loop.
inline int keep_in_register(int number) { return __shfl_sync(kAll, number, lane()); }

// Sums each of `count` ≤ 16 values over `lanes` adjacent lanes, always in the same order. In every step one half of the lanes that still
// share their values keeps the first half of the values, and the other half the rest, which reduces the exchange: ten values of 16 lanes
// take 11 shuffles instead of 40. Each lane is left with the sum of value number `which`, or with none if that is −1.
template <int count, int lanes>
class WarpReduction {
 public:
  WarpReduction() : which(keep_in_register(number<count, lanes / 2>(0, count))) {
    for (int k = 0; k < kSteps; ++k) is_upper_[k] = keep_in_register(lane() >> k & 1);
  }
  float operator()(const float (&numbers)[count]) const { return sum<count, kSteps - 1>(numbers); }

  const int which;

 private:
  static constexpr int kSteps = lanes == 32 ? 5 : 4;
  static_assert(lanes == 1 << kSteps && count <= 16, "a power of two");

  // Returns which of the values from `first` on, of which only `left` exist, a lane is left with.
  template <int shared, int distance>
  static int number(int first, int left) {
    const bool upper = (lane() & distance) != 0;
    if constexpr (distance == 0) {
      return left > 0 ? first : -1;
    } else if constexpr (shared == 1) {
      return number<1, distance / 2>(first, upper ? 0 : left);
    } else {
      constexpr int half = (shared + 1) / 2;
      return number<half, distance / 2>(upper ? first + half : first, upper ? left - half : left < half ? left : half);
    }
  }

  template <int shared, int step>
  float sum(const float (&numbers)[shared]) const {
    if constexpr (step < 0) {
      return numbers[0];
    } else if constexpr (shared == 1) {
      const float both[1] = {numbers[0] + __shfl_xor_sync(kAll, numbers[0], 1 << step)};
      return sum<1, step - 1>(both);
    } else {
      constexpr int half = (shared + 1) / 2;
      const bool upper = is_upper_[step] != 0;
      float kept[half];
      for (int k = 0; k < half; ++k) {
        const float low = numbers[k], high = k + half < shared ? numbers[k + half] : 0;
        kept[k] = (upper ? high : low) + __shfl_xor_sync(kAll, upper ? low : high, 1 << step);
      }
      return sum<half, step - 1>(kept);
    }
  }

  int is_upper_[kSteps];  // 1 if this lane is in the upper half of 2, 4, 8, … lanes
};

}  // namespace globalsplat::cuda
