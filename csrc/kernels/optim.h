// Optimizer steps with the vectors of one instruction set (spec 8.5).
#pragma once

#include "product.h"
#include "types.h"

namespace globalsplat::raster::GS_ISA {

// One step of Adam (Kingma & Ba 2015) in one pass over memory, with decoupled weight decay (Loshchilov & Hutter 2019):
//
//   m ← m + (1 − β₁)(g − m),  v ← β₂ v + (1 − β₂) g²,  x ← (1 − decay) x − step_size · m / (√v / bias_correction2_sqrt + ε)
//
// where step_size is the learning rate over 1 − β₁ᵗ, bias_correction2_sqrt is √(1 − β₂ᵗ), and decay is the weight decay times the learning
// rate.
template <class T>
void adam(const AdamStep& step, const AdamState<T>& of, int64_t begin, int64_t end) {
  const T keep = T(1 - step.decay), step_size = T(step.step_size), fresh1 = T(1 - step.beta1), beta2 = T(step.beta2);
  const T fresh2 = T(1 - step.beta2), inverse_root = T(1 / step.bias_correction2_sqrt), epsilon = T(step.epsilon);
  T *const value = of.value, *const first = of.first, *const second = of.second;
  const T* const gradient = of.gradient;
#pragma GCC ivdep
  for (int64_t i = begin; i < end; ++i) {
    const T g = gradient[i];
    const T m = first[i] + fresh1 * (g - first[i]), v = beta2 * second[i] + fresh2 * g * g;
    first[i] = m;
    second[i] = v;
    value[i] = keep * value[i] - step_size * m / (T(__builtin_sqrt(v)) * inverse_root + epsilon);
  }
}

// One step of Muon (Jordan et al. 2024) on a matrix θ of R × C elements. It goes along the approximate nearest matrix with equal singular
// values, found by five rounds of the Newton–Schulz iteration, which needs only products:
//
//   m ← m + (1 − β)(g − m),  u = g + β(m − g),  X = u / (‖u‖ + 1e-7)
//   five times  X ← a X + (b S + c S²) X,  S = X Xᵀ
//   θ ← (1 − decay) θ − rate · 0.2 · √max(R, C) · X
//
// The elements of the step are as large as those of AdamW's steps (Liu et al. 2025); decay is the weight decay times the learning rate
// For a matrix with more rows than columns, X is transposed.
inline constexpr int kMuonRounds = 5;
inline constexpr float kMuonA = 3.4445f, kMuonB = -4.7750f, kMuonC = 2.0315f;

// Computes a symmetric matrix of `size` rows. make(i, first) computes kProductRows rows from row i on of the panel of columns that begins
// at `first`, and is called only down to the diagonal. The part below is mirrored.
template <class Make>
GS_INLINE void make_symmetric(int64_t size, float* matrix, int64_t stride, const Make& make) {
  for (int64_t first = 0; first < size; first += kProductColumns)
    for (int64_t i = 0; i < size && i < first + kProductColumns; i += kProductRows) make(i, first);
  for (int64_t i = 1; i < size; ++i)
    for (int64_t j = 0; j < i; ++j) matrix[i * stride + j] = matrix[j * stride + i];
}

inline void muon(const MuonStep& step, const MuonMatrix& of, float* memory) {
  using V = Vector<float>;
  constexpr int lanes = Simd<float>::lanes;
  const bool upright = of.rows > of.columns;
  const int64_t few = upright ? of.columns : of.rows, many = upright ? of.rows : of.columns;
  // Padded with zeros, which remain zero.
  const int64_t rows = whole_product_rows(few), row = muon_stride(many), square_row = muon_stride(few);
  const int wide = int((many + lanes - 1) / lanes * lanes);
  const int64_t panel_columns = (few + kProductColumns - 1) / kProductColumns * kProductColumns;
  const auto place = [&](int64_t i, int64_t j) { return upright ? j * row + i : i * row + j; };

  ScratchArena scratch(memory);
  float* x = scratch.take(rows * row);
  float* next = scratch.take(rows * row);
  float* const panels = scratch.take(square_row * wide);
  float* const square = scratch.take(rows * square_row);  // S
  float* const factor = scratch.take(rows * square_row);  // c S
  float* const sum = scratch.take(rows * square_row);     // b S + c S²

  for (int64_t k = 0; k < rows * row; ++k) x[k] = 0;
  // Only the last panel is computed down to the padding rows.
  for (int64_t k = few * square_row; k < rows * square_row; ++k) square[k] = 0;
  const float beta = float(step.beta), fresh = float(1 - step.beta);
  for (int64_t i = 0; i < of.rows; ++i)
    for (int64_t j = 0; j < of.columns; ++j) {
      const int64_t k = i * of.columns + j;
      const float g = of.gradient[k], m = of.first[k] + fresh * (g - of.first[k]);
      of.first[k] = m;
      x[place(i, j)] = g + beta * (m - g);
    }
  double squares = 0;
  for (int64_t i = 0; i < few; ++i) {
    V of_row{};
    for (int j = 0; j < wide; j += lanes) {
      const V numbers = load<float>(x + i * row + j);
      of_row = add_product(numbers, numbers, of_row);
    }
    squares += sum_of_lanes<float>(of_row);
  }
  const float scale = float(1 / (__builtin_sqrt(squares) + 1e-7));
  for (int64_t k = 0; k < few * row; ++k) x[k] *= scale;

  for (int round = 0; round < kMuonRounds; ++round) {
    pack_panels({x, row}, few, wide, panels);
    make_symmetric(few, square, square_row, [&](int64_t i, int64_t first) {
      multiply_panel<kProductVectors, true>({x + i * row, row, 1}, panels + first * wide, kProductColumns, many,
                                            square + i * square_row + first, square_row, nullptr);
    });
    for (int64_t i = 0; i < rows; ++i)
      for (int64_t k = i * square_row; k < i * square_row + panel_columns; ++k) {
        factor[k] = kMuonC * square[k];
        sum[k] = kMuonB * square[k];
      }
    make_symmetric(few, sum, square_row, [&](int64_t i, int64_t first) {
      multiply_panel<kProductVectors, false>({factor + i * square_row, square_row, 1}, square + first, square_row, few,
                                             sum + i * square_row + first, square_row, nullptr);
    });
    for (int64_t k = 0; k < rows * row; ++k) next[k] = kMuonA * x[k];
    for (int64_t i = 0; i < rows; i += kProductRows)
      multiply_rows<false>({sum + i * square_row, square_row, 1}, x, row, few, next + i * row, row, wide);
    float* const done = x;
    x = next;
    next = done;
  }

  const float keep = float(1 - step.decay), rate = float(step.rate * 0.2 * __builtin_sqrt(double(many)));
  for (int64_t i = 0; i < of.rows; ++i)
    for (int64_t j = 0; j < of.columns; ++j) {
      float& value = of.value[i * of.columns + j];
      value = keep * value - rate * x[place(i, j)];
    }
}

}  // namespace globalsplat::raster::GS_ISA
