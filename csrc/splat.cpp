#include "splat.h"

#include <torch/torch.h>

#include <algorithm>
#include <memory>
#include <string>
#include <vector>

#include "raster/kernels.h"
#include "raster/raster.h"
#include "raster/sh.h"

namespace globalsplat {
namespace {

using torch::Tensor;
using torch::autograd::AutogradContext;
using torch::autograd::tensor_list;

constexpr int kGaussianInputs = 5;  // means, scales, quaternions, opacities, sh

template <class T>
std::vector<raster::Gaussians<T>> scenes_of(const tensor_list& t) {
  std::vector<raster::Gaussians<T>> scenes;
  const int64_t count = t[0].size(1), bases = t[4].size(2);
  for (int64_t b = 0; b < t[0].size(0); ++b)
    scenes.push_back({t[0].data_ptr<T>() + b * count * 3, t[1].data_ptr<T>() + b * count * 3,
                      t[2].data_ptr<T>() + b * count * 4, t[3].data_ptr<T>() + b * count,
                      t[4].data_ptr<T>() + b * count * bases * 3, count, int(bases)});
  return scenes;
}

template <class T>
std::vector<raster::GaussianGradients<T>> gradients_of(const tensor_list& t) {
  std::vector<raster::GaussianGradients<T>> scenes;
  const int64_t count = t[0].size(1), bases = t[4].size(2);
  for (int64_t b = 0; b < t[0].size(0); ++b)
    scenes.push_back({t[0].data_ptr<T>() + b * count * 3, t[1].data_ptr<T>() + b * count * 3,
                      t[2].data_ptr<T>() + b * count * 4, t[3].data_ptr<T>() + b * count,
                      t[4].data_ptr<T>() + b * count * bases * 3});
  return scenes;
}

template <class T>
std::vector<raster::View<T>> views_of(const Tensor& w2c, const Tensor& intrinsics) {
  std::vector<raster::View<T>> views;
  const int64_t scenes = w2c.size(0), cameras = w2c.size(1);
  for (int64_t b = 0; b < scenes; ++b)
    for (int64_t c = 0; c < cameras; ++c) {
      const T* m = w2c.data_ptr<T>() + (b * cameras + c) * 16;
      const T* k = intrinsics.data_ptr<T>() + (b * cameras + c) * 9;
      views.push_back({{{m[0], m[1], m[2], m[4], m[5], m[6], m[8], m[9], m[10]},
                        {m[3], m[7], m[11]},
                        k[0], k[4], k[2], k[5]},
                       int(b)});
    }
  return views;
}

// rgb [B, C, 3, H, W], alpha and depth [B, C, H, W] as one item per view.
template <class Pixel>
std::vector<raster::Pictures<Pixel>> pictures_of(const Tensor& rgb, const Tensor& alpha, const Tensor& depth) {
  using T = std::remove_const_t<Pixel>;
  std::vector<raster::Pictures<Pixel>> pictures;
  const int64_t views = rgb.size(0) * rgb.size(1), pixels = rgb.size(3) * rgb.size(4);
  for (int64_t k = 0; k < views; ++k)
    pictures.push_back({rgb.data_ptr<T>() + k * 3 * pixels, alpha.data_ptr<T>() + k * pixels,
                        depth.data_ptr<T>() + k * pixels});
  return pictures;
}

// Keeps a raster::Frame alive between forward and backward.
template <class T>
struct FrameHolder : torch::CustomClassHolder {
  explicit FrameHolder(std::unique_ptr<raster::Frame<T>> f) : frame(std::move(f)) {}
  std::unique_ptr<raster::Frame<T>> frame;
};

template <class T>
struct SplatFunction : torch::autograd::Function<SplatFunction<T>> {
  // All tensors on the CPU, contiguous, of element type T.
  static tensor_list forward(AutogradContext* ctx, Tensor means, Tensor scales, Tensor quaternions, Tensor opacities,
                             Tensor sh, Tensor w2c, Tensor intrinsics, int64_t width, int64_t height, double eps2d) {
    const auto options = means.options();
    const int64_t scenes = w2c.size(0), cameras = w2c.size(1);
    Tensor rgb = torch::empty({scenes, cameras, 3, height, width}, options);
    Tensor alpha = torch::empty({scenes, cameras, height, width}, options), depth = torch::empty_like(alpha);
    const raster::Settings settings{int(width), int(height), eps2d, torch::get_num_threads()};
    auto frame = raster::Frame<T>::draw(scenes_of<T>({means, scales, quaternions, opacities, sh}),
                                        views_of<T>(w2c, intrinsics), settings, pictures_of<T>(rgb, alpha, depth));
    ctx->save_for_backward({means, scales, quaternions, opacities, sh, rgb, alpha, depth});
    ctx->saved_data["frame"] =
        c10::IValue::make_capsule(c10::make_intrusive<FrameHolder<T>>(std::move(frame)));
    return {rgb, alpha, depth};
  }

  static tensor_list backward(AutogradContext* ctx, tensor_list gradients) {
    const tensor_list saved = ctx->get_saved_variables();
    const tensor_list gaussians(saved.begin(), saved.begin() + kGaussianInputs);
    const auto holder = c10::static_intrusive_pointer_cast<FrameHolder<T>>(ctx->saved_data["frame"].toCapsule());
    tensor_list out;
    for (const Tensor& t : gaussians) out.push_back(torch::empty_like(t));
    for (Tensor& g : gradients) g = g.contiguous();
    holder->frame->backward(scenes_of<T>(gaussians), pictures_of<const T>(saved[5], saved[6], saved[7]),
                            pictures_of<const T>(gradients[0], gradients[1], gradients[2]), gradients_of<T>(out));
    out.resize(10);  // no gradient for cameras and numbers
    return out;
  }
};

void expect_shape(const char* name, const Tensor& t, std::vector<int64_t> expected) {
  TORCH_CHECK(t.sizes() == torch::IntArrayRef(expected), "splat: ", name, " has shape ", t.sizes(), ", expected ",
              torch::IntArrayRef(expected));
}

const Tensor& borrowed(size_t pointer) { return *reinterpret_cast<const Tensor*>(pointer); }

}  // namespace

void splat(size_t means_, size_t scales_, size_t quaternions_, size_t opacities_, size_t sh_, size_t w2c_,
           size_t intrinsics_, int32_t width, int32_t height, double eps2d, rust::Slice<size_t> out) {
  const Tensor &means = borrowed(means_), &scales = borrowed(scales_), &quaternions = borrowed(quaternions_);
  const Tensor &opacities = borrowed(opacities_), &sh = borrowed(sh_);
  const Tensor &w2c = borrowed(w2c_), &intrinsics = borrowed(intrinsics_);

  TORCH_CHECK(means.dim() == 3 && w2c.dim() == 4 && sh.dim() == 4,
              "splat: means must be [B, N, 3], sh [B, N, bases, 3] and w2c [B, C, 4, 4]");
  const int64_t scenes = means.size(0), count = means.size(1), cameras = w2c.size(1), bases = sh.size(2);
  expect_shape("means", means, {scenes, count, 3});
  expect_shape("scales", scales, {scenes, count, 3});
  expect_shape("quaternions", quaternions, {scenes, count, 4});
  expect_shape("opacities", opacities, {scenes, count});
  expect_shape("sh", sh, {scenes, count, bases, 3});
  expect_shape("w2c", w2c, {scenes, cameras, 4, 4});
  expect_shape("intrinsics", intrinsics, {scenes, cameras, 3, 3});
  TORCH_CHECK(bases == 1 || bases == 4 || bases == 9 || bases == 16, "splat: sh has ", bases,
              " basis functions, expected 1, 4, 9 or 16");
  TORCH_CHECK(width > 0 && height > 0 && width <= 1 << 20 && height <= 1 << 20, "splat: an image of ", width, "×", height);
  TORCH_CHECK(count < int64_t(1) << 31, "splat: ", count, " Gaussians, at most 2³¹ − 1 fit");
  TORCH_CHECK(eps2d >= 0, "splat: eps2d is ", eps2d, ", expected 0 or more");

  // Moving and converting are differentiable, so gradients go back to the caller's device and type.
  const auto type = means.scalar_type() == torch::kDouble ? torch::kDouble : torch::kFloat;
  const auto host = [&](const Tensor& t) { return t.to(torch::kCPU, type).contiguous(); };
  const auto apply = [&](auto function) {
    return decltype(function)::apply(host(means), host(scales), host(quaternions), host(opacities), host(sh),
                                     host(w2c.detach()), host(intrinsics.detach()), int64_t(width), int64_t(height),
                                     eps2d);
  };
  const tensor_list pictures =
      type == torch::kDouble ? apply(SplatFunction<double>{}) : apply(SplatFunction<float>{});
  for (size_t k = 0; k < 3; ++k) out[k] = reinterpret_cast<size_t>(new Tensor(pictures[k].to(means.device())));
}

void sh_basis(const std::array<double, 3>& direction, rust::Slice<double> out) {
  double values[raster::kMaxBases];
  raster::sh_basis(int(out.size()), direction.data(), values);
  std::copy_n(values, out.size(), out.data());
}

rust::String libtorch_version() { return TORCH_VERSION; }

rust::String simd_level() { return raster::kernels().name; }

}  // namespace globalsplat
