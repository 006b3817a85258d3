// GPU utilities: copies from the host on a separate stream, events that measure time, and memory statistics. They use torch's
// device-independent interfaces, so they need no CUDA headers and work with a libtorch without CUDA.
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

// Event that records when a GPU has completed the work enqueued in its current stream so far.
class CudaEvent {
 public:
  explicit CudaEvent(int32_t gpu);

  // Returns the milliseconds since `earlier`. Waits until the GPU has reached both events.
  double milliseconds_since(const CudaEvent& earlier) const;

 private:
  c10::Event event_;
};

std::unique_ptr<CudaEvent> record_event(int32_t gpu);

// New tensors on a GPU, and the event after which they hold the copied data.
class PendingCopies {
 public:
  PendingCopies(std::vector<at::Tensor> tensors, c10::Event done);

  // Passes the tensors to the caller, once and in order. Work that is enqueued in the GPU's current stream from now on waits for the
  // copies; the host doesn't.
  void take_tensors(rust::Slice<size_t> out) const;

 private:
  std::vector<at::Tensor> tensors_;
  c10::Event done_;
};

// Stream that is used only for copies. One stream serves all of them, because freed memory is reused only in the stream for which it was
// allocated.
class CopyStream {
 public:
  explicit CopyStream(int32_t gpu);

  // Starts copying host tensors, given by their addresses. Tensors outside of page-locked memory are first copied into it. The originals
  // may be freed at once.
  std::unique_ptr<PendingCopies> copy(rust::Slice<const size_t> tensors) const;

 private:
  c10::Stream stream_;
};

std::unique_ptr<CopyStream> copy_stream(int32_t gpu);

// Allocates an uninitialized byte tensor in page-locked host memory, from which a GPU can copy by itself. The caller owns it.
void empty_pinned_bytes(rust::Slice<const int64_t> shape, rust::Slice<size_t> out);

// Returns the peak of the bytes that tensors take on a GPU since the start of the program or the last reset; the second function resets it.
uint64_t max_memory_allocated(int32_t gpu);
void reset_peak_memory_stats(int32_t gpu);

// Disables TF32 in CUDA's float32 convolutions, which by default round factors to TF32's 11 bits. Matrix products don't use TF32 by
// default.
void disable_tf32();

}  // namespace globalsplat
