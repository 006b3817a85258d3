// Communication among processes that train together, the ranks: a key-value store and collectives. All of it uses libtorch's c10d, and Rust calls it through cxx. Tensors are passed as addresses of live tensors.
#pragma once

#include <c10/util/intrusive_ptr.h>

#include <cstddef>
#include <cstdint>
#include <exception>
#include <memory>
#include <vector>

#include "rust/cxx.h"

// The bridge to Rust includes this header, and c10d's own take seconds to parse.
namespace at {
class Tensor;
}
namespace c10d {
class Backend;
class Store;
}  // namespace c10d

namespace globalsplat {

using Ranks = c10::intrusive_ptr<c10d::Backend>;

// Key-value store that one process hosts for all.
class Store {
 public:
  explicit Store(c10::intrusive_ptr<c10d::Store> store);
  ~Store();

  // Adds to a number, initially 0, and returns the sum.
  int64_t add(rust::Str key, int64_t amount) const;

  const c10::intrusive_ptr<c10d::Store>& inner() const { return store_; }

 private:
  c10::intrusive_ptr<c10d::Store> store_;
};

// Connects to the store at `host`. The process hosts the store itself if `is_server` (with port 0: on a free port). Keys with another
// `prefix` are separate. No operation waits longer than `seconds`.
std::unique_ptr<Store> connect(rust::Str host, uint16_t port, bool is_server, rust::Str prefix, int64_t seconds);

// Return true if this build supports ranks on CPUs (Gloo) and on GPUs (NCCL).
bool has_gloo();
bool has_nccl();

// Process group of all ranks. They must call the same functions in the same order, with tensors of the same shape, type and kind of device.
class ProcessGroup {
 public:
  explicit ProcessGroup(Ranks ranks);
  ~ProcessGroup();

  // Replaces a tensor by its sum over all ranks. Work on a GPU is enqueued, not waited for.
  void all_reduce(size_t tensor) const;
  // Copies the tensor of the first rank to all other ranks.
  void broadcast(size_t tensor) const;

  // Waits for pending work. To be called on all ranks after the last successful collective; otherwise NCCL aborts.
  void shutdown() const;

 private:
  Ranks ranks_;
};

// Creates a group for tensors on GPUs (NCCL; libtorch's CUDA library must have been loaded) or on CPUs (Gloo). Collectives that take longer
// than `seconds` fail.
std::unique_ptr<ProcessGroup> new_group(bool is_on_gpus, const Store& store, int32_t rank, int32_t ranks, int64_t seconds);

}  // namespace globalsplat
