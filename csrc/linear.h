// Linear layers of float32 numbers on torch tensors, as Rust calls them through cxx.
#pragma once

#include <cstddef>

namespace globalsplat {

// Whether linear() is faster here than libtorch's own, which gives these products to MKL: that leaves half of the vector units idle on
// processors that aren't Intel's, oneDNN doesn't.
bool linear_is_faster();

// xs weightsᵀ + bias, by oneDNN: xs [.., k], weights [n, k] and bias [n], float32 on the CPU; addresses of live tensors, that of the bias
// 0 where there is none. Returns the address of a new tensor [.., n] that the caller owns. Differentiable, once. Throws on what doesn't
// fit, and where linear_is_faster() says no.
size_t linear(size_t xs, size_t weights, size_t bias);

}  // namespace globalsplat
