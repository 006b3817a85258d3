// Emulation of a GPU on a CPU: see emulator.h.
#pragma once

#include "device.h"

namespace globalsplat::cuda::emulated {

// Device that runs kernels on the CPU. Memory is the CPU's own, aligned as on a GPU, and initially undefined. Blocks, and the threads of a
// block, run in an order drawn from `seed`, which differs in every launch.
class Emulator : public Device {
 public:
  explicit Emulator(uint64_t seed) : seed_(seed) {}
  Memory allocate(size_t bytes) const override;
  // Throws std::logic_error on a deadlock: if threads wait for others that don't arrive.
  void launch(const char* kernel, Blocks blocks, int threads_per_block, void** arguments) const override;
  uint64_t read(const uint64_t* number) const override { return *number; }

 private:
  mutable uint64_t seed_;
};

// Kernel with its name, to be called on the stack of an emulated thread.
struct Kernel {
  const char* name;
  void (*run)(void** arguments);
};
const Kernel* kernel_named(const char* name);  // null if there is none

}  // namespace globalsplat::cuda::emulated
