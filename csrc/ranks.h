// Processes that train together, the ranks: words that they leave for each other, what they add up, and gradients that are added up while
// the backward pass still goes on. All of it by libtorch's own c10d, as Rust calls it through cxx. Tensors are addresses of live ones.
#pragma once

#include <ATen/core/Tensor.h>
#include <torch/csrc/distributed/c10d/Backend.hpp>
#include <torch/csrc/distributed/c10d/Store.hpp>

#include <cstddef>
#include <cstdint>
#include <exception>
#include <memory>
#include <vector>

#include "rust/cxx.h"

namespace globalsplat {

using Ranks = c10::intrusive_ptr<c10d::Backend>;

// Words by their keys, kept by one process for all.
class Store {
 public:
  explicit Store(c10::intrusive_ptr<c10d::Store> store);

  // A connection of its own, for another thread.
  std::unique_ptr<Store> another() const;

  // Adds to a number, at first 0, and returns the sum.
  int64_t add(rust::Str key, int64_t amount) const;

  const c10::intrusive_ptr<c10d::Store>& inner() const { return store_; }

 private:
  c10::intrusive_ptr<c10d::Store> store_;
};

// The store at `host`, which this process keeps if it `serves` (at port 0: one that is free); keys of other `prefix`es are others'.
// Nothing is waited for longer than `seconds`.
std::unique_ptr<Store> connect(rust::Str host, uint16_t port, bool serves, rust::Str prefix, int64_t seconds);

// Whether this build has what ranks need on CPUs (Gloo), and on GPUs (NCCL).
bool has_gloo();
bool has_nccl();

// All ranks. They call the same functions in the same order, with tensors of the same shape, type and kind of device.
class Group {
 public:
  explicit Group(Ranks ranks);

  // The sum over all ranks, in place of what each has. A GPU's work is ordered, not waited for.
  void all_reduce(size_t tensor) const;
  // What rank `from` has, in place of what the others have.
  void broadcast(size_t tensor, int32_t from) const;
  // `out` receives a new tensor that the caller owns: what every rank has, one after the other along a new first dimension.
  void all_gather(size_t tensor, rust::Slice<size_t> out) const;

  // After the last call, on all ranks, where all went well: waits for what is under way. Without it NCCL breaks off.
  void shut_down() const { ranks_->shutdown(); }

  const Ranks& ranks() const { return ranks_; }

 private:
  Ranks ranks_;
};

// A call that takes longer than `seconds` fails.
std::unique_ptr<Group> gloo(const Store& store, int32_t rank, int32_t ranks, int64_t seconds);
// The same for tensors on GPUs. libtorch's half for CUDA must have been loaded.
std::unique_ptr<Group> nccl(const Store& store, int32_t rank, int32_t ranks, int64_t seconds);

// The gradients of a step, added up over all ranks bucket by bucket: each leaves as soon as the backward pass has given all that is in it
// and the one before it has left, so that the order is the same everywhere.
class Buckets {
 public:
  // `parameters` in the order in which their gradients come, about; `bytes` of them make a bucket.
  Buckets(Ranks ranks, std::vector<at::Tensor> parameters, int64_t bytes);
  ~Buckets();
  Buckets(const Buckets&) = delete;

  // What the backward pass gives from now on is the last of this step.
  void begin() const;
  // Sends what is left, and waits for all (a GPU's work is ordered, not waited for). Gradients are the ranks' sums now. Returns how many
  // there are, which must be the same on all ranks.
  size_t finish() const;

 private:
  struct State;
  std::shared_ptr<State> state_;
};

std::unique_ptr<Buckets> buckets(const Group& group, rust::Slice<const size_t> parameters, int64_t bytes);

}  // namespace globalsplat
