#include "splat.h"

#include <torch/csrc/autograd/custom_function.h>

#include <algorithm>
#include <utility>

#include "backend.h"
#include "globalsplat-csrc/src/render.rs.h"
#include "kernels/sh.h"
#include "runtime.h"

namespace globalsplat {
namespace {

constexpr int64_t kMaxSide = 1 << 20;              // pixels
constexpr int64_t kMaxCount = int64_t(1) << 31;    // Gaussians are indexed by 32 bits

void expect_shape(const char* name, const Tensor& t, std::vector<int64_t> expected) {
  TORCH_CHECK(t.sizes() == at::IntArrayRef(expected), name, " has shape ", t.sizes(), ", expected ",
              at::IntArrayRef(expected));
}

}  // namespace

void Arguments::check() const {
  TORCH_CHECK(means.dim() == 3 && w2c.dim() == 4 && sh.dim() == 4,
              "means must be [B, N, 3], sh [B, N, bases, 3] and w2c [B, C, 4, 4]");
  const int64_t scenes = means.size(0), count = means.size(1), cameras = w2c.size(1), bases = sh.size(2);
  expect_shape("means", means, {scenes, count, 3});
  expect_shape("scales", scales, {scenes, count, 3});
  expect_shape("quaternions", quaternions, {scenes, count, 4});
  expect_shape("opacities", opacities, {scenes, count});
  expect_shape("sh", sh, {scenes, count, bases, 3});
  expect_shape("w2c", w2c, {scenes, cameras, 4, 4});
  expect_shape("intrinsics", intrinsics, {scenes, cameras, 3, 3});
  TORCH_CHECK(bases == 1 || bases == 4 || bases == 9 || bases == 16, "sh has ", bases,
              " basis functions, expected 1, 4, 9 or 16");
  TORCH_CHECK(width > 0 && height > 0 && width <= kMaxSide && height <= kMaxSide, "the image is ", width, "×",
              height, ", expected sides from 1 to ", kMaxSide);
  TORCH_CHECK(count < kMaxCount, "there are ", count, " Gaussians, expected fewer than ", kMaxCount);
  TORCH_CHECK(projection.eps2d >= 0, "eps2d is ", projection.eps2d, ", expected 0 or more");
  TORCH_CHECK(projection.near_plane >= 0, "near_plane is ", projection.near_plane, ", expected 0 or more");
  TORCH_CHECK(!projection.direct_colors || bases == 1, "colors have shape ", sh.sizes(), ", expected [B, N, 1, 3]");
}

Inputs Arguments::to_inputs(at::Device device) const {
  const auto type = means.scalar_type() == at::kDouble ? at::kDouble : at::kFloat;
  const auto there = [&](const Tensor& t) { return t.to(device, type).contiguous(); };
  return {{there(means), there(scales), there(quaternions), there(opacities), there(sh)},
          there(w2c), there(intrinsics.detach()), width, height, projection};
}

Arguments borrowed(const SplatArguments& of) {
  return {borrowed(of.means), borrowed(of.scales), borrowed(of.quaternions), borrowed(of.opacities), borrowed(of.sh),
          borrowed(of.w2c), borrowed(of.intrinsics), of.width, of.height, {of.eps2d, of.antialiased}};
}

const Backend& backend_of(const Tensor& means) {
  if (means.scalar_type() == at::kDouble) return cpu::backend;
  if (const Backend* emulated = cuda::emulated_backend()) return *emulated;
  return means.device().type() == cuda::backend.device ? cuda::backend : cpu::backend;
}

at::Device backend_device(const Tensor& means) {
  const at::DeviceType device = backend_of(means).device;
  return device == means.device().type() ? means.device() : at::Device(device);
}

namespace {

using torch::autograd::AutogradContext;
using torch::autograd::tensor_list;

// ---- state that autograd saves for a call: the seven input tensors, then the op's own tensors, and what isn't a tensor ----

constexpr size_t kInputTensors = 7;
constexpr size_t kInputs = 10;

struct SavedCall : torch::CustomClassHolder {
  SavedCall(const Inputs& in, std::unique_ptr<const SavedState> s)
      : width(in.width), height(in.height), projection(in.projection), state(std::move(s)) {}
  int64_t width, height;
  raster::ProjectionSettings projection;
  std::unique_ptr<const SavedState> state;
};

void save(AutogradContext* ctx, const Inputs& in, std::unique_ptr<const SavedState> state, const tensor_list& more = {}) {
  const Gaussians& g = in.gaussians;
  tensor_list tensors = {g.means, g.scales, g.quaternions, g.opacities, g.sh, in.w2c, in.intrinsics};
  tensors.insert(tensors.end(), more.begin(), more.end());
  ctx->save_for_backward(std::move(tensors));
  ctx->saved_data["call"] = c10::IValue::make_capsule(c10::make_intrusive<SavedCall>(in, std::move(state)));
}

c10::intrusive_ptr<SavedCall> saved_call(AutogradContext* ctx) {
  return c10::static_intrusive_pointer_cast<SavedCall>(ctx->saved_data["call"].toCapsule());
}

Inputs saved_inputs(const SavedCall& call, const tensor_list& t) {
  return {{t[0], t[1], t[2], t[3], t[4]}, t[5], t[6], call.width, call.height, call.projection};
}

// Index of w2c among the input tensors.
constexpr size_t kW2c = 5;

// Returns gradients in autograd's order, undefined for intrinsics and settings.
tensor_list gradients_of(const Gradients& gradients) {
  const Gaussians& g = gradients.gaussians;
  tensor_list out = {g.means, g.scales, g.quaternions, g.opacities, g.sh, gradients.w2c};
  out.resize(kInputs);
  return out;
}

Tensor contiguous(const Tensor& t) { return t.defined() ? t.contiguous() : t; }

// ---- the two ops ----

struct SplatFunction : torch::autograd::Function<SplatFunction> {
  static tensor_list forward(AutogradContext* ctx, Tensor means, Tensor scales, Tensor quaternions, Tensor opacities, Tensor sh,
                             Tensor w2c, Tensor intrinsics, int64_t width, int64_t height, raster::ProjectionSettings projection) {
    const Inputs in{{means, scales, quaternions, opacities, sh}, w2c, intrinsics, width, height, projection};
    std::unique_ptr<const SavedState> state;
    const RenderOutput outputs = backend_of(means).splat(in, state);
    save(ctx, in, std::move(state), {outputs.rgb, outputs.alpha, outputs.depth});
    return {outputs.rgb, outputs.alpha, outputs.depth};
  }

  static tensor_list backward(AutogradContext* ctx, tensor_list g) {
    const tensor_list t = ctx->get_saved_variables();
    const auto call = saved_call(ctx);
    return gradients_of(backend_of(t[0])
                            .splat_backward(saved_inputs(*call, t), {t[kInputTensors], t[kInputTensors + 1], t[kInputTensors + 2]},
                                            {contiguous(g[0]), contiguous(g[1]), contiguous(g[2])}, *call->state,
                                            {ctx->needs_input_grad(kW2c)}));
  }
};

struct ProjectFunction : torch::autograd::Function<ProjectFunction> {
  static tensor_list forward(AutogradContext* ctx, Tensor means, Tensor scales, Tensor quaternions, Tensor opacities, Tensor sh,
                             Tensor w2c, Tensor intrinsics, int64_t width, int64_t height, raster::ProjectionSettings projection) {
    const Inputs in{{means, scales, quaternions, opacities, sh}, w2c, intrinsics, width, height, projection};
    const Projected projected = backend_of(means).project(in);
    save(ctx, in, nullptr);
    ctx->mark_non_differentiable({projected.visible});
    return {projected.visible, projected.mean2d, projected.conic, projected.depth, projected.color};
  }

  static tensor_list backward(AutogradContext* ctx, tensor_list g) {
    const tensor_list t = ctx->get_saved_variables();
    return gradients_of(backend_of(t[0])
                            .project_backward(saved_inputs(*saved_call(ctx), t), {{}, contiguous(g[1]), contiguous(g[2]), contiguous(g[3]),
                                                                                  contiguous(g[4]), {}, {}},
                                              {ctx->needs_input_grad(kW2c)}));
  }
};

// Checks the arguments and runs `Function` on a device that has a backend. The caller owns the results, which are on the device of the
// means.
template <class Function>
void run(const SplatArguments& of, rust::Slice<size_t> out) {
  const Arguments a = borrowed(of);
  a.check();
  const at::Device home = a.means.device();
  const Inputs in = a.to_inputs(backend_device(a.means));
  const Gaussians& g = in.gaussians;
  const tensor_list results = Function::apply(g.means, g.scales, g.quaternions, g.opacities, g.sh, in.w2c, in.intrinsics,
                                              in.width, in.height, in.projection);
  for (size_t k = 0; k < out.size(); ++k) out[k] = owned(results[k].to(home));
}

}  // namespace

void splat(const SplatArguments& of, rust::Slice<size_t> out) { run<SplatFunction>(of, out); }

void project(const SplatArguments& of, rust::Slice<size_t> out) { run<ProjectFunction>(of, out); }

void sh_basis(const std::array<double, 3>& direction, rust::Slice<double> out) {
  double values[raster::kMaxBases];
  raster::sh_basis<double>(int(out.size()), direction.data(), values);
  std::copy_n(values, out.size(), out.data());
}

}  // namespace globalsplat
