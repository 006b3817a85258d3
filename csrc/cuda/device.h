// Interface of a device that runs the kernels: a GPU, or its emulation on a CPU (emulator.h).
#pragma once

#include <cstddef>
#include <cstdint>
#include <memory>
#include <utility>

#include "call.h"

namespace globalsplat::cuda {

// Uninitialized memory of a device. Kernels that were launched before it is released may still use it.
using Memory = std::shared_ptr<void>;

// Number of blocks of a launch in each dimension.
struct Blocks {
  int64_t x, y = 1;
};

// Kernel by its name, and as a function of the CPU's emulation.
struct Kernel {
  const char* name;
  void (*emulate)(void** arguments);
};

class Device {
 public:
  virtual ~Device() = default;
  virtual Memory allocate(size_t bytes) const = 0;
  // Enqueues a kernel after all previous ones. `arguments` are addresses of its arguments, which are copied.
  virtual void launch(const Kernel& kernel, Blocks blocks, int threads_per_block, void** arguments) const = 0;
  // Waits for all kernels and reads a number.
  virtual uint64_t read(const uint64_t* number) const = 0;
};

// Launches a kernel with arguments of the types in its declaration.
template <auto kernel>
struct Launch;
template <class... Parameters, void (*kernel)(Parameters...)>
struct Launch<kernel> {
  template <size_t... index>
  static void call(void** arguments, std::index_sequence<index...>) {
    kernel(*static_cast<Parameters*>(arguments[index])...);
  }
  static void emulate(void** arguments) { call(arguments, std::index_sequence_for<Parameters...>()); }

  static void on(const Device& device, const char* name, Blocks blocks, int threads_per_block, Parameters... arguments) {
    void* addresses[] = {const_cast<void*>(static_cast<const void*>(&arguments))...};
    if (blocks.x > 0 && blocks.y > 0) device.launch({name, emulate}, blocks, threads_per_block, addresses);
  }
};
#define GS_LAUNCH(device, kernel, ...) ::globalsplat::cuda::Launch<kernel>::on(device, #kernel, __VA_ARGS__)

namespace emulated {

// Device that runs kernels on the CPU. Memory is the CPU's own, aligned as on a GPU, and initially undefined. Blocks, and the threads of a
// block, run in an order drawn from `seed`, which differs in every launch.
class Emulator : public Device {
 public:
  explicit Emulator(uint64_t seed) : seed_(seed) {}
  Memory allocate(size_t bytes) const override;
  // Throws std::logic_error on a deadlock: if threads wait for others that don't arrive.
  void launch(const Kernel& kernel, Blocks blocks, int threads_per_block, void** arguments) const override;
  uint64_t read(const uint64_t* number) const override { return *number; }

 private:
  mutable uint64_t seed_;
};

}  // namespace emulated
}  // namespace globalsplat::cuda
