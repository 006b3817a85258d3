// Attention, softmax(q kᵀ / √w) v, of many heads at once, and its gradients: attention.h, parallel over threads. Results are bit-identical
// for any number of threads.
#pragma once

#include <cstdint>

#include "attention_types.h"

namespace globalsplat::raster {

// Rows of all heads, side by side: row i of head h of scene b begins at data + b · scene + i · row + h · width.
template <class Number>
struct Heads {
  Number* data;
  int64_t scene, row;
};

struct AttentionShape {
  int64_t scenes, heads, queries, keys;
  int width;  // per head, at most kAttentionWidth
};

template <class Number>
struct AttentionInputs {
  Heads<const Number> q, k, v;
};

// Computes `out` and log_sums[scene, head, query], which the backward pass needs, of float32 or bfloat16 inputs. There must be at least one
// key. bfloat16 inputs are multiplied by `gemm` (attention_bf16.h); `width` must be a multiple of 8 and the rows' stride even.
template <class Number>
void multi_head_attention(const AttentionShape& shape, const AttentionInputs<Number>& in, Heads<Number> out, float* log_sums,
                          const Bf16Gemm& gemm, int num_threads);

// Gradients of queries, keys and values, computed from the gradient `grad_out` of the output.
template <class Number>
struct AttentionGradients {
  Heads<Number> q, k, v;
};
template <class Number>
void multi_head_attention_backward(const AttentionShape& shape, const AttentionInputs<Number>& in, Heads<const Number> out,
                                   const float* log_sums, Heads<const Number> grad_out, const AttentionGradients<Number>& gradients,
                                   const Bf16Gemm& gemm, int num_threads);

}  // namespace globalsplat::raster
