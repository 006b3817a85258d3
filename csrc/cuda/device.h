// What runs the kernels: a GPU, or a CPU in its place.
#pragma once

#include <cstddef>
#include <cstdint>
#include <memory>

#include "call.h"

namespace globalsplat::cuda {

// Memory of a device, not filled. Kernels that were launched before it is given up may still use it.
using Memory = std::shared_ptr<void>;

// Blocks of a launch.
struct Blocks {
  int64_t x, y = 1;
};

class Device {
 public:
  virtual ~Device() = default;
  virtual Memory allocate(size_t bytes) const = 0;
  // Has a kernel run after all that were launched before. `arguments` are addresses of its arguments, which are copied.
  virtual void launch(const char* kernel, Blocks blocks, int threads, void** arguments) const = 0;
  // Waits for all kernels.
  virtual uint64_t read(const uint64_t* number) const = 0;
};

// A kernel's arguments have to be those of its declaration.
template <class... Parameters>
struct Launch;
template <class... Parameters>
struct Launch<void(Parameters...)> {
  static void on(const Device& device, const char* kernel, Blocks blocks, int threads, Parameters... arguments) {
    void* addresses[] = {const_cast<void*>(static_cast<const void*>(&arguments))...};
    if (blocks.x > 0 && blocks.y > 0) device.launch(kernel, blocks, threads, addresses);
  }
};
#define GS_LAUNCH(device, kernel, ...) ::globalsplat::cuda::Launch<decltype(kernel)>::on(device, #kernel, __VA_ARGS__)

}  // namespace globalsplat::cuda
