#include "tensor_ops.h"

#include <ATen/native/CPUBlas.h>
#include <ATen/ops/empty.h>
#include <ATen/record_function.h>
#include <torch/csrc/autograd/custom_function.h>

#include <exception>
#include <vector>

#include "globalsplat-csrc/src/tensor_ops.rs.h"
#include "kernels/attention_types.h"
#include "kernels/multi_head_attention.h"
#include "runtime.h"

namespace globalsplat {
namespace {

using at::Tensor;
using torch::autograd::AutogradContext;
using torch::autograd::tensor_list;

bool is_bf16(const Tensor& t) { return t.scalar_type() == at::kBFloat16; }

// Returns a tensor whose rows are contiguous; bfloat16 rows also begin at whole 32-bit words.
Tensor with_whole_rows(const Tensor& t) {
  const bool whole = t.size(2) == 1 || t.stride(2) == 1;
  return whole && (!is_bf16(t) || t.stride(1) % 2 == 0) ? t : t.contiguous();
}

template <class Number>
raster::Heads<const Number> read(const Tensor& t) {
  return {static_cast<const Number*>(t.const_data_ptr()), t.stride(0), t.stride(1)};
}
template <class Number>
raster::Heads<Number> written(const Tensor& t) {
  return {static_cast<Number*>(t.data_ptr()), t.stride(0), t.stride(1)};
}

// Calls body() with a number of the tensor's type.
template <class Body>
void dispatch_by_type(const Tensor& t, const Body& body) {
  if (is_bf16(t))
    body(raster::Bf16());
  else
    body(0.f);
}

raster::AttentionShape shape_of(const Tensor& q, const Tensor& k, int64_t heads) {
  return {q.size(0), heads, q.size(1), k.size(1), int(q.size(2) / heads)};
}

// Calls oneDNN's products through libtorch. oneDNN compiles them for the processor, for vectors or for tiles.
void multiply(int64_t m, int64_t n, int64_t k, int64_t a_row, int64_t b_row, int64_t c_row, bool adds, const raster::Bf16* a,
              const raster::Bf16* b, float* c) {
  const auto numbers = [](const raster::Bf16* of) { return reinterpret_cast<const at::BFloat16*>(of); };
  at::native::cpublas::brgemm(m, n, k, a_row, b_row, c_row, adds, numbers(a), numbers(b), c, true);
}

void release() { at::native::cpublas::brgemm_release(true); }

raster::Bf16Gemm bf16_gemm() { return {multiply, release}; }

// Returns true if bf16 products work. libtorch throws if oneDNN doesn't support them, and oneDNN if their instructions are disabled.
bool has_bf16_gemm() {
  static const bool has = [] {
    const std::vector<raster::Bf16> zeros(16 * 16);
    std::vector<float> sums(16 * 16);
    const raster::Bf16Gemm tried = bf16_gemm();
    try {
      tried.multiply(16, 16, 16, 16, 16, 16, false, zeros.data(), zeros.data(), sums.data());
    } catch (const std::exception&) {
      return false;
    }
    tried.release();
    return true;
  }();
  return has;
}

struct AttentionFunction : torch::autograd::Function<AttentionFunction> {
  static Tensor forward(AutogradContext* ctx, Tensor q, Tensor k, Tensor v, int64_t heads) {
    const Tensor out = at::empty(q.sizes(), q.options());
    const Tensor log_sums = at::empty({q.size(0), heads, q.size(1)}, q.options().dtype(at::kFloat));
    const raster::AttentionShape shape = shape_of(q, k, heads);
    dispatch_by_type(q, [&](auto number) {
      using Number = decltype(number);
      raster::multi_head_attention<Number>(shape, {read<Number>(q), read<Number>(k), read<Number>(v)}, written<Number>(out),
                                           log_sums.data_ptr<float>(), bf16_gemm(), get_num_threads());
    });
    ctx->save_for_backward({q, k, v, out, log_sums});
    ctx->saved_data["heads"] = heads;
    return out;
  }

  static tensor_list backward(AutogradContext* ctx, tensor_list g) {
    const tensor_list t = ctx->get_saved_variables();
    const Tensor &q = t[0], &k = t[1], &v = t[2], &out = t[3], grad_out = with_whole_rows(g[0]);
    const auto like = [](const Tensor& of) { return at::empty(of.sizes(), of.options()); };
    const Tensor dq = like(q), dk = like(k), dv = like(v);
    const raster::AttentionShape shape = shape_of(q, k, ctx->saved_data["heads"].toInt());
    dispatch_by_type(q, [&](auto number) {
      using Number = decltype(number);
      raster::multi_head_attention_backward<Number>(shape, {read<Number>(q), read<Number>(k), read<Number>(v)}, read<Number>(out),
                                                    t[4].const_data_ptr<float>(), read<Number>(grad_out),
                                                    {written<Number>(dq), written<Number>(dk), written<Number>(dv)}, bf16_gemm(),
                                                    get_num_threads());
    });
    return {dq, dk, dv, Tensor()};
  }
};

}  // namespace

bool supports_attention(int64_t width, bool is_bf16) {
  const bool fits = width > 0 && width % (is_bf16 ? 8 : 4) == 0 && width <= raster::kAttentionWidth;
  return fits && (!is_bf16 || has_bf16_gemm());
}

size_t attention(size_t q_address, size_t k_address, size_t v_address, int64_t heads) {
  const Tensor &q = borrowed(q_address), &k = borrowed(k_address), &v = borrowed(v_address);
  const bool bf16 = is_bf16(q);
  for (const Tensor* t : {&q, &k, &v})
    TORCH_CHECK(t->device().is_cpu() && t->scalar_type() == (bf16 ? at::kBFloat16 : at::kFloat) && t->dim() == 3,
                "queries, keys and values must be float32 on the CPU, or all of them bfloat16, of shape [B, n, d]");
  TORCH_CHECK(heads > 0 && q.size(2) % heads == 0 && supports_attention(q.size(2) / heads, bf16), "queries of shape ", q.sizes(),
              " have ", heads, " heads, expected a head width of at most ", raster::kAttentionWidth,
              " that is a multiple of 4 (bfloat16: of 8)");
  TORCH_CHECK(k.sizes() == v.sizes() && k.size(0) == q.size(0) && k.size(2) == q.size(2) && k.size(1) > 0, "queries have shape ",
              q.sizes(), ", keys ", k.sizes(), " and values ", v.sizes(), ", expected [B, n, d] and twice [B, m, d] with m > 0");
  // Makes the op visible to profilers, like libtorch's own.
  RECORD_FUNCTION("globalsplat::attention", c10::ArrayRef<const c10::IValue>{});
  return owned(AttentionFunction::apply(with_whole_rows(q), with_whole_rows(k), with_whole_rows(v), heads));
}

}  // namespace globalsplat
