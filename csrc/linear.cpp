#include "linear.h"

#include <ATen/Context.h>
#include <ATen/core/dispatch/Dispatcher.h>
#include <torch/csrc/autograd/custom_function.h>

#include <algorithm>
#include <optional>

#include "globalsplat-csrc/src/linear.rs.h"
#include "room.h"

namespace globalsplat {
namespace {

using at::Tensor;
using torch::autograd::AutogradContext;
using torch::autograd::tensor_list;

// Of the gradient of weights, summed up part by part: both matrices are read along their columns, and more rows fall out of the caches.
constexpr int64_t kRows = 2048;

using Product = Tensor(const Tensor&, const Tensor&, const std::optional<Tensor>&, c10::string_view,
                       c10::List<std::optional<at::Scalar>>, std::optional<c10::string_view>);

// What torch's compiler calls for a linear layer. Libtorch may have been built without it.
std::optional<c10::TypedOperatorHandle<Product>> find_product() {
  const auto found = c10::Dispatcher::singleton().findSchema({"mkldnn::_linear_pointwise", ""});
  if (!found) return {};
  return found->typed<Product>();
}

const std::optional<c10::TypedOperatorHandle<Product>>& product() {
  static const auto known = find_product();
  return known;
}

// xs [m, k] · weightsᵀ [n, k] + bias, if there is one. Beside the result there may be the weights in oneDNN's order.
Tensor multiply(const Tensor& xs, const Tensor& weights, const std::optional<Tensor>& bias) {
  expect_room_for_code(int64_t(xs.element_size()) * (xs.size(0) * weights.size(0) + weights.numel()));
  if (xs.scalar_type() == at::kBFloat16) return at::linear(xs, weights, bias);
  return product()->call(xs, weights, bias, "none", c10::List<std::optional<at::Scalar>>(), "");
}

struct LinearFunction : torch::autograd::Function<LinearFunction> {
  static Tensor forward(AutogradContext* ctx, Tensor xs, Tensor weights, std::optional<Tensor> bias) {
    ctx->save_for_backward({xs, weights});
    ctx->saved_data["has_bias"] = bias.has_value();
    return multiply(xs, weights, bias);
  }

  static tensor_list backward(AutogradContext* ctx, tensor_list gradients) {
    const tensor_list kept = ctx->get_saved_variables();
    const Tensor &xs = kept[0], &weights = kept[1], g = gradients[0].contiguous();
    Tensor d_xs, d_weights, d_bias;
    if (ctx->needs_input_grad(0)) d_xs = multiply(g, weights.t(), {});
    if (ctx->needs_input_grad(1)) {
      // Sums of bfloat16 parts would be rounded once more each.
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

bool linear_is_faster() {
#if defined(__x86_64__)
  static const bool is = [] {
    __builtin_cpu_init();
    return at::hasMKL() && product() && __builtin_cpu_supports("avx2") && !__builtin_cpu_is("intel");
  }();
  return is;
#else
  return false;
#endif
}

size_t linear(size_t xs_address, size_t weights_address, size_t bias_address) {
  const auto borrowed = [](size_t address) -> const Tensor& { return *reinterpret_cast<const Tensor*>(address); };
  const Tensor &xs = borrowed(xs_address), &weights = borrowed(weights_address);
  std::optional<Tensor> bias;
  if (bias_address != 0) bias = borrowed(bias_address);
  const at::ScalarType kind = xs.scalar_type();
  TORCH_CHECK(kind == at::kFloat || kind == at::kBFloat16, "linear layers are of float32 or bfloat16, not of ", kind);
  TORCH_CHECK(kind != at::kFloat || linear_is_faster(), "products of float32 are libtorch's on this processor");
  TORCH_CHECK(is_on_cpu(xs, kind) && is_on_cpu(weights, kind) && (!bias || is_on_cpu(*bias, kind)),
              "linear layers must be on the CPU, and of one kind of numbers");
  TORCH_CHECK(weights.dim() == 2 && xs.dim() > 0 && xs.size(-1) == weights.size(1) && xs.numel() > 0 && weights.numel() > 0 &&
                  (!bias || bias->sizes() == weights.sizes().slice(0, 1)),
              "numbers have shape ", xs.sizes(), " and weights ", weights.sizes(), ", expected [.., k] and [n, k], and a bias [n]");
  auto size = xs.sizes().vec();
  size.back() = weights.size(0);
  const Tensor out = LinearFunction::apply(xs.reshape({-1, xs.size(-1)}), weights, bias);
  return reinterpret_cast<size_t>(new Tensor(out.view(size)));
}

}  // namespace globalsplat
