// Attention of one head for bfloat16 inputs, forward and backward; attention.h has the equations. The caller provides the matrix products,
// so that they can use instructions outside of this file's instruction set. Scores, their maxima and all sums are float32. As in libtorch,
// the weights p and the gradients ds of the scores are rounded to bfloat16 before they are multiplied.
#pragma once

#include "attention.h"

namespace globalsplat::raster::GS_ISA {

// Rounds to the nearest bfloat16 values, ties to even. They are in the upper halves of the result; the lower halves are unspecified.
GS_INLINE Bits rounded(Vector<float> v) {
  const Bits bits = (Bits)v;
  return bits + 0x7fff + ((bits >> 16) & 1);
}

// Stores the upper halves.
GS_INLINE void store_bf16(Bf16* to, Bits rounded) {
  typedef Bf16 Halves __attribute__((vector_size(kVectorBytes / 2)));
  const Halves halves = __builtin_convertvector(rounded >> 16, Halves);
  __builtin_memcpy(to, &halves, sizeof halves);
}

// Stores the upper halves of two rows, interleaved.
GS_INLINE void store_pair(Bf16* to, Bits even, Bits odd) {
  const Bits both = (even >> 16) | (odd & 0xffff0000);
  __builtin_memcpy(to, &both, sizeof both);
}

// Transposes `count` rows of `width` elements into the layout of a product's second matrix: panels [width / 2, kBf16Columns, 2], in which
// each row is a column and pairs of its elements are adjacent. `width` is a multiple of 8, and the stride of the rows is even. The last
// panel is padded with zeros.
GS_INLINE void pack_transposed(Rows<const Bf16> from, int64_t count, int width, Bf16* out) {
  for (int64_t first = 0; first < count; first += kBf16Columns, out += int64_t(width) * kBf16Columns)
    for (int64_t j = 0; j < kBf16Columns; j += 4) {
      const Bf16* const rows = from.data + (first + j) * from.stride;
      for (int k = 0; k < width; k += 8) {
        Bf16* const to = out + k * kBf16Columns + 2 * j;
        if (first + j + 4 <= count) {
          transpose4(rows + k, from.stride / 2, to, kBf16Columns);
          continue;
        }
        for (int i = 0; i < 16; ++i) {
          Bf16* const pair = to + i % 4 * 2 * kBf16Columns + i / 4 * 2;
          if (first + j + i / 4 < count)
            __builtin_memcpy(pair, rows + i / 4 * from.stride + k + i % 4 * 2, 4);
          else
            pair[0] = pair[1] = 0;
        }
      }
    }
}

// Transposes `count` rows of `width` elements: element (row, c) goes to out[c · stride + row]. Pads with zero rows up to `whole`. `width`
// and `whole` are multiples of 8.
GS_INLINE void pack_columns(Rows<const Bf16> from, int64_t count, int width, int64_t whole, int64_t stride, Bf16* out) {
  const Bf16 zeros[kAttentionWidth] = {};
  for (int64_t j = 0; j < whole; j += 8)
    for (int c = 0; c < width; c += 8) {
      // Four pairs of rows, interleaved. Transposing them as 32-bit words makes eight elements of a column contiguous.
      Bf16 pairs[4][16];
      for (int n = 0; n < 4; ++n) {
        const auto row = [&](int64_t j) { return (j < count ? from.data + j * from.stride : zeros) + c; };
        const Bf16 *const even = row(j + 2 * n), *const odd = row(j + 2 * n + 1);
        for (int i = 0; i < 8; ++i) {
          pairs[n][2 * i] = even[i];
          pairs[n][2 * i + 1] = odd[i];
        }
      }
      for (int half = 0; half < 8; half += 4) transpose4(pairs[0] + 2 * half, 8, out + (c + half) * stride + j, stride / 2);
    }
}

// Copies `count` rows of `width` elements to kBf16Columns rows of `columns` elements, with pairs of rows interleaved. Pads with zeros and
// drops elements beyond `columns`.
GS_INLINE void pack_pairs(Rows<const Bf16> from, int64_t count, int width, int columns, Bf16* out) {
  const Bf16 zeros[kBf16Columns] = {};
  const int present = width < columns ? width : columns;
  for (int64_t j = 0; j < kBf16Columns; j += 2, out += 2 * columns) {
    const auto row = [&](int64_t j) { return j < count ? from.data + j * from.stride : zeros; };
    const Bf16 *const even = row(j), *const odd = row(j + 1);
    for (int c = 0; c < present; ++c) {
      out[2 * c] = even[c];
      out[2 * c + 1] = odd[c];
    }
    for (int c = 2 * present; c < 2 * columns; ++c) out[c] = 0;
  }
}

// Computes the forward pass of a head. Scores are stored transposed, k qᵀ, here and in the backward pass. So a vector holds the scores of
// adjacent queries, and pᵀ is ready to be the second matrix of the product outᵀ = vᵀ pᵀ.
inline void attention_forward_bf16(const AttentionHead<Bf16>& head, const Bf16Gemm& gemm, Rows<Bf16> out, float* log_sums,
                                   float* memory) {
  using V = Vector<float>;
  constexpr int lanes = Simd<float>::lanes, vectors = kBf16Columns / lanes;
  const int width = head.width;
  const int64_t queries = whole_bf16_columns(head.queries);
  const float scale = float(kLog2E / __builtin_sqrt(double(width)));
  const V factor = broadcast<float>(scale);

  ScratchArena scratch(memory);
  const auto take_bf16 = [&](int64_t count) { return reinterpret_cast<Bf16*>(scratch.take(count / 2)); };
  float* const sums = scratch.take(queries * width);  // outᵀ before division by l, in panels of queries, [width, kBf16Columns]
  float* const weights = scratch.take(queries);       // l
  float* const maxima = scratch.take(queries);        // m without the factor log₂e / √w
  float* const scores = scratch.take(kBf16Keys * kBf16Columns);
  Bf16* const p = take_bf16(kBf16Keys * kBf16Columns);
  Bf16* const v = take_bf16(kBf16Keys * width);
  Bf16* const q = take_bf16(queries * width);
  pack_transposed(head.q, head.queries, width, q);
  for (int64_t i = 0; i < queries; ++i) maxima[i] = -__builtin_inff(), weights[i] = 0;

  for (int64_t first = 0; first < head.keys; first += kBf16Keys) {
    const int64_t count = head.keys - first < kBf16Keys ? head.keys - first : kBf16Keys;
    const int64_t whole = whole_bf16_columns(count);
    const Rows<const Bf16> k = head.k.from(first);
    pack_columns(head.v.from(first), count, width, whole, kBf16Keys, v);
    for (int64_t panel = 0; panel < queries; panel += kBf16Columns) {
      float* const values = sums + panel * width;
      gemm.multiply(count, kBf16Columns, width, k.stride, kBf16Columns, kBf16Columns, false, k.data, q + panel * width, scores);
      V new_max[vectors], shift[vectors], sum[vectors];
      for (int n = 0; n < vectors; ++n) new_max[n] = load<float>(maxima + panel + n * lanes);
      for (int64_t j = 0; j < count; ++j)
#pragma GCC unroll 8
        for (int n = 0; n < vectors; ++n) new_max[n] = larger(load<float>(scores + j * kBf16Columns + n * lanes), new_max[n]);
      for (int n = 0; n < vectors; ++n) shift[n] = -new_max[n] * factor, sum[n] = V{};
      for (int64_t j = 0; j < whole; j += 2)
#pragma GCC unroll 8
        for (int n = 0; n < vectors; ++n) {
          const auto round = [&](int64_t j) {
            if (j >= count) return Bits{};
            const V weight = power_of_two(add_product(load<float>(scores + j * kBf16Columns + n * lanes), factor, shift[n]));
            sum[n] = sum[n] + weight;
            return rounded(weight);
          };
          const Bits even = round(j);
          store_pair(p + j * kBf16Columns + 2 * n * lanes, even, round(j + 1));
        }
      for (int n = 0; n < vectors; ++n) {
        float *const maximum = maxima + panel + n * lanes, *const weight = weights + panel + n * lanes;
        const V rescale = power_of_two((load<float>(maximum) - new_max[n]) * factor);
        store<float>(maximum, new_max[n]);
        store<float>(weight, add_product(load<float>(weight), rescale, sum[n]));
        for (int64_t at = n * lanes; first > 0 && at < width * kBf16Columns; at += kBf16Columns)
          store<float>(values + at, load<float>(values + at) * rescale);
      }
      gemm.multiply(width, kBf16Columns, whole, kBf16Keys, kBf16Columns, kBf16Columns, first > 0, v, p, values);
    }
  }
  gemm.release();
  for (int64_t i = 0; i < head.queries; ++i) {
    const float* const values = sums + i / kBf16Columns * kBf16Columns * width + i % kBf16Columns;
    log_sums[i] = maxima[i] * scale + float(__builtin_log2(double(weights[i])));
    for (int c = 0; c < width; ++c) out.data[i * out.stride + c] = to_bf16(values[c * kBf16Columns] / weights[i]);
  }
}

// Packs one panel of a head's queries for attention_backward_bf16(), with the output of the forward pass and its gradient. The panel begins
// at query `first`. `whole` is the number of queries rounded up to whole panels.
inline void pack_queries_bf16(const AttentionHead<Bf16>& head, const AttentionOutputs<Bf16>& outputs, const float* log_sums, int64_t first,
                              int64_t whole, const PackedBf16Queries& to) {
  const int width = head.width, columns = attention_columns(width);
  const int64_t count = head.queries - first < kBf16Columns ? head.queries - first : kBf16Columns;
  const auto pack = [&](Rows<const Bf16> from, Bf16* as_columns, Bf16* as_rows) {
    pack_transposed(from, count, width, as_columns + first * width);
    for (int c = 0; c < columns; c += kBf16Columns) {
      const int panel = columns - c < kBf16Columns ? columns - c : kBf16Columns;
      pack_pairs({from.data + c, from.stride}, count, width - c, panel, as_rows + c * whole + first * panel);
    }
  };
  const Rows<const Bf16> grad_out = outputs.grad_out.from(first), out = outputs.out.from(first);
  pack(head.q.from(first), to.q_columns, to.q_rows);
  pack(grad_out, to.grad_out_columns, to.grad_out_rows);
  for (int64_t i = 0; i < kBf16Columns; ++i) {
    double sum = 0;
    for (int c = 0; i < count && c < width; ++c)
      sum += double(to_float(out.data[i * out.stride + c])) * double(to_float(grad_out.data[i * grad_out.stride + c]));
    to.means[first + i] = float(sum);
    to.log_sums[first + i] = i < count ? log_sums[first + i] : 0;
  }
}

// Computes the backward pass for the keys and values in `head`, which may be only some of those of the forward pass. Writes their gradients
// to `dk` and `dv`. Writes their contribution to the gradient of q, times √w, to `dq`, in panels of kBf16Columns queries, [width,
// kBf16Columns]: dqᵀ = kᵀ dsᵀ.
inline void attention_backward_bf16(const AttentionHead<Bf16>& head, const Bf16Gemm& gemm, const PackedBf16Queries& packed, float* dq,
                                    Rows<Bf16> dk, Rows<Bf16> dv, float* memory) {
  using V = Vector<float>;
  constexpr int lanes = Simd<float>::lanes;
  const int width = head.width, columns = attention_columns(width);
  const int64_t queries = whole_bf16_columns(head.queries);
  const float scale = float(1 / __builtin_sqrt(double(width)));
  const V factor = broadcast<float>(float(kLog2E / __builtin_sqrt(double(width))));

  ScratchArena scratch(memory);
  const auto take_bf16 = [&](int64_t count) { return reinterpret_cast<Bf16*>(scratch.take(count / 2)); };
  float* const dk_sums = scratch.take(kBf16BackwardKeys * columns);
  float* const dv_sums = scratch.take(kBf16BackwardKeys * columns);
  float* const scores = scratch.take(kBf16BackwardKeys * kBf16Columns);
  float* const dp = scratch.take(kBf16BackwardKeys * kBf16Columns);
  Bf16* const k_columns = take_bf16(kBf16BackwardKeys * width);
  Bf16* const p = take_bf16(kBf16BackwardKeys * kBf16BackwardQueries);
  Bf16* const ds = take_bf16(kBf16BackwardKeys * kBf16BackwardQueries);
  Bf16* const ds_pairs = take_bf16(kBf16BackwardKeys * kBf16BackwardQueries);

  for (int64_t first = 0; first < head.keys; first += kBf16BackwardKeys) {
    const int64_t count = head.keys - first < kBf16BackwardKeys ? head.keys - first : kBf16BackwardKeys;
    const int64_t whole = whole_bf16_columns(count);
    const Rows<const Bf16> k = head.k.from(first), v = head.v.from(first);
    pack_columns(k, count, width, whole, kBf16BackwardKeys, k_columns);

    for (int64_t tile = 0; tile < queries; tile += kBf16BackwardQueries) {
      const int64_t depth = queries - tile < kBf16BackwardQueries ? queries - tile : kBf16BackwardQueries;
      for (int64_t i = 0; i < depth; i += kBf16Columns) {
        const int64_t query = tile + i;
        const auto multiply = [&](Rows<const Bf16> keys, const Bf16* queries, float* to) {
          gemm.multiply(count, kBf16Columns, width, keys.stride, kBf16Columns, kBf16Columns, false, keys.data,
                        queries + query * width, to);
        };
        multiply(k, packed.q_columns, scores);
        multiply(v, packed.grad_out_columns, dp);
        Bf16* const pairs = ds_pairs + i * kBf16BackwardKeys;
        for (int64_t j = 0; j < whole; j += 2)
          for (int64_t c = 0; c < kBf16Columns; c += lanes) {
            const V shift = load<float>(packed.log_sums + query + c), mean = load<float>(packed.means + query + c);
            const auto round = [&](int64_t j) {
              if (j >= count) return Bits{};
              const int64_t at = j * kBf16Columns + c, to = j * kBf16BackwardQueries + i + c;
              const V weight = power_of_two(add_product(load<float>(scores + at), factor, -shift));
              const Bits ds_bits = rounded(weight * (load<float>(dp + at) - mean));
              store_bf16(p + to, rounded(weight));
              store_bf16(ds + to, ds_bits);
              return ds_bits;
            };
            const Bits even = round(j);
            store_pair(pairs + j * kBf16Columns + 2 * c, even, round(j + 1));
          }
        gemm.multiply(width, kBf16Columns, whole, kBf16BackwardKeys, kBf16Columns, kBf16Columns, first > 0, k_columns, pairs,
                      dq + query * width);
      }
      for (int c = 0; c < columns; c += kBf16Columns) {
        const int panel = columns - c < kBf16Columns ? columns - c : kBf16Columns;
        const auto multiply = [&](const Bf16* keys, const Bf16* rows, float* sums) {
          gemm.multiply(count, panel, depth, kBf16BackwardQueries, panel, columns, tile > 0, keys, rows + c * queries + tile * panel,
                        sums + c);
        };
        multiply(p, packed.grad_out_rows, dv_sums);
        multiply(ds, packed.q_rows, dk_sums);
      }
    }
    for (int64_t j = 0; j < count; ++j)
      for (int c = 0; c < width; ++c) {
        dk.data[(first + j) * dk.stride + c] = to_bf16(scale * dk_sums[j * columns + c]);
        dv.data[(first + j) * dv.stride + c] = to_bf16(dv_sums[j * columns + c]);
      }
  }
  gemm.release();
}

}  // namespace globalsplat::raster::GS_ISA
