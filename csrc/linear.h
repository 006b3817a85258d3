// Linear layers on the CPU, on torch tensors, as Rust calls them through cxx.
#pragma once

#include <cstddef>

namespace globalsplat {

// xs weightsᵀ + bias: xs [.., k], weights [n, k] and bias [n], float32 or bfloat16 on the CPU; addresses of live tensors, that of the bias
// 0 where there is none. Returns the address of a new tensor [.., n] that the caller owns, with the same bits for any number of threads.
// Differentiable, once. Throws on what doesn't fit, and where the system has no memory for the products' code. Float32 is multiplied by
// oneDNN where that is faster than what libtorch takes, which is MKL; bfloat16 by libtorch's choice, which is oneDNN.
size_t linear(size_t xs, size_t weights, size_t bias);

}  // namespace globalsplat
