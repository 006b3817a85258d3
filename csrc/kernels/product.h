// Products of small matrices: a few rows of the first with all columns of the second, with sums in registers; and the memory layouts for
// them.
#pragma once

#include "attention_types.h"
#include "simd.h"

namespace globalsplat::raster::GS_ISA {

// Allocator within a task's scratch memory.
class ScratchArena {
 public:
  explicit ScratchArena(float* from) : next_(from) {}
  float* take(int64_t count) {
    float* const taken = next_;
    next_ += (count + 15) / 16 * 16;
    return taken;
  }

 private:
  float* next_;
};

// Number of vectors of columns, for kProductRows rows, whose sums are in registers at a time: as many as fit, in addition to a row of the
// second matrix and an element of the first.
#if defined(__AVX512F__) || defined(__aarch64__)
inline constexpr int kProductVectors = 4;
#else
inline constexpr int kProductVectors = 2;
#endif
inline constexpr int kProductColumns = kProductVectors * Simd<float>::lanes;

// Memory layout of the first matrix: element (row, k) is data[row · row + k · step].
struct Factor {
  const float* data;
  int64_t row, step;
};

// Computes sums[row][column] = start(sums[row][column]) + Σₖ a(row, k) · b[k][column], k from 0 to depth − 1 in order, for kProductRows
// rows and `vectors` vectors of columns. With `fresh`, start is zero, and otherwise the previous sum, times factors[row] if there are any.
template <int vectors, bool fresh>
GS_INLINE void multiply_panel(Factor a, const float* b, int64_t b_row, int64_t depth, float* sums, int64_t sums_row,
                              const float* factors) {
  using V = Vector<float>;
  constexpr int lanes = Simd<float>::lanes;
  V sum[kProductRows][vectors];
#pragma GCC unroll 8
  for (int r = 0; r < kProductRows; ++r)
#pragma GCC unroll 4
    for (int c = 0; c < vectors; ++c) {
      if (fresh) {
        sum[r][c] = V{};
      } else {
        sum[r][c] = load<float>(sums + r * sums_row + c * lanes);
        if (factors != nullptr) sum[r][c] = sum[r][c] * broadcast<float>(factors[r]);
      }
    }
#pragma GCC unroll 1
  for (int64_t k = 0; k < depth; ++k) {
    V row[vectors];
#pragma GCC unroll 4
    for (int c = 0; c < vectors; ++c) row[c] = load<float>(b + k * b_row + c * lanes);
#pragma GCC unroll 8
    for (int r = 0; r < kProductRows; ++r) {
      const V number = broadcast<float>(a.data[r * a.row + k * a.step]);
#pragma GCC unroll 4
      for (int c = 0; c < vectors; ++c) sum[r][c] = add_product(number, row[c], sum[r][c]);
    }
  }
#pragma GCC unroll 8
  for (int r = 0; r < kProductRows; ++r)
#pragma GCC unroll 4
    for (int c = 0; c < vectors; ++c) store<float>(sums + r * sums_row + c * lanes, sum[r][c]);
}

// Computes multiply_panel() for any number of columns, a multiple of the vector length.
template <bool fresh>
GS_INLINE void multiply_rows(Factor a, const float* b, int64_t b_row, int64_t depth, float* sums, int64_t sums_row, int columns,
                             const float* factors = nullptr) {
  constexpr int lanes = Simd<float>::lanes;
  int c = 0;
  for (; c + kProductColumns <= columns; c += kProductColumns)
    multiply_panel<kProductVectors, fresh>(a, b + c, b_row, depth, sums + c, sums_row, factors);
  for (; c < columns; c += lanes) multiply_panel<1, fresh>(a, b + c, b_row, depth, sums + c, sums_row, factors);
}

// Copies `count` rows of `width` elements, times `factor`, to `rows` rows of `columns` elements. Missing elements and rows are zero.
GS_INLINE void pack_rows(Rows<const float> from, int64_t count, int width, float factor, int columns, int64_t rows, float* out) {
  constexpr int lanes = Simd<float>::lanes;
  for (int64_t i = 0; i < rows; ++i, out += columns) {
    const float* const row = from.data + i * from.stride;
    const int present = i < count ? width : 0;
    int c = 0;
    for (; c + lanes <= present; c += lanes) store<float>(out + c, load<float>(row + c) * factor);
    for (; c < columns; ++c) out[c] = c < present ? row[c] * factor : 0;
  }
}

// Transposes `count` rows of `width` elements, a multiple of 4, into panels of kProductColumns columns: element (row, k) goes to panel row
// / kProductColumns, [k][row % kProductColumns]. The last panel is padded with zeros.
GS_INLINE void pack_panels(Rows<const float> from, int64_t count, int width, float* out) {
  for (int64_t first = 0; first < count; first += kProductColumns, out += int64_t(width) * kProductColumns)
    for (int j = 0; j < kProductColumns; j += 4) {
      const int64_t left = count - first - j;
      const float* const rows = from.data + (first + j) * from.stride;
      for (int k = 0; k < width; k += 4) {
        float* const to = out + k * kProductColumns + j;
        if (left >= 4)
          transpose4(rows + k, from.stride, to, kProductColumns);
        else
          for (int i = 0; i < 16; ++i) to[i / 4 * kProductColumns + i % 4] = i % 4 < left ? rows[i % 4 * from.stride + k + i / 4] : 0;
      }
    }
}

}  // namespace globalsplat::raster::GS_ISA
