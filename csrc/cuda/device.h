// Interface of a device that runs the kernels: a GPU, or its emulation on a CPU.
#pragma once

#include <cstddef>
#include <cstdint>
#include <memory>

#include "call.h"

namespace globalsplat::cuda {

// Uninitialized memory of a device. Kernels that were launched before it is released may still use it.
using Memory = std::shared_ptr<void>;

// Number of blocks of a launch in each dimension.
struct Blocks {
  int64_t x, y = 1;
};

class Device {
 public:
  virtual ~Device() = default;
  virtual Memory allocate(size_t bytes) const = 0;
  // Enqueues a kernel after all previous ones. `arguments` are addresses of its arguments, which are copied.
  virtual void launch(const char* kernel, Blocks blocks, int threads_per_block, void** arguments) const = 0;
  // Waits for all kernels and reads a number.
  virtual uint64_t read(const uint64_t* number) const = 0;
};

// Launches a kernel with arguments of the types in its declaration.
template <class... Parameters>
struct Launch;
template <class... Parameters>
struct Launch<void(Parameters...)> {
  static void on(const Device& device, const char* kernel, Blocks blocks, int threads_per_block, Parameters... arguments) {
    void* addresses[] = {const_cast<void*>(static_cast<const void*>(&arguments))...};
    if (blocks.x > 0 && blocks.y > 0) device.launch(kernel, blocks, threads_per_block, addresses);
  }
};
#define GS_LAUNCH(device, kernel, ...) ::globalsplat::cuda::Launch<decltype(kernel)>::on(device, #kernel, __VA_ARGS__)

}  // namespace globalsplat::cuda
