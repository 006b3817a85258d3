// Attention, softmax(q kᵀ / √w) v, of many heads at once, and its gradients: attention.h, shared among threads. The bits don't depend
// on their number.
#pragma once

#include <cstdint>

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

struct AttentionInputs {
  Heads<const float> q, k, v;
};

// Writes `out`, and log_sums[scene, head, query], which the backward pass asks for. There are keys.
void attend(const AttentionShape& shape, const AttentionInputs& in, Heads<float> out, float* log_sums, int threads);

// Of the gradient `slope` of what came out.
struct AttentionGradients {
  Heads<float> q, k, v;
};
void attend_backward(const AttentionShape& shape, const AttentionInputs& in, Heads<const float> out, const float* log_sums,
                     Heads<const float> slope, const AttentionGradients& gradients, int threads);

}  // namespace globalsplat::raster
