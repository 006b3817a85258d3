// Linear layers on the CPU, on torch tensors. Rust calls them through cxx.
#pragma once

#include <cstddef>

namespace globalsplat {

// Computes xs weightsᵀ + bias for xs [.., k], weights [n, k] and bias [n], float32 or bfloat16 on the CPU. Arguments are addresses of live
// tensors; `bias` is 0 if there is none. Returns the address of a new tensor [.., n] that the caller owns, with the same bits for any
// number of threads. Differentiable once. Throws if shapes or types don't fit, or if the system has no memory for the products' generated
// code. Float32 products use oneDNN if it is faster than libtorch's choice, MKL; bfloat16 products use libtorch's choice, which is oneDNN.
size_t linear(size_t xs, size_t weights, size_t bias);

}  // namespace globalsplat
