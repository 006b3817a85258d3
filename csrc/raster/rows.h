// What attention reads and writes: plain memory and numbers, as in types.h.
#pragma once

#include <cstdint>
#include <cstring>

namespace globalsplat::raster {

// Rows of numbers, one after the other `stride` numbers on: of a head, the part that is its own of rows that all heads share.
template <class Number>
struct Rows {
  Number* data;
  int64_t stride;

  Rows from(int64_t first) const { return {data + first * stride, stride}; }
};

// A bfloat16 number: the upper half of a float's bits. What makes one of the other is compiled into its caller, whichever instruction
// set that is for.
using Bf16 = uint16_t;

[[gnu::always_inline]] inline float to_float(Bf16 number) {
  const uint32_t bits = uint32_t(number) << 16;
  float exact;
  std::memcpy(&exact, &bits, sizeof exact);
  return exact;
}

// The nearest, ties to even.
[[gnu::always_inline]] inline Bf16 to_bf16(float number) {
  uint32_t bits;
  std::memcpy(&bits, &number, sizeof bits);
  return Bf16((bits + 0x7fff + (bits >> 16 & 1)) >> 16);
}

// One head's queries, keys and values, all `width` numbers wide.
template <class Number>
struct AttentionHead {
  Rows<const Number> q, k, v;
  int64_t queries, keys;
  int width;
};

// Who multiplies matrices of bfloat16 numbers.
struct Bf16Products {
  // c [m, n] = a [m, k] · b [k, n], added to what is there where it `adds`; of b two rows lie side by side, [k / 2, n, 2], and k is
  // even. c is float32. Numbers from one row to the next (of b to the next but one, halved): a_row, b_row, c_row.
  void (*multiply)(int64_t m, int64_t n, int64_t k, int64_t a_row, int64_t b_row, int64_t c_row, bool adds, const Bf16* a,
                   const Bf16* b, float* c);
  // What a thread says when it was its last product for now.
  void (*done)();
};

// What came out, and the gradient of that.
template <class Number>
struct AttentionPast {
  Rows<const Number> out, slope;
};

// Of all queries of a head, side by side, whole_product_rows() of attention_columns() with zeros where there is nothing: themselves
// times log₂e / √w, and the gradients of what came out. And of every query the sum of this times that.
struct PackedQueries {
  float *q, *slope, *means;
};

// The same of bfloat16 numbers, whole_bf16_columns() of queries: themselves (not multiplied by anything) and the gradients, each in
// both of the ways that products take their second matrix. As columns: in panels of kBf16Columns queries, [width / 2, kBf16Columns, 2]. As
// rows: in panels of kBf16Columns numbers, [queries / 2, panel, 2].
struct PackedBf16Queries {
  Bf16 *q_columns, *slope_columns, *q_rows, *slope_rows;
  float *log_sums, *means;
};

// Rows of a product whose sums are in registers at a time (product.h).
inline constexpr int64_t kProductRows = 6;
inline constexpr int64_t whole_product_rows(int64_t rows) { return (rows + kProductRows - 1) / kProductRows * kProductRows; }

// The widest head.
inline constexpr int kAttentionWidth = 128;

// Columns of what is packed: whole vectors on every machine.
inline constexpr int attention_columns(int width) { return (width + 15) / 16 * 16; }

// Queries that are one task forward, at most: so many share the work of packing all keys and values.
inline constexpr int64_t kAttentionQueries = 1032;

// Of a block of keys, and backward of queries, too: what is packed of them, and summed up for them, stays in the second cache.
inline constexpr int64_t kForwardKeys = 256, kBackwardKeys = 384, kBackwardQueries = 48;

// The same of bfloat16 numbers, and the columns of a panel of what is packed, be they queries or numbers of a row.
inline constexpr int64_t kBf16Keys = 256, kBf16Columns = 64;
inline constexpr int64_t kBf16BackwardKeys = 128, kBf16BackwardQueries = 128;
inline constexpr int64_t whole_bf16_columns(int64_t count) { return (count + kBf16Columns - 1) / kBf16Columns * kBf16Columns; }

// Numbers that a task works with.
inline constexpr int64_t attention_room(int width) {
  return (2 * kAttentionQueries + 2 * kForwardKeys) * attention_columns(width) + 17 * kAttentionQueries + kProductRows * kForwardKeys + 16;
}
inline constexpr int64_t attention_bf16_room(int width) {
  return kAttentionQueries * (3 * width / 2 + 2) + kBf16Keys * (3 * kBf16Columns + width) / 2 + 128;
}
inline constexpr int64_t attention_backward_room(int width) {
  return 5 * kBackwardKeys * attention_columns(width) + 2 * kBackwardQueries * kBackwardKeys;
}
inline constexpr int64_t attention_bf16_backward_room(int width) {
  return kBf16BackwardKeys * (5 * attention_columns(width) / 2 + 2 * kBf16Columns + 3 * kBf16BackwardQueries / 2) + 64;
}

}  // namespace globalsplat::raster
