// Attention of one head as in attention.h, of bfloat16 numbers and without a way back. Products are somebody else's, who has the
// instructions for them. Scores, the largest of them and all sums are float32; the weights 2^(s − m) are rounded before values are
// multiplied by them, as libtorch does.
#pragma once

#include "attention.h"

namespace globalsplat::raster::GS_ISA {

// The nearest, ties to even.
GS_INLINE void store_bf16(Bf16* to, Vector<float> v) {
  typedef uint32_t Bits __attribute__((vector_size(kVectorBytes)));
  typedef Bf16 Halves __attribute__((vector_size(kVectorBytes / 2)));
  const Bits bits = (Bits)v;
  const Halves rounded = __builtin_convertvector((bits + 0x7fff + ((bits >> 16) & 1)) >> 16, Halves);
  __builtin_memcpy(to, &rounded, sizeof rounded);
}

GS_INLINE Bf16 to_bf16(float number) {
  uint32_t bits;
  __builtin_memcpy(&bits, &number, 4);
  return Bf16((bits + 0x7fff + (bits >> 16 & 1)) >> 16);
}

// Copies `count` rows of `width` numbers, a multiple of 8, an even number of them apart, to panels of kBf16Columns columns, rows there: what products take for
// their second matrix, two numbers of a row side by side. Zeros fill up the last panel.
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

// Copies `count` rows of `width` numbers to panels of kBf16Columns columns, the last one of what is left of `columns`: two rows
// side by side, up to row `rows`, which is even. Zeros fill up.
GS_INLINE void pack_pairs(Rows<const Bf16> from, int64_t count, int width, int columns, int64_t rows, Bf16* out) {
  const Bf16 zeros[kBf16Columns] = {};
  for (int first = 0; first < columns; first += kBf16Columns) {
    const int panel = columns - first < kBf16Columns ? columns - first : kBf16Columns;
    const int present = width - first < panel ? width - first : panel;
    for (int64_t j = 0; j < rows; j += 2, out += 2 * panel) {
      const auto row = [&](int64_t j) { return j < count ? from.data + j * from.stride + first : zeros; };
      const Bf16 *const even = row(j), *const odd = row(j + 1);
      for (int c = 0; c < present; ++c) {
        out[2 * c] = even[c];
        out[2 * c + 1] = odd[c];
      }
      for (int c = 2 * present; c < 2 * panel; ++c) out[c] = 0;
    }
  }
}

inline void attend_bf16(const AttentionHead<Bf16>& head, const Bf16Products& products, Rows<Bf16> out, float* memory) {
  using V = Vector<float>;
  constexpr int lanes = Simd<float>::lanes;
  const int width = head.width, columns = attention_columns(width);
  const float scale = float(kLog2E / __builtin_sqrt(double(width)));

  Room room(memory);
  const auto take_bf16 = [&](int64_t count) { return reinterpret_cast<Bf16*>(room.take(count / 2)); };
  float* const sums = room.take(head.queries * columns);  // of values
  float* const weights = room.take(head.queries);         // l
  float* const most = room.take(head.queries);            // m, but for the factor
  float* const scores = room.take(kBf16Rows * kBf16Keys);
  Bf16* const rounded = take_bf16(kBf16Rows * kBf16Keys);
  Bf16* const k = take_bf16(kBf16Keys * width);
  Bf16* const v = take_bf16(kBf16Keys * columns);
  for (int64_t i = 0; i < head.queries; ++i) most[i] = -__builtin_inff(), weights[i] = 0;
  for (int64_t i = 0; i < head.queries * columns; ++i) sums[i] = 0;

  for (int64_t first = 0; first < head.keys; first += kBf16Keys) {
    const int64_t count = head.keys - first < kBf16Keys ? head.keys - first : kBf16Keys;
    const int64_t whole = (count + kBf16Columns - 1) / kBf16Columns * kBf16Columns;
    pack_transposed(head.k.from(first), count, width, k);
    pack_pairs(head.v.from(first), count, width, columns, whole, v);
    for (int64_t i = 0; i < head.queries; i += kBf16Rows) {
      const int64_t rows = head.queries - i < kBf16Rows ? head.queries - i : kBf16Rows;
      for (int64_t j = 0; j < whole; j += kBf16Columns)
        products.multiply(rows, kBf16Columns, width, head.q.stride, kBf16Columns, kBf16Keys, false, head.q.from(i).data, k + j * width,
                          scores + j);
      for (int64_t r = 0; r < rows; ++r) {
        float* const row = scores + r * kBf16Keys;
        const float before = most[i + r], now = largest_score(row, count, whole, before);
        most[i + r] = now;
        const V factor = broadcast<float>(scale), shift = broadcast<float>(-now) * factor;
        const float smaller = power_of_two(broadcast<float>((before - now) * scale))[0];
        V sum = V{};
        for (int64_t j = 0; j < whole; j += lanes) {
          const V p = power_of_two(fma(load<float>(row + j), factor, shift));
          store_bf16(rounded + r * kBf16Keys + j, p);
          sum = sum + p;
        }
        weights[i + r] = weights[i + r] * smaller + float(sum_of_lanes<float>(sum));
        if (smaller == 1) continue;
        float* const values = sums + (i + r) * columns;
        for (int c = 0; c < columns; c += lanes) store<float>(values + c, load<float>(values + c) * smaller);
      }
      for (int c = 0; c < columns; c += kBf16Columns) {
        const int panel = columns - c < kBf16Columns ? columns - c : kBf16Columns;
        products.multiply(rows, panel, whole, kBf16Keys, panel, columns, true, rounded, v + c * whole, sums + i * columns + c);
      }
    }
  }
  products.done();
  for (int64_t i = 0; i < head.queries; ++i)
    for (int c = 0; c < width; ++c) out.data[i * out.stride + c] = to_bf16(sums[i * columns + c] / weights[i]);
}

}  // namespace globalsplat::raster::GS_ISA
