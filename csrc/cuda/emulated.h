// A CPU in a GPU's place: see emulator.h.
#pragma once

#include "device.h"

namespace globalsplat::cuda::emulated {

// Memory is the CPU's own, aligned as a GPU's, and begins as anything. Blocks, and the threads of a block, take turns in an
// order drawn from `seed`, another one in every launch.
class Emulator : public Device {
 public:
  explicit Emulator(uint64_t seed) : seed_(seed) {}
  Memory allocate(size_t bytes) const override;
  // Throws std::logic_error where threads wait for others that don't come.
  void launch(const char* kernel, Blocks blocks, int threads, void** arguments) const override;
  uint64_t read(const uint64_t* number) const override { return *number; }

 private:
  mutable uint64_t seed_;
};

// A kernel by its name, to be called on a thread's stack.
struct Kernel {
  const char* name;
  void (*run)(void** arguments);
};
const Kernel* kernel_named(const char* name);  // null: there is none

// How many barriers the text has, and to have threads pass by one of them from now on, to see whether that is noticed.
int barriers();
void leave_out_barrier(int place);

}  // namespace globalsplat::cuda::emulated
