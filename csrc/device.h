// What a GPU does beside its work: copies from the host on a stream of their own, and marks in a stream that tell when it came by. In
// torch's words for any kind of device, so that no header of CUDA is needed, and a libtorch without it will do.
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

// When a GPU was done with what had been given to its current stream.
class Mark {
 public:
  explicit Mark(int32_t gpu);

  // Milliseconds from `earlier` on. Waits until the GPU has come by both.
  double since(const Mark& earlier) const;

 private:
  c10::Event event_;
};

std::unique_ptr<Mark> mark(int32_t gpu);

// New tensors on a GPU, and when they hold what was copied.
class Copies {
 public:
  Copies(std::vector<at::Tensor> tensors, c10::Event done);

  // Leaves the tensors to the caller, once, in their order. What the GPU's current stream is given from now on waits for the copies; the
  // host doesn't.
  void hand_over(rust::Slice<size_t> out) const;

 private:
  std::vector<at::Tensor> tensors_;
  c10::Event done_;
};

// A stream for nothing but copies. One is kept for all of them: memory that is freed serves the stream that it was taken for.
class CopyStream {
 public:
  explicit CopyStream(int32_t gpu);

  // Begins to copy tensors of the host, by their addresses; those that aren't in page-locked memory are brought there first. The
  // originals may be freed at once.
  std::unique_ptr<Copies> copy(rust::Slice<const size_t> tensors) const;

 private:
  c10::Stream stream_;
};

std::unique_ptr<CopyStream> copy_stream(int32_t gpu);

// A new tensor of bytes, uninitialized, in page-locked memory of the host: a GPU copies from there by itself. The caller owns it.
void page_locked_bytes(rust::Slice<const int64_t> shape, rust::Slice<size_t> out);

// Bytes that tensors on a GPU took at the most, since the program began or since that was forgotten.
uint64_t peak_bytes(int32_t gpu);
void forget_peak_bytes(int32_t gpu);

// CUDA's convolutions of float32 round what they multiply to TF32's 11 bits unless they are told not to, as matrix products are.
void leave_out_tf32();

}  // namespace globalsplat
