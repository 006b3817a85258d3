// Inputs and outputs of attention: plain memory and numbers, as in types.h.
#pragma once

#include <cstdint>
#include <cstring>

namespace globalsplat::raster {

// Rows at a distance of `stride` elements: for a head, its own part of rows that all heads share.
template <class Number>
struct Rows {
  Number* data;
  int64_t stride;

  Rows from(int64_t first) const { return {data + first * stride, stride}; }
};

// A bfloat16 value: the upper half of a float's bits. The conversions are inlined into their caller, whichever instruction set it is
// compiled for.
using Bf16 = uint16_t;

[[gnu::always_inline]] inline float to_float(Bf16 number) {
  const uint32_t bits = uint32_t(number) << 16;
  float exact;
  std::memcpy(&exact, &bits, sizeof exact);
  return exact;
}

// Rounds to the nearest value, ties to even.
[[gnu::always_inline]] inline Bf16 to_bf16(float number) {
  uint32_t bits;
  std::memcpy(&bits, &number, sizeof bits);
  return Bf16((bits + 0x7fff + (bits >> 16 & 1)) >> 16);
}

// Queries, keys and values of one head, all with rows of `width` elements.
template <class Number>
struct AttentionHead {
  Rows<const Number> q, k, v;
  int64_t queries, keys;
  int width;
};

// Implementation of products of bfloat16 matrices.
struct Bf16Products {
  // Computes c [m, n] = a [m, k] · b [k, n], added to c if `adds`. k is even, and pairs of b's rows are interleaved, [k / 2, n, 2]. c is
  // float32. a_row, b_row and c_row are the strides between rows in elements (for b: between pairs of rows, halved).
  void (*multiply)(int64_t m, int64_t n, int64_t k, int64_t a_row, int64_t b_row, int64_t c_row, bool adds, const Bf16* a,
                   const Bf16* b, float* c);
  // Called by a thread after its last product for now.
  void (*done)();
};

// Output of the forward pass, and its gradient.
template <class Number>
struct AttentionPast {
  Rows<const Number> out, grad_out;
};

// Packed rows of all queries of a head, whole_product_rows() of attention_columns() with zero padding: the queries times log₂e / √w, and
// the gradients of the output. `means` holds for every query the dot product of the output and its gradient.
struct PackedQueries {
  float *q, *grad_out, *means;
};

// Packed bfloat16 rows of whole_bf16_columns() queries: the queries themselves (without a factor) and the gradients of the output, each in
// both layouts in which products take their second matrix. As columns: in panels of kBf16Columns queries, [width / 2, kBf16Columns, 2]. As
// rows: in panels of kBf16Columns elements, [queries / 2, panel, 2].
struct PackedBf16Queries {
  Bf16 *q_columns, *grad_out_columns, *q_rows, *grad_out_rows;
  float *log_sums, *means;
};

// Number of rows of a product whose sums are in registers at a time (product.h).
inline constexpr int64_t kProductRows = 6;
inline constexpr int64_t whole_product_rows(int64_t rows) { return (rows + kProductRows - 1) / kProductRows * kProductRows; }

// Maximum width of a head.
inline constexpr int kAttentionWidth = 128;

// Returns the number of columns of packed rows: whole vectors on every machine.
inline constexpr int attention_columns(int width) { return (width + 15) / 16 * 16; }

// Maximum number of queries per forward task: that many share the cost of packing all keys and values.
inline constexpr int64_t kAttentionQueries = 1032;

// Block sizes of keys, and in the backward pass of queries, too, for which packed inputs and sums stay in the second-level cache.
inline constexpr int64_t kForwardKeys = 256, kBackwardKeys = 384, kBackwardQueries = 48;

// Block sizes for bfloat16, and the number of columns of a packed panel, which are queries or elements of a row.
inline constexpr int64_t kBf16Keys = 256, kBf16Columns = 64;
inline constexpr int64_t kBf16BackwardKeys = 128, kBf16BackwardQueries = 128;
inline constexpr int64_t whole_bf16_columns(int64_t count) { return (count + kBf16Columns - 1) / kBf16Columns * kBf16Columns; }

// Return the number of elements of scratch memory that a task needs.
inline constexpr int64_t attention_scratch_size(int width) {
  return (2 * kAttentionQueries + 2 * kForwardKeys) * attention_columns(width) + 17 * kAttentionQueries + kProductRows * kForwardKeys + 16;
}
inline constexpr int64_t attention_bf16_scratch_size(int width) {
  return kAttentionQueries * (3 * width / 2 + 2) + kBf16Keys * (3 * kBf16Columns + width) / 2 + 128;
}
inline constexpr int64_t attention_backward_scratch_size(int width) {
  return 5 * kBackwardKeys * attention_columns(width) + 2 * kBackwardQueries * kBackwardKeys;
}
inline constexpr int64_t attention_bf16_backward_scratch_size(int width) {
  return kBf16BackwardKeys * (5 * attention_columns(width) / 2 + 2 * kBf16Columns + 3 * kBf16BackwardQueries / 2) + 64;
}

}  // namespace globalsplat::raster
