// What an optimizer does to all of its tensors at once: on a GPU in as few launches as there are, on torch tensors, as Rust calls it
// through cxx. Tensors are addresses of live ones.
#pragma once

#include <cstddef>
#include <cstdint>

#include "rust/cxx.h"

namespace globalsplat {

struct AdamWNumbers;  // shared with Rust, see src/optim.rs
struct MuonNumbers;

// The norm of all numbers together. `out` receives a new scalar tensor that the caller owns.
void norm(rust::Slice<const size_t> tensors, rust::Slice<size_t> out);

// Multiplies them in place.
void scale(rust::Slice<const size_t> tensors, double factor);

// Leaves them without gradients, as they are before the first backward pass.
void forget_gradients(rust::Slice<const size_t> tensors);

// A step of AdamW (spec 8.5) on tensors of one device, contiguous and of one type, by libtorch's own fused kernel.
void fused_adamw(rust::Slice<const size_t> values, rust::Slice<const size_t> gradients, rust::Slice<const size_t> first,
                 rust::Slice<const size_t> second, const AdamWNumbers& of);

// A step of Muon (spec 8.5) on matrices of float32 numbers on the CPU, contiguous, each `parts` matrices of one height on one another; and
// on the running means of their gradients. Throws where they are others.
void muon(rust::Slice<const size_t> values, rust::Slice<const size_t> gradients, rust::Slice<const size_t> first, const MuonNumbers& of);

}  // namespace globalsplat
