#include "attention.h"

#include <ATen/native/CPUBlas.h>
#include <ATen/ops/empty.h>
#include <ATen/record_function.h>
#include <torch/csrc/autograd/custom_function.h>

#include <vector>

#include "globalsplat-csrc/src/attention.rs.h"
#include "raster/attend.h"
#include "raster/rows.h"
#include "threads.h"

namespace globalsplat {
namespace {

using at::Tensor;
using torch::autograd::AutogradContext;
using torch::autograd::tensor_list;

// Rows of numbers side by side.
Tensor with_whole_rows(const Tensor& t) { return t.size(2) == 1 || t.stride(2) == 1 ? t : t.contiguous(); }

raster::Heads<const float> read(const Tensor& t) { return {t.const_data_ptr<float>(), t.stride(0), t.stride(1)}; }
raster::Heads<float> written(const Tensor& t) { return {t.data_ptr<float>(), t.stride(0), t.stride(1)}; }
raster::Heads<const raster::Bf16> read_bf16(const Tensor& t) {
  return {static_cast<const raster::Bf16*>(t.const_data_ptr()), t.stride(0), t.stride(1)};
}

raster::AttentionShape shape_of(const Tensor& q, const Tensor& k, int64_t heads) {
  return {q.size(0), heads, q.size(1), k.size(1), int(q.size(2) / heads)};
}

struct AttentionFunction : torch::autograd::Function<AttentionFunction> {
  static Tensor forward(AutogradContext* ctx, Tensor q, Tensor k, Tensor v, int64_t heads) {
    const Tensor out = at::empty(q.sizes(), q.options()), log_sums = at::empty({q.size(0), heads, q.size(1)}, q.options());
    raster::attend(shape_of(q, k, heads), {read(q), read(k), read(v)}, written(out), log_sums.data_ptr<float>(), threads());
    ctx->save_for_backward({q, k, v, out, log_sums});
    ctx->saved_data["heads"] = heads;
    return out;
  }

  static tensor_list backward(AutogradContext* ctx, tensor_list g) {
    const tensor_list t = ctx->get_saved_variables();
    const Tensor &q = t[0], &k = t[1], &v = t[2], slope = with_whole_rows(g[0]);
    const auto like = [](const Tensor& of) { return at::empty(of.sizes(), of.options()); };
    const tensor_list gradients = {like(q), like(k), like(v)};
    raster::attend_backward(shape_of(q, k, ctx->saved_data["heads"].toInt()), {read(q), read(k), read(v)}, read(t[3]),
                            t[4].const_data_ptr<float>(), read(slope),
                            {written(gradients[0]), written(gradients[1]), written(gradients[2])}, threads());
    return {gradients[0], gradients[1], gradients[2], Tensor()};
  }
};

// oneDNN's, by way of libtorch: it compiles them for the processor, be it for vectors or for tiles.
void multiply(int64_t m, int64_t n, int64_t k, int64_t a_row, int64_t b_row, int64_t c_row, bool adds, const raster::Bf16* a,
              const raster::Bf16* b, float* c) {
  const auto numbers = [](const raster::Bf16* of) { return reinterpret_cast<const at::BFloat16*>(of); };
  at::native::cpublas::brgemm(m, n, k, a_row, b_row, c_row, adds, numbers(a), numbers(b), c, true);
}

void done() { at::native::cpublas::brgemm_release(true); }

// Libtorch refuses where oneDNN has none.
bool has_bf16_products() {
  static const bool has = [] {
    const std::vector<raster::Bf16> zeros(16 * 16);
    std::vector<float> sums(16 * 16);
    try {
      multiply(16, 16, 16, 16, 16, 16, false, zeros.data(), zeros.data(), sums.data());
    } catch (const c10::Error&) {
      return false;
    }
    done();
    return true;
  }();
  return has;
}

Tensor attend_bf16(const Tensor& q, const Tensor& k, const Tensor& v, int64_t heads) {
  const auto with_pairs = [](const Tensor& t) { return t.stride(1) % 2 == 0 ? with_whole_rows(t) : t.contiguous(); };
  const Tensor queries = with_whole_rows(q), keys = with_pairs(k), values = with_whole_rows(v);
  const Tensor out = at::empty(q.sizes(), q.options());
  raster::attend_bf16(shape_of(q, k, heads), {read_bf16(queries), read_bf16(keys), read_bf16(values)},
                      {static_cast<raster::Bf16*>(out.data_ptr()), out.stride(0), out.stride(1)}, {multiply, done}, threads());
  return out;
}

}  // namespace

bool attention_takes(int64_t width, bool is_bf16) {
  const bool fits = width > 0 && width % (is_bf16 ? 8 : 4) == 0 && width <= raster::kAttentionWidth;
  return fits && (!is_bf16 || has_bf16_products());
}

size_t attention(size_t q_address, size_t k_address, size_t v_address, int64_t heads) {
  const auto borrowed = [](size_t address) -> const Tensor& { return *reinterpret_cast<const Tensor*>(address); };
  const Tensor &q = borrowed(q_address), &k = borrowed(k_address), &v = borrowed(v_address);
  const bool is_bf16 = q.scalar_type() == at::kBFloat16;
  for (const Tensor* t : {&q, &k, &v})
    TORCH_CHECK(t->device().is_cpu() && t->scalar_type() == (is_bf16 ? at::kBFloat16 : at::kFloat) && t->dim() == 3,
                "queries, keys and values must be float32 on the CPU, or all of them bfloat16, of shape [B, n, d]");
  TORCH_CHECK(heads > 0 && q.size(2) % heads == 0 && attention_takes(q.size(2) / heads, is_bf16), "queries of shape ", q.sizes(),
              " have ", heads, " heads, expected a width of each that is a multiple of 4, of bfloat16 of 8, at most ",
              raster::kAttentionWidth);
  TORCH_CHECK(k.sizes() == v.sizes() && k.size(0) == q.size(0) && k.size(2) == q.size(2) && k.size(1) > 0, "queries have shape ",
              q.sizes(), ", keys ", k.sizes(), " and values ", v.sizes(), ", expected [B, n, d] and twice [B, m, d] with m > 0");
  // Profilers see it as they see libtorch's.
  RECORD_FUNCTION("globalsplat::attention", c10::ArrayRef<const c10::IValue>{});
  const Tensor out = is_bf16 ? attend_bf16(q, k, v, heads)
                             : AttentionFunction::apply(with_whole_rows(q), with_whole_rows(k), with_whole_rows(v), heads);
  return reinterpret_cast<size_t>(new Tensor(out));
}

}  // namespace globalsplat
