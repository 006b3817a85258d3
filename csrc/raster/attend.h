// Attention, softmax(q kᵀ / √w) v, of many heads at once, and its gradients: attention.h, shared among threads. The bits don't depend
// on their number.
#pragma once

#include <cstdint>

#include "rows.h"

namespace globalsplat::raster {

// The numbers of all heads, side by side: row i of head h of scene b begins at data + b · scene + i · row + h · width.
template <class Number>
struct Heads {
  Number* data;
  int64_t scene, row;
};

struct AttentionShape {
  int64_t scenes, heads, queries, keys;
  int width;  // of a head, at most kAttentionWidth
};

template <class Number>
struct AttentionInputs {
  Heads<const Number> q, k, v;
};

// Writes `out`, and log_sums[scene, head, query], which the backward pass asks for. There are keys.
void attend(const AttentionShape& shape, const AttentionInputs<float>& in, Heads<float> out, float* log_sums, int threads);

// The same of bfloat16 numbers, whose `width` is a multiple of 8 and whose rows are an even number of them apart, by `products`
// (attention_bf16.h).
void attend_bf16(const AttentionShape& shape, const AttentionInputs<Bf16>& in, Heads<Bf16> out, float* log_sums,
                 const Bf16Products& products, int threads);

// Of the gradient `slope` of what came out.
template <class Number>
struct AttentionGradients {
  Heads<Number> q, k, v;
};
void attend_backward(const AttentionShape& shape, const AttentionInputs<float>& in, Heads<const float> out, const float* log_sums,
                     Heads<const float> slope, const AttentionGradients<float>& gradients, int threads);
void attend_backward_bf16(const AttentionShape& shape, const AttentionInputs<Bf16>& in, Heads<const Bf16> out, const float* log_sums,
                          Heads<const Bf16> slope, const AttentionGradients<Bf16>& gradients, const Bf16Products& products,
                          int threads);

}  // namespace globalsplat::raster
