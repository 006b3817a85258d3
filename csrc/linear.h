// Linear layers on the CPU, on torch tensors, as Rust calls them through cxx.
#pragma once

#include <cstddef>

namespace globalsplat {

// Whether linear() of float32 is faster here than libtorch's own, which gives these products to MKL: that leaves half of the vector units
// idle on processors that aren't Intel's, oneDNN doesn't.
bool linear_is_faster();

// xs weightsᵀ + bias, by oneDNN, to which libtorch gives bfloat16 itself: xs [.., k], weights [n, k] and bias [n], float32 or bfloat16 on
// the CPU; addresses of live tensors, that of the bias 0 where there is none. Returns the address of a new tensor [.., n] that the caller
// owns. Differentiable, once. Throws on what doesn't fit, where the system has no memory for the products' code, and with float32 where
// linear_is_faster() says no.
size_t linear(size_t xs, size_t weights, size_t bias);

}  // namespace globalsplat
