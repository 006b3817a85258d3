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

template <>
void multi_head_attention_backward(const AttentionShape& shape, const AttentionInputs<float>& in, Heads<const float> out,
                                   const float* log_sums, Heads<const float> grad_out, const AttentionGradients<float>& gradients,
                                   const Bf16Gemm&, int num_threads) {
  const int64_t heads = shape.scenes * shape.heads;
  // Every task processes a part of a head's keys, split by shapes alone, and computes a gradient for all of its queries; these are summed
  // in order.
  const int64_t size = rows_per_task(heads, shape.keys, 64, kBackwardKeys, kBackwardKeys), parts = (shape.keys + size - 1) / size;
  const int64_t whole = whole_product_rows(shape.queries), columns = attention_columns(shape.width), all = whole * columns;
  const std::unique_ptr<float[]> q(new float[size_t(heads * all)]), grads_out(new float[size_t(heads * all)]);
  const std::unique_ptr<float[]> means(new float[size_t(heads * whole)]), sums(new float[size_t(heads * parts * all)]);
  const auto packed = [&](int64_t head, int64_t begin) {
    const int64_t row = head * whole + begin;
    return PackedQueries{q.get() + row * columns, grads_out.get() + row * columns, means.get() + row};
  };
  const auto rows = [&](const auto& of, int64_t head, int64_t begin) { return head_of(of, shape, head).from(begin); };

  const int64_t pieces = (shape.queries + kPiece - 1) / kPiece;
  parallel_for(num_threads, heads * pieces, [&](int64_t task) {
    const int64_t head = task / pieces, begin = task % pieces * kPiece, end = std::min(begin + kPiece, shape.queries);
    const PackedQueries to = packed(head, begin);
    kernels().pack_queries({rows(in.q, head, begin), {}, {}, end - begin, 0, shape.width},
                           {rows(out, head, begin), rows(grad_out, head, begin)}, to);
    if (end < shape.queries) return;
    std::fill(to.q + (end - begin) * columns, to.q + (whole - begin) * columns, 0.f);
    std::fill(to.grad_out + (end - begin) * columns, to.grad_out + (whole - begin) * columns, 0.f);
  });
  parallel_for(num_threads, heads * parts, [&](int64_t task) {
    const int64_t head = task / parts, begin = task % parts * size;
    kernels().attention_backward({{}, rows(in.k, head, begin), rows(in.v, head, begin), shape.queries, std::min(size, shape.keys - begin),
                                  shape.width},
                                 packed(head, 0), log_sums + head * shape.queries, sums.get() + task * all,
                                 rows(gradients.k, head, begin), rows(gradients.v, head, begin),
                                 scratch(attention_backward_scratch_size(shape.width)));
  });
  const float scale = float(1 / std::sqrt(double(shape.width)));
  parallel_for(num_threads, heads * pieces, [&](int64_t task) {
    const int64_t head = task / pieces, begin = task % pieces * kPiece;
    const Rows<float> to = head_of(gradients.q, shape, head);
    for (int64_t i = begin; i < std::min(begin + kPiece, shape.queries); ++i) {
      const float* const first = sums.get() + head * parts * all + i * columns;
      for (int c = 0; c < shape.width; ++c) {
        float sum = 0;
        for (int64_t n = 0; n < parts; ++n) sum += first[n * all + c];
        to.data[i * to.stride + c] = scale * sum;
      }
    }
  });
}

template <>
void multi_head_attention_backward(const AttentionShape& shape, const AttentionInputs<Bf16>& in, Heads<const Bf16> out,
                                   const float* log_sums, Heads<const Bf16> grad_out, const AttentionGradients<Bf16>& gradients,
                                   const Bf16Gemm& gemm, int num_threads) {
  // Work is split as for float32.
  const int64_t heads = shape.scenes * shape.heads, width = shape.width;
  const int64_t size = rows_per_task(heads, shape.keys, 64, kBf16BackwardKeys, kBf16BackwardKeys), parts = (shape.keys + size - 1) / size;
  const int64_t whole = whole_bf16_columns(shape.queries), all = whole * width, rows_all = whole * attention_columns(shape.width);
  const std::unique_ptr<Bf16[]> q_columns(new Bf16[size_t(heads * all)]), grad_out_columns(new Bf16[size_t(heads * all)]);
  const std::unique_ptr<Bf16[]> q_rows(new Bf16[size_t(heads * rows_all)]), grad_out_rows(new Bf16[size_t(heads * rows_all)]);
  const std::unique_ptr<float[]> shifts(new float[size_t(heads * whole)]), means(new float[size_t(heads * whole)]);
  const std::unique_ptr<float[]> sums(new float[size_t(heads * parts * all)]);
  const auto packed = [&](int64_t head) {
    return PackedBf16Queries{q_columns.get() + head * all,     grad_out_columns.get() + head * all,   q_rows.get() + head * rows_all,
                             grad_out_rows.get() + head * rows_all, shifts.get() + head * whole, means.get() + head * whole};
  };
  const auto rows = [&](const auto& of, int64_t head, int64_t begin) { return head_of(of, shape, head).from(begin); };

  const int64_t panels = whole / kBf16Columns;
  parallel_for(num_threads, heads * panels, [&](int64_t task) {
    const int64_t head = task / panels;
    kernels().pack_queries_bf16({rows(in.q, head, 0), {}, {}, shape.queries, 0, shape.width}, {rows(out, head, 0), rows(grad_out, head, 0)},
                                log_sums + head * shape.queries, task % panels * kBf16Columns, whole, packed(head));
  });
  parallel_for(num_threads, heads * parts, [&](int64_t task) {
    const int64_t head = task / parts, begin = task % parts * size;
    kernels().attention_backward_bf16({{}, rows(in.k, head, begin), rows(in.v, head, begin), shape.queries,
                                       std::min(size, shape.keys - begin), shape.width},
                                      gemm, packed(head), sums.get() + task * all, rows(gradients.k, head, begin),
                                      rows(gradients.v, head, begin), scratch(attention_bf16_backward_scratch_size(shape.width)));
  });
  const float scale = float(1 / std::sqrt(double(width)));
  parallel_for(num_threads, heads * panels, [&](int64_t task) {
    const int64_t head = task / panels, begin = task % panels * kBf16Columns;
    const Rows<Bf16> to = rows(gradients.q, head, begin);
    for (int64_t i = 0; i < std::min(kBf16Columns, shape.queries - begin); ++i) {
      const float* const first = sums.get() + head * parts * all + begin * width + i;
      for (int64_t c = 0; c < width; ++c) {
        float sum = 0;
        for (int64_t n = 0; n < parts; ++n) sum += first[n * all + c * kBf16Columns];
        to.data[i * to.stride + c] = to_bf16(scale * sum);
      }
    }
  });
}

}  // namespace globalsplat::raster
