// Optimizer steps on torch tensors: on many at once, on a GPU with as few launches as possible, or on one. Rust calls them through cxx.
// Tensors are passed as addresses of live tensors.
#pragma once

#include <cstddef>
#include <cstdint>

#include "rust/cxx.h"

namespace globalsplat {

struct AdamArguments;  // shared with Rust, see src/optim.rs
struct AdamWOptions;
struct MuonOptions;

// Computes the norm of all elements of all tensors. `out` receives a new scalar tensor that the caller owns.
void norm(rust::Slice<const size_t> tensors, rust::Slice<size_t> out);

// Multiplies tensors by `factor` in place.
void scale(rust::Slice<const size_t> tensors, double factor);

// Resets gradients to undefined, as before the first backward pass.
void zero_grad(rust::Slice<const size_t> tensors);

// Runs a step of AdamW (spec 8.5) with libtorch's fused kernel. All tensors must be contiguous, of one type and on one device.
void fused_adamw(rust::Slice<const size_t> values, rust::Slice<const size_t> gradients, rust::Slice<const size_t> first,
                 rust::Slice<const size_t> second, const AdamWOptions& of);

// Runs a step of Muon (spec 8.5) on matrices and on the running means of their gradients. All must be contiguous float32 matrices on the
// CPU, each consisting of `parts` equally high matrices stacked vertically; throws otherwise.
void muon(rust::Slice<const size_t> values, rust::Slice<const size_t> gradients, rust::Slice<const size_t> first, const MuonOptions& of);

// Runs a step of Adam: updates a tensor and its moments in place, hidden from autograd. All four tensors must be contiguous, on the CPU, of
// one shape and type, float32 or float64; throws otherwise.
void adam(const AdamArguments& of);

}  // namespace globalsplat
