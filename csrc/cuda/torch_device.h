// Devices that hold torch tensors: a GPU, or its emulation on a CPU.
#pragma once

#include <ATen/core/Tensor.h>
#include <ATen/ops/empty.h>
#include <ATen/ops/from_blob.h>
#include <c10/core/DeviceGuard.h>
#include <c10/core/Stream.h>
#include <c10/core/impl/VirtualGuardImpl.h>

#include <cstdlib>
#include <functional>
#include <memory>

#include "device.h"
#include "globalsplat-csrc/src/cuda.rs.h"

namespace globalsplat::cuda {

// Returns a view of a device's memory as a tensor with `options`. It is valid as long as the memory.
inline at::Tensor tensor_of(const void* memory, at::IntArrayRef size, const at::TensorOptions& options) {
  return at::for_blob(const_cast<void*>(memory), size).options(options).target_device(options.device()).make_tensor();
}

// Calls `launch`, which launches one kernel in `stream`, between two events if measurement is on.
void measured_launch(const char* kernel, const c10::Stream& stream, const std::function<void()>& launch);

// GPU of a tensor: memory from torch's allocator, kernels in torch's current stream.
class Gpu : public Device {
 public:
  explicit Gpu(const at::Tensor& on) : guard_(on.device()), options_(on.options()) {}

  Memory allocate(size_t bytes) const override {
    const at::Tensor held = at::empty({int64_t(bytes)}, options_.dtype(at::kByte));
    return Memory(held.data_ptr(), [held](void*) {});
  }

  void launch(const Kernel& kernel, Blocks blocks, int threads_per_block, void** arguments) const override {
    const at::Device device = options_.device();
    const c10::Stream stream = c10::impl::VirtualGuardImpl(device.type()).getStream(device);
    measured_launch(kernel.name, stream, [&] {
      launch_kernel(device.index(), reinterpret_cast<size_t>(stream.native_handle()), kernel.name,
                    {uint32_t(blocks.x), uint32_t(blocks.y)}, uint32_t(threads_per_block), reinterpret_cast<size_t>(arguments));
    });
  }

  uint64_t read(const uint64_t* number) const override {
    return uint64_t(tensor_of(number, {1}, options_.dtype(at::kLong)).item<int64_t>());
  }

 private:
  c10::DeviceGuard guard_;
  at::TensorOptions options_;
};

// Returns the variable that enables emulation, a number that seeds the order of blocks and threads; null if it isn't set.
inline const char* emulation() { return std::getenv("GLOBALSPLAT_CUDA_ON_CPU"); }

// Returns the device whose kernels process a tensor; null if the CPU's kernels do, which also process float64, used to verify gradients.
inline std::unique_ptr<Device> kernel_device(const at::Tensor& t) {
  if (t.scalar_type() != at::kFloat) return nullptr;
  if (const char* seed = emulation()) return std::make_unique<emulated::Emulator>(std::strtoull(seed, nullptr, 10));
  return t.is_cuda() ? std::make_unique<Gpu>(t) : nullptr;
}

}  // namespace globalsplat::cuda
