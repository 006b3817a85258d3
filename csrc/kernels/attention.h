// Attention of one head: out = softmax(q kᵀ / √w) v over rows of w elements (spec 4.2), forward and backward. Scores never leave the caches
// (FlashAttention, Dao et al. 2022): keys come in blocks, and a query's previous sums are scaled down whenever a larger score is found
// (Milakov & Gimelshein 2018). With s = q kᵀ · log₂e / √w, so that softmax's exponentials have base 2:
//
//   m = maxⱼ sⱼ,  l = Σⱼ 2^(sⱼ − m),  out = Σⱼ 2^(sⱼ − m) vⱼ / l,  L = m + log₂ l
//
// The backward pass recomputes the scores. For a gradient g of `out`, and p = 2^(s − L):
//
//   dv = pᵀ g,  ds = p ⊙ (g vᵀ − Σ g ⊙ out),  dq = ds k / √w,  dk = dsᵀ q / √w
#pragma once

#include "product.h"

namespace globalsplat::raster::GS_ISA {

// Computes 2^x; results below the smallest normal number are 0, and NaN gives NaN.
GS_INLINE Vector<float> power_of_two(Vector<float> x) {
  return exp2_where(Mask<float>(~less(x, broadcast<float>(-126))), x);
}

static_assert(kForwardKeys % kProductColumns == 0 && kBackwardKeys % kProductColumns == 0 && kBackwardKeys % kProductRows == 0 &&
              kBackwardQueries % kProductRows == 0 && kAttentionQueries % kProductRows == 0);

// Returns the maximum of `count` scores and of `largest`. Sets the scores after them, up to `columns`, to −∞.
GS_INLINE float largest_score(float* scores, int64_t count, int64_t columns, float largest) {
  constexpr int lanes = Simd<float>::lanes;
  for (int64_t j = count; j < columns; ++j) scores[j] = -__builtin_inff();
  Vector<float> most = broadcast<float>(largest);
  for (int64_t j = 0; j < columns; j += lanes) most = larger(load<float>(scores + j), most);
  return largest_lane(most);
}

inline void attention_forward(const AttentionHead<float>& head, Rows<float> out, float* log_sums, float* memory) {
  using V = Vector<float>;
  constexpr int lanes = Simd<float>::lanes;
  const int width = head.width, columns = attention_columns(width);
  const int64_t queries = whole_product_rows(head.queries);
  const float scale = float(kLog2E / __builtin_sqrt(double(width)));

  ScratchArena scratch(memory);
  float* const q = scratch.take(queries * columns);
  float* const sums = scratch.take(queries * columns);     // of values
  float* const weights = scratch.take(queries * lanes);    // l, in partial sums
  float* const most = scratch.take(queries);               // m
  float* const k = scratch.take(kForwardKeys * width);
  float* const v = scratch.take(kForwardKeys * columns);
  float* const scores = scratch.take(kProductRows * kForwardKeys);

  pack_rows(head.q, head.queries, width, scale, columns, queries, q);
  for (int64_t i = 0; i < queries; ++i) most[i] = -__builtin_inff();
  for (int64_t i = 0; i < queries * columns; ++i) sums[i] = 0;
  for (int64_t i = 0; i < queries * lanes; ++i) weights[i] = 0;

  for (int64_t first = 0; first < head.keys; first += kForwardKeys) {
    const int64_t count = head.keys - first < kForwardKeys ? head.keys - first : kForwardKeys;
    const int64_t whole = (count + lanes - 1) / lanes * lanes;
    pack_panels(head.k.from(first), count, width, k);
    pack_rows(head.v.from(first), count, width, 1, columns, count, v);
    for (int64_t i = 0; i < queries; i += kProductRows) {
      for (int64_t j = 0; j < count; j += kProductColumns)
        multiply_panel<kProductVectors, true>({q + i * columns, columns, 1}, k + j * width, kProductColumns, width, scores + j,
                                              kForwardKeys, nullptr);
      float shrink[kProductRows];
      for (int r = 0; r < kProductRows; ++r) {
        float* const row = scores + r * kForwardKeys;
        const float before = most[i + r], now = largest_score(row, count, whole, before);
        most[i + r] = now;
        const V shift = broadcast<float>(now), smaller = power_of_two(broadcast<float>(before) - shift);
        float* const weight = weights + (i + r) * lanes;
        V sum = load<float>(weight) * smaller;
        for (int64_t j = 0; j < whole; j += lanes) {
          const V p = power_of_two(load<float>(row + j) - shift);
          store<float>(row + j, p);
          sum = sum + p;
        }
        store<float>(weight, sum);
        shrink[r] = smaller[0];
      }
      multiply_rows<false>({scores, kForwardKeys, 1}, v, columns, count, sums + i * columns, columns, columns, shrink);
    }
  }
  for (int64_t i = 0; i < head.queries; ++i) {
    const float weight = float(sum_of_lanes<float>(load<float>(weights + i * lanes)));
    log_sums[i] = most[i] + float(__builtin_log2(double(weight)));
    for (int c = 0; c < width; ++c) out.data[i * out.stride + c] = sums[i * columns + c] / weight;
  }
}

// Packs some of a head's queries for attention_backward(), with the output of the forward pass and its gradient. Only the last of them may
// be fewer than whole_product_rows().
inline void pack_queries(const AttentionHead<float>& head, const AttentionOutputs<float>& outputs, const PackedQueries& to) {
  const int width = head.width, columns = attention_columns(width);
  const float scale = float(kLog2E / __builtin_sqrt(double(width)));
  const int64_t whole = whole_product_rows(head.queries);
  pack_rows(head.q, head.queries, width, scale, columns, whole, to.q);
  pack_rows(outputs.grad_out, head.queries, width, 1, columns, whole, to.grad_out);
  for (int64_t i = 0; i < head.queries; ++i) {
    const float *const out = outputs.out.data + i * outputs.out.stride, *const grad_out = to.grad_out + i * columns;
    double sum = 0;
    for (int c = 0; c < width; ++c) sum += double(out[c]) * double(grad_out[c]);
    to.means[i] = float(sum);
  }
}

// Computes the backward pass for the keys and values in `head`, which may be only some of those of the forward pass. Writes their gradients
// to `dk` and `dv`. Writes their contribution to the gradient of q, times √w, to `dq`, [whole_product_rows(queries),
// attention_columns(width)].
inline void attention_backward(const AttentionHead<float>& head, const PackedQueries& of, const float* log_sums, float* dq, Rows<float> dk,
                               Rows<float> dv, float* memory) {
  using V = Vector<float>;
  constexpr int lanes = Simd<float>::lanes;
  const int width = head.width, columns = attention_columns(width);

  ScratchArena scratch(memory);
  const auto take_keys = [&] { return scratch.take(kBackwardKeys * columns); };
  float *const k_panels = take_keys(), *const v_panels = take_keys(), *const k = take_keys();
  float *const dk_sums = take_keys(), *const dv_sums = take_keys();
  float* const p = scratch.take(kBackwardQueries * kBackwardKeys);
  float* const ds = scratch.take(kBackwardQueries * kBackwardKeys);

  for (int64_t i = 0; i < whole_product_rows(head.queries) * columns; ++i) dq[i] = 0;
  for (int64_t first = 0; first < head.keys; first += kBackwardKeys) {
    const int64_t count = head.keys - first < kBackwardKeys ? head.keys - first : kBackwardKeys;
    pack_panels(head.k.from(first), count, width, k_panels);
    pack_panels(head.v.from(first), count, width, v_panels);
    pack_rows(head.k.from(first), count, width, 1, columns, count, k);
    for (int64_t i = 0; i < kBackwardKeys * columns; ++i) dk_sums[i] = dv_sums[i] = 0;

    for (int64_t tile = 0; tile < head.queries; tile += kBackwardQueries) {
      const int64_t rows = head.queries - tile < kBackwardQueries ? head.queries - tile : kBackwardQueries;
      const float *const q = of.q + tile * columns, *const grad_out = of.grad_out + tile * columns;
      for (int64_t i = 0; i < rows; i += kProductRows) {
        for (int64_t j = 0; j < count; j += kProductColumns) {
          multiply_panel<kProductVectors, true>({q + i * columns, columns, 1}, k_panels + j * width, kProductColumns, width,
                                                p + i * kBackwardKeys + j, kBackwardKeys, nullptr);
          multiply_panel<kProductVectors, true>({grad_out + i * columns, columns, 1}, v_panels + j * width, kProductColumns, width,
                                                ds + i * kBackwardKeys + j, kBackwardKeys, nullptr);
        }
        for (int64_t r = i; r < i + kProductRows && r < rows; ++r) {
          const V mean = broadcast<float>(of.means[tile + r]), log_sum = broadcast<float>(log_sums[tile + r]);
          for (int64_t j = r * kBackwardKeys; j < r * kBackwardKeys + count; j += lanes) {
            const V weight = power_of_two(load<float>(p + j) - log_sum);
            store<float>(p + j, weight);
            store<float>(ds + j, weight * (load<float>(ds + j) - mean));
          }
        }
        multiply_rows<false>({ds + i * kBackwardKeys, kBackwardKeys, 1}, k, columns, count, dq + (tile + i) * columns, columns,
                             columns);
      }
      for (int64_t j = 0; j < count; j += kProductRows) {
        multiply_rows<false>({p + j, 1, kBackwardKeys}, grad_out, columns, rows, dv_sums + j * columns, columns, columns);
        multiply_rows<false>({ds + j, 1, kBackwardKeys}, q, columns, rows, dk_sums + j * columns, columns, columns);
      }
    }
    for (int64_t j = 0; j < count; ++j)
      for (int c = 0; c < width; ++c) {
        // Undoes the factor log₂e of the packed q.
        dk.data[(first + j) * dk.stride + c] = float(1 / kLog2E) * dk_sums[j * columns + c];
        dv.data[(first + j) * dv.stride + c] = dv_sums[j * columns + c];
      }
  }
}

}  // namespace globalsplat::raster::GS_ISA
