#include "tensor_ops.h"

#include <ATen/Context.h>
#include <ATen/Parallel.h>
#include <ATen/TensorIterator.h>
#include <ATen/core/LegacyTypeDispatch.h>
#include <ATen/core/dispatch/Dispatcher.h>
#include <torch/csrc/autograd/custom_function.h>

#include <algorithm>
#include <atomic>
#include <functional>
#include <optional>

#include "globalsplat-csrc/src/tensor_ops.rs.h"
#include "runtime.h"

// Of MKL, which libtorch has on Intel's and compatible processors, and null elsewhere. Returns the number that this thread had before.
#if defined(__x86_64__)
extern "C" __attribute__((weak)) int MKL_Set_Num_Threads_Local(int count);
#else
constexpr int (*MKL_Set_Num_Threads_Local)(int) = nullptr;
#endif

namespace globalsplat {
namespace {

using at::Tensor;
using torch::autograd::AutogradContext;
using torch::autograd::tensor_list;

// Number of rows in each part of the sum for a weight gradient. Both matrices are read along their columns, and more rows don't fit into
// the caches.
constexpr int64_t kRows = 2048;

// Blocks of a product: kBlockRows rows each. With few rows, columns are split, too, into blocks of at least kBlockColumns, until there are
// kBlocks.
constexpr int64_t kBlockRows = 256, kBlockColumns = 256, kBlocks = 16;

using MkldnnLinear = Tensor(const Tensor&, const Tensor&, const std::optional<Tensor>&, c10::string_view,
                            c10::List<std::optional<at::Scalar>>, std::optional<c10::string_view>);

// Returns the op that torch's compiler uses for a linear layer. libtorch may have been built without it.
const std::optional<c10::TypedOperatorHandle<MkldnnLinear>>& mkldnn_linear() {
  static const auto found = c10::Dispatcher::singleton().findSchema({"mkldnn::_linear_pointwise", ""});
  static const auto typed = found ? std::optional(found->typed<MkldnnLinear>()) : std::nullopt;
  return typed;
}

// Returns true if oneDNN computes float32 products faster than MKL, libtorch's default: MKL leaves half of the vector units idle on
// processors of other makers than Intel.
bool is_onednn_faster() {
#if defined(__x86_64__)
  static const bool is = [] {
    __builtin_cpu_init();
    return at::hasMKL() && mkldnn_linear() && __builtin_cpu_supports("avx2") &&
           simd_limit() != SimdLimit::Portable && !__builtin_cpu_is("intel");
  }();
  return is;
#else
  return false;
#endif
}

// Computes xs [m, k] · weightsᵀ [n, k] + bias, if there is one, in float32 or bfloat16.
Tensor multiply(const Tensor& xs, const Tensor& weights, const std::optional<Tensor>& bias) {
  if (xs.scalar_type() == at::kBFloat16 || !is_onednn_faster()) return at::linear(xs, weights, bias);
  return mkldnn_linear()->call(xs, weights, bias, "none", c10::List<std::optional<at::Scalar>>(), "");
}

// Limits MKL to one thread in products that this thread computes. Within a parallel region MKL uses one anyway, but on some processors
// it chooses the order of its sums by the number of threads that it might use elsewhere.
class OneMklThread {
 public:
  OneMklThread() : before_(MKL_Set_Num_Threads_Local == nullptr ? 0 : MKL_Set_Num_Threads_Local(1)) {}
  ~OneMklThread() {
    if (MKL_Set_Num_Threads_Local != nullptr) MKL_Set_Num_Threads_Local(before_);
  }
  OneMklThread(const OneMklThread&) = delete;
  OneMklThread& operator=(const OneMklThread&) = delete;

 private:
  const int before_;
};

// Calls task(0) to task(count - 1), distributed over libtorch's threads. On such a thread, oneDNN and MKL use only that thread.
void run_on_libtorch_threads(int64_t count, const std::function<void(int64_t)>& task) {
  std::atomic<int64_t> next{0};
  const auto take_tasks = [&](char**, const int64_t*, int64_t, int64_t) {
    const at::AutoDispatchBelowAutograd no_gradients;  // this mode is per thread
    const OneMklThread one_thread;
    for (int64_t i; (i = next.fetch_add(1, std::memory_order_relaxed)) < count;) task(i);
  };
  // at::parallel_for is parallel only in code that is compiled with OpenMP, so this calls a function in libtorch. For a single element it
  // would start no threads.
  const Tensor an_element_each = at::empty({std::max(2, at::get_num_threads())}, at::kByte);
  at::TensorIterator::borrowing_nullary_op(an_element_each).for_each(take_tasks, 1);
}

// Computes multiply() with the same bits for any number of threads. A library splits sums depending on its number of threads. Here each
// block is computed by one thread, and the blocks depend on the shape alone.
Tensor multiply_in_blocks(const Tensor& xs, const Tensor& weights, const std::optional<Tensor>& bias) {
  const int64_t m = xs.size(0), n = weights.size(0);
  const auto blocks_of = [](int64_t length, int64_t each) { return (length + each - 1) / each; };
  const int64_t row_blocks = blocks_of(m, kBlockRows);
  const int64_t wanted = std::clamp(n / kBlockColumns, int64_t(1), blocks_of(kBlocks, row_blocks));
  const int64_t columns = blocks_of(n, wanted), column_blocks = blocks_of(n, columns);
  Tensor out;
  if (row_blocks * column_blocks > 1) out = at::empty({m, n}, xs.options());
  run_on_libtorch_threads(row_blocks * column_blocks, [&](int64_t block) {
    const int64_t row = block / column_blocks * kBlockRows, height = std::min(kBlockRows, m - row);
    const int64_t column = block % column_blocks * columns, width = std::min(columns, n - column);
    std::optional<Tensor> bias_part;
    if (bias) bias_part = bias->narrow(0, column, width);
    Tensor part = multiply(xs.narrow(0, row, height), weights.narrow(0, column, width), bias_part);
    if (out.defined())
      out.narrow(0, row, height).narrow(1, column, width).copy_(part);
    else
      out = std::move(part);
  });
  return out;
}

struct LinearFunction : torch::autograd::Function<LinearFunction> {
  static Tensor forward(AutogradContext* ctx, Tensor xs, Tensor weights, std::optional<Tensor> bias) {
    ctx->save_for_backward({xs, weights});
    ctx->saved_data["has_bias"] = bias.has_value();
    return multiply_in_blocks(xs, weights, bias);
  }

  static tensor_list backward(AutogradContext* ctx, tensor_list gradients) {
    const tensor_list kept = ctx->get_saved_variables();
    const Tensor &xs = kept[0], &weights = kept[1], g = gradients[0].contiguous();
    Tensor d_xs, d_weights, d_bias;
    if (ctx->needs_input_grad(0)) d_xs = multiply(g, weights.t(), {});
    if (ctx->needs_input_grad(1)) {
      // A sum of bfloat16 parts would round each part again.
      const int64_t at_once = g.scalar_type() == at::kBFloat16 ? g.size(0) : kRows;
      for (int64_t first = 0; first < g.size(0); first += at_once) {
        const int64_t rows = std::min(at_once, g.size(0) - first);
        const Tensor part = multiply(g.narrow(0, first, rows).t(), xs.narrow(0, first, rows).t(), {});
        d_weights = d_weights.defined() ? d_weights.add_(part) : part;
      }
    }
    if (ctx->saved_data["has_bias"].toBool() && ctx->needs_input_grad(2)) d_bias = g.sum(0);
    return {d_xs, d_weights, d_bias};
  }
};

bool is_on_cpu(const Tensor& t, at::ScalarType kind) { return t.device().is_cpu() && t.scalar_type() == kind; }

}  // namespace

size_t linear(size_t xs_address, size_t weights_address, size_t bias_address) {
  const Tensor &xs = borrowed(xs_address), &weights = borrowed(weights_address);
  std::optional<Tensor> bias;
  if (bias_address != 0) bias = borrowed(bias_address);
  const at::ScalarType kind = xs.scalar_type();
  TORCH_CHECK(kind == at::kFloat || kind == at::kBFloat16, "linear layers are of float32 or bfloat16, not of ", kind);
  TORCH_CHECK(is_on_cpu(xs, kind) && is_on_cpu(weights, kind) && (!bias || is_on_cpu(*bias, kind)),
              "linear layers must be on the CPU and of one dtype");
  TORCH_CHECK(weights.dim() == 2 && xs.dim() > 0 && xs.size(-1) == weights.size(1) && xs.numel() > 0 && weights.numel() > 0 &&
                  (!bias || bias->sizes() == weights.sizes().slice(0, 1)),
              "inputs have shape ", xs.sizes(), " and weights ", weights.sizes(), ", expected inputs [.., k], weights [n, k] and bias [n]");
  auto size = xs.sizes().vec();
  size.back() = weights.size(0);
  const Tensor out = LinearFunction::apply(xs.reshape({-1, xs.size(-1)}), weights, bias);
  return owned(out.view(size));
}

}  // namespace globalsplat
