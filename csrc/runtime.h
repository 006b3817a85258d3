// What the process runs on: copies to a GPU, events and memory of a GPU, the processor, threads, and records of what libtorch runs. GPUs are
// accessed by torch's device-independent interfaces, which need no CUDA headers and work with a libtorch without CUDA. Rust calls all of it
// through cxx.
#pragma once

#include <ATen/core/Tensor.h>
#include <c10/core/Event.h>
#include <c10/core/Stream.h>

#include <cstddef>
#include <cstdint>
#include <memory>
#include <vector>

#include "rust/cxx.h"

namespace globalsplat {

// Returns the tensor that Rust passes as its address.
inline const at::Tensor& borrowed(size_t address) { return *reinterpret_cast<const at::Tensor*>(address); }

// Returns the address of a tensor that belongs to Rust from now on.
inline size_t owned(const at::Tensor& tensor) { return reinterpret_cast<size_t>(new at::Tensor(tensor)); }

// Event that records when a GPU has completed the work enqueued in its current stream so far.
struct CudaEvent {
  c10::Event event;

  // Returns the milliseconds since `earlier`. Waits until the GPU has reached both events.
  double milliseconds_since(const CudaEvent& earlier) const;
};

std::unique_ptr<CudaEvent> record_event(int32_t gpu);

// New tensors on a GPU, and the event after which they hold the copied data.
struct PendingCopies {
  std::vector<at::Tensor> tensors;
  c10::Event done;

  // Passes the tensors to the caller, once and in order. Work that is enqueued in the GPU's current stream from now on waits for the
  // copies; the host doesn't.
  rust::Vec<size_t> take_tensors() const;
};

// Stream that is used only for copies. One stream serves all of them, because freed memory is reused only in the stream for which it was
// allocated.
struct CopyStream {
  c10::Stream stream;

  // Starts copying host tensors, given by their addresses. Tensors outside of page-locked memory are first copied into it. The originals
  // may be freed at once.
  std::unique_ptr<PendingCopies> copy(rust::Slice<const size_t> tensors) const;
};

std::unique_ptr<CopyStream> copy_stream(int32_t gpu);

// Allocates an uninitialized byte tensor in page-locked host memory, from which a GPU can copy by itself. The caller owns it.
size_t empty_pinned_bytes(rust::Slice<const int64_t> shape);

// Returns the peak of the bytes that tensors take on a GPU since the start of the program or the last reset; the second function resets it.
uint64_t max_memory_allocated(int32_t gpu);
void reset_peak_memory_stats(int32_t gpu);

// Disables TF32 in CUDA's float32 convolutions, which by default round factors to TF32's 11 bits. Matrix products don't use TF32 by
// default.
void disable_tf32();

enum class Bf16Support : uint8_t;

// Limit that GLOBALSPLAT_SIMD sets on the instruction sets of our own kernels and those of libtorch, oneDNN and MKL: `avx2` disables
// AVX-512 and bf16, `portable` disables AVX2 as well.
enum class SimdLimit { None, Avx2, Portable };
SimdLimit simd_limit();

// Returns the CPU's bf16 instructions that libtorch detects, or None if GLOBALSPLAT_SIMD disables them. Without such instructions, bf16
// products are slower than float32 products.
Bf16Support cpu_bf16_support();

// Returns true if the current GPU has bf16 instructions.
bool gpu_has_bf16();

// Returns the instruction set of libtorch's own kernels, such as "AVX2".
rust::String libtorch_simd_level();

// Makes this thread, and threads that it starts later, treat denormal numbers as 0. Does nothing on processors that don't support this.
void flush_denormals();

// Returns the number that set_num_threads() has set, by default libtorch's number of threads.
int get_num_threads();

// Sets the number of threads; 0 restores the default.
void set_num_threads(int count);

// Begins recording the libtorch ops that this thread runs, backward passes included.
void start_recording_ops();

// Ends recording and returns the ops in order.
struct RecordedOp;
rust::Vec<RecordedOp> stop_recording_ops();

// Begins counting the bytes that this thread allocates and frees for CPU tensors.
void start_counting_tensor_bytes();

// Ends counting and returns the peak.
uint64_t stop_counting_tensor_bytes();

// Returns the version of the libtorch whose headers this was compiled with.
rust::String libtorch_version();

// Makes libtorch's errors carry no stack trace from now on. A stack trace allocates memory without handling failures, and it is captured
// and formatted for every error.
void disable_stack_traces();

}  // namespace globalsplat
