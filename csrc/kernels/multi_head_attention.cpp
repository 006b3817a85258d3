#include "multi_head_attention.h"

#include <algorithm>
#include <cmath>
#include <memory>
#include <type_traits>

#include "kernels.h"
#include "parallel.h"

namespace globalsplat::raster {
namespace {

constexpr int64_t kFewestQueries = 96;  // minimum number that makes packing the keys worthwhile
constexpr int64_t kPiece = 66;  // rows per task in a single pass over rows

int64_t round_up(int64_t number, int64_t step) { return (number + step - 1) / step * step; }

// Returns the number of each head's `count` rows per task, so that there are about `tasks` tasks: at least `fewest`, in whole `step`s.
int64_t rows_per_task(int64_t heads, int64_t count, int64_t tasks, int64_t fewest, int64_t step) {
  return round_up(std::max(fewest, (count * heads + tasks - 1) / tasks), step);
}

template <class Number>
Rows<Number> head_of(const Heads<Number>& all, const AttentionShape& shape, int64_t head) {
  return {all.data + head / shape.heads * all.scene + head % shape.heads * shape.width, all.row};
}

// Calls task(some of a head's queries with all of its keys and values, head, index of the first of these queries) on up to `num_threads`
// threads. Numbers of queries are multiples of `step`.
template <class Number, class Task>
void for_query_blocks(const AttentionShape& shape, const AttentionInputs<Number>& in, int64_t step, int num_threads, const Task& task) {
  const int64_t heads = shape.scenes * shape.heads;
  // A query's bits don't depend on the other queries of its task, so the task size may depend on the number of threads.
  const int64_t wanted = rows_per_task(heads, shape.queries, 8 * num_threads, kFewestQueries, step);
  const int64_t most = std::min(wanted, kAttentionQueries / step * step);
  const int64_t blocks = (shape.queries + most - 1) / most;
  const int64_t size = round_up((shape.queries + blocks - 1) / std::max<int64_t>(blocks, 1), step);
  parallel_for(num_threads, heads * blocks, [&](int64_t i) {
    const int64_t head = i / blocks, begin = std::min(i % blocks * size, shape.queries);
    task(AttentionHead<Number>{head_of(in.q, shape, head).from(begin), head_of(in.k, shape, head), head_of(in.v, shape, head),
                               std::min(size, shape.queries - begin), shape.keys, shape.width},
         head, begin);
  });
}

}  // namespace

template <class Number>
void multi_head_attention(const AttentionShape& shape, const AttentionInputs<Number>& in, Heads<Number> out, float* log_sums,
                          const Bf16Gemm& gemm, int num_threads) {
  constexpr bool is_bf16 = std::is_same_v<Number, Bf16>;
  const int64_t step = is_bf16 ? kBf16Columns : kProductRows;
  for_query_blocks(shape, in, step, num_threads, [&](const AttentionHead<Number>& of, int64_t head, int64_t begin) {
    const Rows<Number> to = head_of(out, shape, head).from(begin);
    float* const to_sums = log_sums + head * shape.queries + begin;
    if constexpr (is_bf16)
      kernels().attention_forward_bf16(of, gemm, to, to_sums, scratch(attention_bf16_scratch_size(shape.width)));
    else
      kernels().attention_forward(of, to, to_sums, scratch(attention_scratch_size(shape.width)));
  });
}

template void multi_head_attention(const AttentionShape&, const AttentionInputs<float>&, Heads<float>, float*, const Bf16Gemm&, int);
template void multi_head_attention(const AttentionShape&, const AttentionInputs<Bf16>&, Heads<Bf16>, float*, const Bf16Gemm&, int);

template <class Number>
void multi_head_attention_backward(const AttentionShape& shape, const AttentionInputs<Number>& in, Heads<const Number> out,
                                   const float* log_sums, Heads<const Number> grad_out, const AttentionGradients<Number>& gradients,
                                   const Bf16Gemm& gemm, int num_threads) {
  constexpr bool is_bf16 = std::is_same_v<Number, Bf16>;
  constexpr int64_t fewest = is_bf16 ? kBf16BackwardKeys : kBackwardKeys, piece = is_bf16 ? kBf16Columns : kPiece;
  const int64_t heads = shape.scenes * shape.heads, width = shape.width, columns = attention_columns(shape.width);
  // Every task processes a part of a head's keys, split by shapes alone, and computes a gradient for all of its queries; these are summed
  // in order.
  const int64_t size = rows_per_task(heads, shape.keys, 64, fewest, fewest), parts = (shape.keys + size - 1) / size;
  const int64_t whole = is_bf16 ? whole_bf16_columns(shape.queries) : whole_product_rows(shape.queries);
  const int64_t row_size = is_bf16 ? width : columns, all = whole * row_size, rows_all = is_bf16 ? whole * columns : 0;
  const auto numbers = [&](int64_t each) { return std::unique_ptr<Number[]>(new Number[size_t(heads * each)]); };
  const auto floats = [&](int64_t each) { return std::unique_ptr<float[]>(new float[size_t(heads * each)]); };
  const auto q = numbers(all), grads_out = numbers(all), q_rows = numbers(rows_all), grad_out_rows = numbers(rows_all);
  const auto means = floats(whole), shifts = floats(is_bf16 ? whole : 0), sums = floats(parts * all);
  const auto packed = [&](int64_t head, [[maybe_unused]] int64_t begin) {
    if constexpr (is_bf16)
      return PackedBf16Queries{q.get() + head * all,           grads_out.get() + head * all,  q_rows.get() + head * rows_all,
                               grad_out_rows.get() + head * rows_all, shifts.get() + head * whole, means.get() + head * whole};
    else
      return PackedQueries{q.get() + head * all + begin * columns, grads_out.get() + head * all + begin * columns,
                           means.get() + head * whole + begin};
  };
  const auto rows = [&](const auto& of, int64_t head, int64_t begin) { return head_of(of, shape, head).from(begin); };

  const int64_t pieces = (shape.queries + piece - 1) / piece;
  parallel_for(num_threads, heads * pieces, [&](int64_t task) {
    const int64_t head = task / pieces, begin = task % pieces * piece, first = is_bf16 ? 0 : begin;
    const int64_t count = is_bf16 ? shape.queries : std::min(piece, shape.queries - begin);
    const AttentionHead<Number> queries{rows(in.q, head, first), {}, {}, count, 0, shape.width};
    const AttentionOutputs<Number> outputs{rows(out, head, first), rows(grad_out, head, first)};
    if constexpr (is_bf16)
      kernels().pack_queries_bf16(queries, outputs, log_sums + head * shape.queries, begin, whole, packed(head, 0));
    else
      kernels().pack_queries(queries, outputs, packed(head, begin));
  });
  parallel_for(num_threads, heads * parts, [&](int64_t task) {
    const int64_t head = task / parts, begin = task % parts * size, count = std::min(size, shape.keys - begin);
    const AttentionHead<Number> keys{{}, rows(in.k, head, begin), rows(in.v, head, begin), shape.queries, count, shape.width};
    const Rows<Number> dk = rows(gradients.k, head, begin), dv = rows(gradients.v, head, begin);
    float* const dq = sums.get() + task * all;
    if constexpr (is_bf16)
      kernels().attention_backward_bf16(keys, gemm, packed(head, 0), dq, dk, dv, scratch(attention_bf16_backward_scratch_size(shape.width)));
    else
      kernels().attention_backward(keys, packed(head, 0), log_sums + head * shape.queries, dq, dk, dv,
                                   scratch(attention_backward_scratch_size(shape.width)));
  });
  const float scale = float(1 / std::sqrt(double(width)));
  // Distances between the sums of adjacent queries and elements: for bfloat16 they are in panels, [width, kBf16Columns].
  const int64_t query_step = is_bf16 ? 1 : columns, element_step = is_bf16 ? kBf16Columns : 1;
  parallel_for(num_threads, heads * pieces, [&](int64_t task) {
    const int64_t head = task / pieces, begin = task % pieces * piece;
    const Rows<Number> to = rows(gradients.q, head, begin);
    for (int64_t i = 0; i < std::min(piece, shape.queries - begin); ++i) {
      const float* const first = sums.get() + head * parts * all + begin * row_size + i * query_step;
      for (int64_t c = 0; c < width; ++c) {
        float sum = 0;
        for (int64_t n = 0; n < parts; ++n) sum += first[n * all + c * element_step];
        if constexpr (is_bf16)
          to.data[i * to.stride + c] = to_bf16(scale * sum);
        else
          to.data[i * to.stride + c] = scale * sum;
      }
    }
  });
}

template void multi_head_attention_backward(const AttentionShape&, const AttentionInputs<float>&, Heads<const float>, const float*,
                                            Heads<const float>, const AttentionGradients<float>&, const Bf16Gemm&, int);
template void multi_head_attention_backward(const AttentionShape&, const AttentionInputs<Bf16>&, Heads<const Bf16>, const float*,
                                            Heads<const Bf16>, const AttentionGradients<Bf16>&, const Bf16Gemm&, int);

}  // namespace globalsplat::raster
