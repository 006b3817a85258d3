// What attention reads and writes: plain memory and numbers, as in types.h.
#pragma once

#include <cstdint>

namespace globalsplat::raster {

// Rows of numbers, one after the other `stride` numbers on: of a head, the part that is its own of rows that all heads share.
template <class Number>
struct Rows {
  Number* data;
  int64_t stride;

  Rows from(int64_t first) const { return {data + first * stride, stride}; }
};

// A bfloat16 number: the upper half of a float's bits.
using Bf16 = uint16_t;

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
struct AttentionPast {
  Rows<const float> out, slope;
};

// Of all queries of a head, side by side, whole_product_rows() of attention_columns() with zeros where there is nothing: themselves
// times log₂e / √w, and the gradients of what came out. And of every query the sum of this times that.
struct PackedQueries {
  float *q, *slope, *means;
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

// The same of bfloat16 numbers, where rows of a block of queries have their scores side by side, and what is packed has panels of
// columns.
inline constexpr int64_t kBf16Rows = 32, kBf16Keys = 512, kBf16Columns = 64;

// Numbers that a task works with.
inline constexpr int64_t attention_room(int width) {
  return (2 * kAttentionQueries + 2 * kForwardKeys) * attention_columns(width) + 17 * kAttentionQueries + kProductRows * kForwardKeys + 16;
}
inline constexpr int64_t attention_bf16_room(int width) {
  return kAttentionQueries * (attention_columns(width) + 2) + kBf16Keys * attention_columns(width) + 2 * kBf16Rows * kBf16Keys + 64;
}
inline constexpr int64_t attention_backward_room(int width) {
  return 5 * kBackwardKeys * attention_columns(width) + 2 * kBackwardQueries * kBackwardKeys;
}

}  // namespace globalsplat::raster
