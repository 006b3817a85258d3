// Attention on torch tensors, as Rust calls it through cxx.
#pragma once

#include <cstddef>
#include <cstdint>

namespace globalsplat {

// Whether attention() takes heads of that width: of float32 numbers, or of bfloat16 where there are products for them. Throws where
// memory to find that out is refused.
bool attention_takes(int64_t width, bool is_bf16);

// softmax(q kᵀ / √(d/h)) v over h heads side by side (raster/attention.h): q [B, n, d], k and v [B, m, d], m at least 1, float32 or
// bfloat16 on the CPU, any strides; addresses of live tensors. Returns that of a new contiguous tensor [B, n, d] of their kind that the
// caller owns. Differentiable, once. Throws on what doesn't fit.
size_t attention(size_t q, size_t k, size_t v, int64_t heads);

}  // namespace globalsplat
