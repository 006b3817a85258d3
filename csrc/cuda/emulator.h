// Emulation of CUDA's built-ins for a C++ compiler, which runs kernels on a CPU. Every thread of a block has its own stack, blocks and
// threads run in an order drawn from a seed, and a thread runs until it waits for others. So each built-in guarantees what CUDA guarantees
// and no more: threads of a warp run in lockstep only if they synchronize. Under ThreadSanitizer, an access of two threads to the same
// memory without __syncthreads() or __syncwarp() between them is a race.
#pragma once

#include <cstddef>
#include <cstdint>
#include <cstring>
#include <type_traits>

#define GS_EMULATED
#define __global__
#define __launch_bounds__(...)
#define GS_SHARED(type, name, extents) type(&name) extents = ::globalsplat::cuda::emulated::shared<type extents>()
#define threadIdx (::globalsplat::cuda::emulated::thread_index())
#define blockIdx (::globalsplat::cuda::emulated::block_index())
#define blockDim (::globalsplat::cuda::emulated::block_size())
#define __syncthreads() ::globalsplat::cuda::emulated::sync_block()
#define __syncwarp() ::globalsplat::cuda::emulated::sync_warp()

namespace globalsplat::cuda::emulated {

struct Index {
  unsigned x, y;
};
Index thread_index();
Index block_index();
Index block_size();

// Barriers of a block's, or of a warp's, threads.
void sync_block();
void sync_warp();
// Barrier that also returns true if any of the block's threads passed true.
bool sync_block_or(bool given);
// Exchanges values among the threads of a warp: `out` receives all 32. It doesn't order other memory accesses. All threads must call it
// from the same line.
void exchange(int line, uint64_t given, uint64_t (&out)[32]);
// Returns shared memory: the n-th call of every thread of a block returns the same address.
void* shared_memory(size_t bytes);

template <class T>
T& shared() {
  return *static_cast<T*>(shared_memory(sizeof(T)));
}

template <class T>
T from_lane(int line, T given, int source) {
  uint64_t bits = 0, all[32];
  std::memcpy(&bits, &given, sizeof given);
  exchange(line, bits, all);
  std::memcpy(&given, &all[source], sizeof given);
  return given;
}

inline unsigned ballot(int line, bool given) {
  uint64_t all[32];
  exchange(line, given, all);
  unsigned bits = 0;
  for (int k = 0; k < 32; ++k) bits |= unsigned(all[k]) << k;
  return bits;
}
inline int own_lane() { return int(thread_index().x % 32); }

}  // namespace globalsplat::cuda::emulated

#define GS_FROM_LANE(given, source) ::globalsplat::cuda::emulated::from_lane(__LINE__, given, source)
#define GS_OWN_LANE ::globalsplat::cuda::emulated::own_lane()
#define __shfl_sync(mask, given, source) GS_FROM_LANE(given, (source) % 32)
#define __shfl_up_sync(mask, given, by) GS_FROM_LANE(given, GS_OWN_LANE >= (by) ? GS_OWN_LANE - (by) : GS_OWN_LANE)
#define __shfl_xor_sync(mask, given, by) GS_FROM_LANE(given, GS_OWN_LANE ^ (by))
#define __ballot_sync(mask, given) ::globalsplat::cuda::emulated::ballot(__LINE__, given)
#define __any_sync(mask, given) (__ballot_sync(mask, given) != 0)
#define __syncthreads_or(given) ::globalsplat::cuda::emulated::sync_block_or(given)

inline int __popc(unsigned bits) { return __builtin_popcount(bits); }
inline uint32_t __float_as_uint(float number) {
  uint32_t bits;
  std::memcpy(&bits, &number, sizeof bits);
  return bits;
}
inline uint32_t atomicAdd(uint32_t* to, uint32_t by) { return __atomic_fetch_add(to, by, __ATOMIC_RELAXED); }
