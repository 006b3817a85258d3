// Inputs, outputs and block sizes of attention. As in types.h, structs contain only pointers and numbers.
#pragma once

#include <cstdint>
#include <cstring>

namespace globalsplat::raster {

// Rows of a matrix, `stride` elements apart. The rows of a head are a slice of rows that contain all heads.
template <class Number>
struct Rows {
  Number* data;
  int64_t stride;

  // Returns the rows from index `first`.
  Rows from(int64_t first) const { return {data + first * stride, stride}; }
};

// Bits of a bfloat16 value, the upper half of a float's. The conversions are always inlined, so that they are compiled for the caller's
// instruction set.
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

// Queries, keys and values of one head. All rows have `width` elements.
template <class Number>
struct AttentionHead {
  Rows<const Number> q, k, v;
  int64_t queries, keys;
  int width;
};

// Functions that multiply bfloat16 matrices.
struct Bf16Gemm {
  // Computes c [m, n] = a [m, k] · b [k, n] in float32, or adds the product to c if `adds`. k is even, and pairs of b's rows are
  // interleaved: [k / 2, n, 2]. a_row, b_row and c_row are the strides between rows in elements; for b, half the stride between pairs of
  // rows.
  void (*multiply)(int64_t m, int64_t n, int64_t k, int64_t a_row, int64_t b_row, int64_t c_row, bool adds, const Bf16* a,
                   const Bf16* b, float* c);
  // Releases the calling thread's hardware state, such as AMX tiles. Each task calls it after its last product.
  void (*release)();
};

// Output of the forward pass, and the gradient with respect to it.
template <class Number>
struct AttentionOutputs {
  Rows<const Number> out, grad_out;
};

// Packed queries of a head for the backward pass: `q` has the queries times log₂e / √w, and `grad_out` the gradients of the output. Both
// are padded with zeros to [whole_product_rows(queries), attention_columns(width)]. `means` has for every query the dot product of its
// output and the gradient of that, which is the mean of g vᵀ weighted by p (attention.h).
struct PackedQueries {
  float *q, *grad_out, *means;
};

// Packed bfloat16 queries of a head for the backward pass: the queries, unscaled, and the gradients of the output, padded with zeros to
// whole_bf16_columns() rows. Both are stored in two layouts, one for each product in which they are the second matrix:
// - `q_columns` and `grad_out_columns` have panels of kBf16Columns queries, [width / 2, kBf16Columns, 2].
// - `q_rows` and `grad_out_rows` have panels of kBf16Columns elements of each row, [queries / 2, kBf16Columns, 2]. The last panel may be
//   narrower.
// `log_sums` is L of attention.h, and `means` is as in PackedQueries.
struct PackedBf16Queries {
  Bf16 *q_columns, *grad_out_columns, *q_rows, *grad_out_rows;
  float *log_sums, *means;
};

// Number of rows of a product whose sums are in registers at a time (product.h).
inline constexpr int64_t kProductRows = 6;
// Rounds up to a multiple of kProductRows.
inline constexpr int64_t whole_product_rows(int64_t rows) { return (rows + kProductRows - 1) / kProductRows * kProductRows; }

// Maximum width of a head.
inline constexpr int kAttentionWidth = 128;

// Returns the number of columns of packed rows: `width` rounded up to whole vectors of every instruction set.
inline constexpr int attention_columns(int width) { return (width + 15) / 16 * 16; }

// Maximum number of queries per task of the forward pass. Every task packs all keys and values, a cost that its queries share.
inline constexpr int64_t kAttentionQueries = 1032;

// Sizes of the blocks of keys and, in the backward pass, of queries. Packed inputs and sums of a block fit into the L2 cache.
inline constexpr int64_t kForwardKeys = 256, kBackwardKeys = 384, kBackwardQueries = 48;

// Sizes of the blocks for bfloat16.
inline constexpr int64_t kBf16Keys = 256, kBf16BackwardKeys = 128, kBf16BackwardQueries = 128;

// Number of columns of a packed bfloat16 panel. Columns are queries or elements of a row.
inline constexpr int64_t kBf16Columns = 64;
// Rounds up to a multiple of kBf16Columns.
inline constexpr int64_t whole_bf16_columns(int64_t count) { return (count + kBf16Columns - 1) / kBf16Columns * kBf16Columns; }

// Each of these functions returns the number of floats of scratch memory that a task needs.
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
