// The ops as PyTorch's dispatcher knows them, torch.ops.globalsplat: what the Python package calls. Their autograd formulas, and the shapes
// of their results for fake tensors, are registered in Python (python/globalsplat/_ops.py).
#include <ATen/TensorOperators.h>
#include <ATen/ops/empty.h>
#include <ATen/ops/stack.h>
#include <ATen/ops/where.h>
#include <torch/library.h>

#include <cmath>
#include <limits>

#include "backend.h"

namespace globalsplat {
namespace {

using torch::jit::Stack;

// State of a forward pass: its backend's, and which images are NaN, [B, C], undefined if none is.
struct State {
  std::unique_ptr<const SavedState> of_backend;
  Tensor is_nan;
};

// Holds a state, and the memory of the int64 tensor [1] that represents it.
struct StateOwner {
  int64_t value;
  State state;
};

void delete_state(void* owner) { delete static_cast<StateOwner*>(owner); }

Tensor to_tensor(State state) {
  auto* const owner = new StateOwner{0, std::move(state)};
  c10::DataPtr memory(&owner->value, owner, delete_state, at::kCPU);
  return at::empty({0}, at::kLong).set_(c10::Storage(c10::Storage::use_byte_size_t(), sizeof(owner->value), std::move(memory)), 0, {1}, {1});
}

// Returns the state that a tensor represents, or null if the tensor is a copy, as when saved tensors were moved to another device.
const State* state_of(const Tensor& tensor) {
  const c10::DataPtr& memory = tensor.storage().data_ptr();
  return memory.get_deleter() == delete_state ? &static_cast<const StateOwner*>(memory.get_context())->state : nullptr;
}

// Arguments of every op. Shapes: means [B, N, 3], quats [B, N, 4], scales [B, N, 3], opacities [B, N], colors [B, N, K, 3], viewmats
// [B, C, 4, 4], Ks [B, C, 3, 3].
#define GS_ARGUMENTS                                                                                                                  \
  "Tensor means, Tensor quats, Tensor scales, Tensor opacities, Tensor colors, Tensor viewmats, Tensor Ks, int width, int height, " \
  "float eps2d, float near_plane, float far_plane, bool antialiased, bool direct_colors"
constexpr size_t kArguments = 14;

// Checks the arguments and returns them as their backend takes them.
Inputs inputs_of(c10::ArrayRef<c10::IValue> of) {
  const auto tensor = [&](size_t index) { return of[index].toTensor(); };
  const raster::ProjectionSettings projection{of[9].toDouble(), of[12].toBool(), of[13].toBool(), of[10].toDouble(), of[11].toDouble()};
  const Inputs given{{tensor(0), tensor(2), tensor(1), tensor(3), tensor(4)}, tensor(5), tensor(6), of[7].toInt(), of[8].toInt(), projection};
  return given.to_backend();
}

// Replaces an op's arguments by its results, on the device of the means, the first argument.
template <class... Results>
void finish(Stack* stack, size_t arguments, const Results&... results) {
  const at::Device device = torch::jit::peek(*stack, 0, arguments).toTensor().device();
  torch::jit::drop(*stack, arguments);
  torch::jit::push(*stack, results.to(device)...);
}

// Returns which images depend on a camera or a Gaussian with a number that isn't finite, [B, C], or an undefined tensor if none does.
// Colors aren't checked: their NaN reaches the pixels that show them.
Tensor find_nan_images(const Inputs& in) {
  const auto& [means, scales, quaternions, opacities, sh] = in.gaussians;
  // Sums take a tenth of the time of isfinite(). They may overflow.
  const Tensor sum = means.sum() + scales.sum() + quaternions.sum() + opacities.sum() + in.w2c.sum() + in.intrinsics.sum();
  if (std::isfinite(sum.item<double>())) return {};
  const auto are_finite = [](const Tensor& t, int64_t dims) { return t.flatten(dims).isfinite().all(dims); };
  Tensor are_valid = are_finite(in.w2c, 2).logical_and(are_finite(in.intrinsics, 2));
  for (const Tensor& t : {means, scales, quaternions, opacities}) are_valid = are_valid.logical_and(are_finite(t, 1).unsqueeze(1));
  return are_valid.logical_not();
}

// Sets results of a call, [B, ...] or [B, C, ...], to NaN where `is_nan`, [B] or [B, C], is true.
void fill_nan(Tensor is_nan, const Tensor& results) {
  while (is_nan.dim() < results.dim()) is_nan = is_nan.unsqueeze(-1);
  results.masked_fill_(is_nan, std::numeric_limits<double>::quiet_NaN());
}

// Renders. Backends leave out Gaussians with numbers that aren't finite, and training that has diverged would look well: the images are NaN.
RenderOutput render_or_nan(const Inputs& in, State& state) {
  const RenderOutput out = render(in, state.of_backend);
  state.is_nan = find_nan_images(in);
  if (state.is_nan.defined())
    for (const Tensor& t : {out.rgb, out.alpha, out.depth}) fill_nan(state.is_nan, t);
  return out;
}

void splat_op(const c10::OperatorHandle&, Stack* stack) {
  const Inputs in = inputs_of(torch::jit::last(*stack, kArguments + 1).slice(0, kArguments));
  State state;
  const RenderOutput out = render_or_nan(in, state);
  finish(stack, kArguments + 1, out.rgb, out.alpha, out.depth);
  torch::jit::push(*stack, to_tensor(std::move(state)));
}

void splat_backward_op(const c10::OperatorHandle&, Stack* stack) {
  constexpr size_t kAll = kArguments + 9;
  const auto all = torch::jit::last(*stack, kAll);
  const Inputs in = inputs_of(all.slice(0, kArguments));
  const at::TensorOptions options = in.gaussians.means.options();
  const auto tensor = [&](size_t index) { return all[kArguments + index].toTensor().to(options).contiguous(); };
  RenderOutput outputs{tensor(0), tensor(1), tensor(2)};
  const State* state = state_of(all[kArguments + 3].toTensor());
  State repeated;
  if (state == nullptr) {
    outputs = render_or_nan(in, repeated);
    state = &repeated;
  }
  const GradientRequest request{all[kArguments + 7].toBool(), all[kArguments + 8].toBool()};
  const Gradients d = render_backward(in, outputs, {tensor(4), tensor(5), tensor(6)}, *state->of_backend, request);
  const Gaussians& g = d.gaussians;
  if (state->is_nan.defined()) {
    for (const Tensor& t : {g.means, g.scales, g.quaternions, g.opacities, g.sh}) fill_nan(state->is_nan.any(1), t);
    for (const Tensor& t : {d.w2c, d.means2d})
      if (t.defined()) fill_nan(state->is_nan, t);
  }
  const auto defined = [&](const Tensor& t) { return t.defined() ? t : at::empty({0}, options); };
  finish(stack, kAll, g.means, g.quaternions, g.scales, g.opacities, g.sh, defined(d.w2c), defined(d.means2d));
}

// Values of Gaussians that aren't visible are 0.
void project_op(const c10::OperatorHandle&, Stack* stack) {
  constexpr double kTwoLn2 = 2 / raster::kLog2E;
  const Inputs in = inputs_of(torch::jit::last(*stack, kArguments));
  const std::vector<Tensor> s = backend_of(in.gaussians.means).project(in).unbind(-1);
  const Tensor &u = s[0], &v = s[1], &a = s[2], &b = s[3], &c = s[4], &log2_opacity = s[5], &z = s[9], visible = z > 0;
  const auto shown = [&](const Tensor& t) { return at::where(t.dim() > visible.dim() ? visible.unsqueeze(-1) : visible, t, 0); };
  // Σ2D⁻¹ = 2 ln 2·UᵀU with U = [[a, b], [0, c]]. Variances are computed from U, since the inverse of a needle's conic loses all digits.
  finish(stack, kArguments, shown(at::stack({u, v}, -1)), shown(kTwoLn2 * at::stack({a * a, a * b, b * b + c * c}, -1)), shown(z),
         shown(log2_opacity.exp2()), shown(at::stack({(1 + (b / c).square()) / (kTwoLn2 * a * a), 1 / (kTwoLn2 * c * c)}, -1)),
         visible.to(at::kLong));
}

// Shapes of results: rgb [B, C, 3, H, W], alpha and depth [B, C, H, W]; visible, depths and opacities [B, C, N], means2d and variances
// [B, C, N, 2], conics [B, C, N, 3]. The argument means2d of splat is not read: it is there to receive the gradient of the projected means. The gradients have
// the order of the arguments that they belong to. Those that aren't requested have no elements.
TORCH_LIBRARY(globalsplat, library) {
  library.def("splat(" GS_ARGUMENTS ", Tensor? means2d) -> (Tensor rgb, Tensor alpha, Tensor depth, Tensor state)");
  library.def("splat_backward(" GS_ARGUMENTS ", Tensor rgb, Tensor alpha, Tensor depth, Tensor state, Tensor d_rgb, Tensor d_alpha, "
              "Tensor d_depth, bool has_viewmats_grad, bool has_means2d_grad) -> (Tensor, Tensor, Tensor, Tensor, Tensor, Tensor, Tensor)");
  library.def("project(" GS_ARGUMENTS ") -> (Tensor means2d, Tensor conics, Tensor depths, Tensor opacities, Tensor variances, Tensor visible)");
}

void implement(torch::Library& library) {
  library.impl("splat", torch::CppFunction::makeFromBoxedFunction<&splat_op>());
  library.impl("splat_backward", torch::CppFunction::makeFromBoxedFunction<&splat_backward_op>());
  library.impl("project", torch::CppFunction::makeFromBoxedFunction<&project_op>());
}
TORCH_LIBRARY_IMPL(globalsplat, CPU, library) { implement(library); }
TORCH_LIBRARY_IMPL(globalsplat, CUDA, library) { implement(library); }

}  // namespace
}  // namespace globalsplat
