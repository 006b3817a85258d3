#include "splat.h"

#include <ATen/ops/empty.h>
#include <ATen/ops/empty_like.h>
#include <torch/csrc/autograd/custom_function.h>

#include <utility>

#include "backend.h"
#include "globalsplat-csrc/src/render.rs.h"
#include "runtime.h"

namespace globalsplat {
namespace {

constexpr int64_t kMaxSide = 1 << 20;              // pixels
constexpr int64_t kMaxCount = int64_t(1) << 31;    // Gaussians are indexed by 32 bits

void expect_shape(const char* name, const Tensor& t, std::vector<int64_t> expected) {
  TORCH_CHECK(t.sizes() == at::IntArrayRef(expected), name, " has shape ", t.sizes(), ", expected ",
              at::IntArrayRef(expected));
}

void check(const Inputs& in) {
  const auto& [means, scales, quaternions, opacities, sh] = in.gaussians;
  TORCH_CHECK(means.dim() == 3 && in.w2c.dim() == 4 && sh.dim() == 4,
              "means must be [B, N, 3], sh [B, N, bases, 3] and w2c [B, C, 4, 4]");
  const int64_t scenes = means.size(0), count = means.size(1), cameras = in.w2c.size(1), bases = sh.size(2);
  expect_shape("means", means, {scenes, count, 3});
  expect_shape("scales", scales, {scenes, count, 3});
  expect_shape("quaternions", quaternions, {scenes, count, 4});
  expect_shape("opacities", opacities, {scenes, count});
  expect_shape("sh", sh, {scenes, count, bases, 3});
  expect_shape("w2c", in.w2c, {scenes, cameras, 4, 4});
  expect_shape("intrinsics", in.intrinsics, {scenes, cameras, 3, 3});
  TORCH_CHECK(bases == 1 || bases == 4 || bases == 9 || bases == 16, "sh has ", bases,
              " basis functions, expected 1, 4, 9 or 16");
  TORCH_CHECK(in.width > 0 && in.height > 0 && in.width <= kMaxSide && in.height <= kMaxSide, "the image is ", in.width, "×",
              in.height, ", expected sides from 1 to ", kMaxSide);
  TORCH_CHECK(count < kMaxCount, "there are ", count, " Gaussians, expected fewer than ", kMaxCount);
  TORCH_CHECK(in.projection.eps2d >= 0, "eps2d is ", in.projection.eps2d, ", expected 0 or more");
  TORCH_CHECK(in.projection.near_plane >= 0, "near_plane is ", in.projection.near_plane, ", expected 0 or more");
  TORCH_CHECK(!in.projection.direct_colors || bases == 1, "colors have shape ", sh.sizes(), ", expected [B, N, 1, 3]");
}

}  // namespace

Inputs Inputs::to_backend() const {
  check(*this);
  const Tensor& means = gaussians.means;
  const at::DeviceType kind = backend_of(means).device;
  const at::Device device = kind == means.device().type() ? means.device() : at::Device(kind);
  const auto type = means.scalar_type() == at::kDouble ? at::kDouble : at::kFloat;
  const auto there = [&](const Tensor& t) { return t.to(device, type).contiguous(); };
  return {{there(means), there(gaussians.scales), there(gaussians.quaternions), there(gaussians.opacities), there(gaussians.sh)},
          there(w2c), there(intrinsics.detach()), width, height, projection};
}

const Backend& backend_of(const Tensor& means) {
  if (means.scalar_type() == at::kDouble) return cpu::backend;
  if (const Backend* emulated = cuda::emulated_backend()) return *emulated;
  return means.device().type() == cuda::backend.device ? cuda::backend : cpu::backend;
}

RenderOutput empty_output(const Inputs& in) {
  const auto options = in.gaussians.means.options();
  const Tensor alpha = at::empty({in.scenes(), in.cameras(), in.height, in.width}, options);
  return {at::empty({in.scenes(), in.cameras(), 3, in.height, in.width}, options), alpha, at::empty_like(alpha)};
}

RenderOutput render(const Inputs& in, std::unique_ptr<const SavedState>& saved) {
  const RenderOutput out = empty_output(in);
  saved = backend_of(in.gaussians.means).splat(in, out);
  return out;
}

Gradients render_backward(const Inputs& in, const RenderOutput& outputs, const RenderOutput& gradients, const SavedState& saved,
                          GradientRequest request) {
  const auto& [means, scales, quaternions, opacities, sh] = in.gaussians;
  Gradients out{{at::empty_like(means), at::empty_like(scales), at::empty_like(quaternions), at::empty_like(opacities), at::empty_like(sh)},
                {},
                {}};
  if (request.w2c) out.w2c = at::empty_like(in.w2c);
  if (request.means2d) out.means2d = at::empty({in.scenes(), in.cameras(), in.count(), 2}, means.options());
  backend_of(means).splat_backward(in, outputs, gradients, saved, out);
  return out;
}

namespace {

using torch::autograd::AutogradContext;
using torch::autograd::tensor_list;

// What autograd saves for a call besides tensors.
struct SavedCall : torch::CustomClassHolder {
  SavedCall(const Inputs& in, std::unique_ptr<const SavedState> s)
      : width(in.width), height(in.height), projection(in.projection), state(std::move(s)) {}
  int64_t width, height;
  raster::ProjectionSettings projection;
  std::unique_ptr<const SavedState> state;
};

struct SplatFunction : torch::autograd::Function<SplatFunction> {
  static constexpr size_t kW2c = 5, kArguments = 10;  // index of w2c among the arguments of forward(), and their number

  static tensor_list forward(AutogradContext* ctx, Tensor means, Tensor scales, Tensor quaternions, Tensor opacities, Tensor sh,
                             Tensor w2c, Tensor intrinsics, int64_t width, int64_t height, raster::ProjectionSettings projection) {
    const Inputs in{{means, scales, quaternions, opacities, sh}, w2c, intrinsics, width, height, projection};
    std::unique_ptr<const SavedState> state;
    const RenderOutput out = render(in, state);
    ctx->save_for_backward({means, scales, quaternions, opacities, sh, w2c, intrinsics, out.rgb, out.alpha, out.depth});
    ctx->saved_data["call"] = c10::IValue::make_capsule(c10::make_intrusive<SavedCall>(in, std::move(state)));
    return {out.rgb, out.alpha, out.depth};
  }

  static tensor_list backward(AutogradContext* ctx, tensor_list g) {
    const tensor_list t = ctx->get_saved_variables();
    const auto call = c10::static_intrusive_pointer_cast<SavedCall>(ctx->saved_data["call"].toCapsule());
    const Inputs in{{t[0], t[1], t[2], t[3], t[4]}, t[5], t[6], call->width, call->height, call->projection};
    const RenderOutput outputs{t[7], t[8], t[9]}, gradients{g[0].contiguous(), g[1].contiguous(), g[2].contiguous()};
    const Gradients of = render_backward(in, outputs, gradients, *call->state, {ctx->needs_input_grad(kW2c)});
    const Gaussians& d = of.gaussians;
    tensor_list all = {d.means, d.scales, d.quaternions, d.opacities, d.sh, of.w2c};
    all.resize(kArguments);  // intrinsics and settings have no gradients
    return all;
  }
};

}  // namespace

Inputs borrowed(const SplatArguments& of) {
  return {{borrowed(of.means), borrowed(of.scales), borrowed(of.quaternions), borrowed(of.opacities), borrowed(of.sh)},
          borrowed(of.w2c), borrowed(of.intrinsics), of.width, of.height, {of.eps2d, of.antialiased}};
}

rust::Vec<size_t> splat(const SplatArguments& of) {
  const Inputs given = borrowed(of);
  const Inputs in = given.to_backend();
  const Gaussians& g = in.gaussians;
  rust::Vec<size_t> out;
  for (const Tensor& t : SplatFunction::apply(g.means, g.scales, g.quaternions, g.opacities, g.sh, in.w2c, in.intrinsics, in.width, in.height,
                                              in.projection))
    out.push_back(owned(t.to(given.gaussians.means.device())));
  return out;
}

}  // namespace globalsplat
