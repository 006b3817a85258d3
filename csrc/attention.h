// Attention on torch tensors. Rust calls it through cxx.
#pragma once

#include <cstddef>
#include <cstdint>

namespace globalsplat {

// Returns true if attention() supports heads of this width: with float32, or with bfloat16 if bf16 products are available. Throws if the
// memory for this test can't be allocated.
bool supports_attention(int64_t width, bool is_bf16);

// Computes softmax(q kᵀ / √(d/h)) v over h adjacent heads (kernels/attention.h). q is [B, n, d], k and v are [B, m, d] with m at least 1,
// float32 or bfloat16 on the CPU, with any strides; arguments are addresses of live tensors. Returns the address of a new contiguous tensor
// [B, n, d] of their kind that the caller owns. Differentiable once. Throws if shapes or types don't fit.
size_t attention(size_t q, size_t k, size_t v, int64_t heads);

}  // namespace globalsplat
