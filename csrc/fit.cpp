#include "fit.h"

#include <ATen/ops/empty.h>
#include <ATen/ops/empty_like.h>
#include <ATen/ops/mul.h>
#include <torch/csrc/autograd/custom_function.h>

#include "globalsplat-csrc/src/fit.rs.h"
#include "raster/fit.h"
#include "raster/optim.h"
#include "threads.h"

namespace globalsplat {
namespace {

using at::Tensor;
using torch::autograd::AutogradContext;
using torch::autograd::tensor_list;

const Tensor& borrowed(size_t address) { return *reinterpret_cast<const Tensor*>(address); }

template <class Body>
auto by_type(const Tensor& t, Body body) {
  return t.scalar_type() == at::kDouble ? body(0.) : body(0.f);
}

// A scalar, whose gradient with respect to `of` is known already, if it is asked for.
Tensor with_gradient(AutogradContext* ctx, double value, const Tensor& gradient, const Tensor& of) {
  if (gradient.defined()) ctx->save_for_backward({gradient});
  return at::empty({}, of.options()).fill_(value);
}

Tensor of_argument(AutogradContext* ctx, const Tensor& g) {
  const Tensor gradient = ctx->get_saved_variables()[0];
  // Mostly the loss itself: nothing to multiply by.
  return g.item<double>() == 1 ? gradient : at::mul(gradient, g);
}

// Of two contiguous CPU tensors of one type.
struct PhotometricFunction : torch::autograd::Function<PhotometricFunction> {
  static Tensor forward(AutogradContext* ctx, Tensor picture, Tensor photo, double absolute, double similar, bool differentiable) {
    const Tensor gradient = differentiable ? at::empty_like(picture) : Tensor();
    const double value = by_type(picture, [&](auto number) {
      using T = decltype(number);
      const int64_t height = picture.size(-2), width = picture.size(-1);
      const raster::FitJob<T> job{picture.data_ptr<T>(), photo.data_ptr<T>(), picture.numel() / (height * width), int(width),
                                  int(height)};
      return raster::photometric<T>(job, absolute, similar, differentiable ? gradient.data_ptr<T>() : nullptr,
                                    threads());
    });
    return with_gradient(ctx, value, gradient, picture);
  }

  static tensor_list backward(AutogradContext* ctx, tensor_list g) {
    return {of_argument(ctx, g[0]), Tensor(), Tensor(), Tensor(), Tensor()};
  }
};

// The same.
struct SmoothnessFunction : torch::autograd::Function<SmoothnessFunction> {
  static Tensor forward(AutogradContext* ctx, Tensor depths, Tensor photos, double factor, bool differentiable) {
    const Tensor gradient = differentiable ? at::empty_like(depths) : Tensor();
    const double value = by_type(depths, [&](auto number) {
      using T = decltype(number);
      const int64_t height = depths.size(-2), width = depths.size(-1);
      const raster::DepthJob<T> job{depths.data_ptr<T>(), photos.data_ptr<T>(), depths.numel() / (height * width), int(width),
                                    int(height)};
      return raster::depth_smoothness<T>(job, factor, differentiable ? gradient.data_ptr<T>() : nullptr, threads());
    });
    return with_gradient(ctx, value, gradient, depths);
  }

  static tensor_list backward(AutogradContext* ctx, tensor_list g) {
    return {of_argument(ctx, g[0]), Tensor(), Tensor(), Tensor()};
  }
};

// Runs `Function` on the first argument's type on the CPU, the others being constants, and leaves its result, on the first's device,
// to the caller.
template <class Function, class... Numbers>
void run(const Tensor& first, const Tensor& second, rust::Slice<size_t> out, Numbers... numbers) {
  const auto type = first.scalar_type() == at::kDouble ? at::kDouble : at::kFloat;
  const auto here = [&](const Tensor& t) { return t.to(at::kCPU, type).contiguous(); };
  const bool differentiable = at::GradMode::is_enabled() && first.requires_grad();
  const Tensor value = Function::apply(here(first), here(second.detach()), numbers..., differentiable);
  out[0] = reinterpret_cast<size_t>(new Tensor(value.to(first.device())));
}

}  // namespace

void photometric(size_t picture_address, size_t photo_address, double absolute, double similar, rust::Slice<size_t> out) {
  const Tensor &picture = borrowed(picture_address), &photo = borrowed(photo_address);
  TORCH_CHECK(picture.sizes() == photo.sizes(), "the picture has shape ", picture.sizes(), " and the photo ", photo.sizes());
  TORCH_CHECK(picture.dim() >= 2 && picture.size(-1) >= raster::kWindow && picture.size(-2) >= raster::kWindow && picture.numel() > 0,
              "the picture has shape ", picture.sizes(), ", expected [.., H, W] with H and W of ", raster::kWindow, " or more");
  run<PhotometricFunction>(picture, photo, out, absolute, similar);
}

void depth_smoothness(size_t depths_address, size_t photos_address, double factor, rust::Slice<size_t> out) {
  const Tensor &depths = borrowed(depths_address), &photos = borrowed(photos_address);
  auto expected = depths.sizes().vec();
  TORCH_CHECK(depths.dim() >= 2 && depths.numel() > 0, "depths have shape ", depths.sizes(), ", expected [.., H, W]");
  expected.insert(expected.end() - 2, 3);
  TORCH_CHECK(photos.sizes() == at::IntArrayRef(expected), "photos have shape ", photos.sizes(), ", expected ",
              at::IntArrayRef(expected));
  run<SmoothnessFunction>(depths, photos, out, factor);
}

void adam(const AdamArguments& of) {
  const Tensor &value = borrowed(of.value), &gradient = borrowed(of.gradient);
  const Tensor &first = borrowed(of.first), &second = borrowed(of.second);
  for (const Tensor* t : {&value, &gradient, &first, &second})
    TORCH_CHECK(t->device().is_cpu() && t->is_contiguous() && t->sizes() == value.sizes() &&
                    t->scalar_type() == value.scalar_type() && (t->scalar_type() == at::kFloat || t->scalar_type() == at::kDouble),
                "a number, its gradient and its moments must be alike, on the CPU and contiguous");
  by_type(value, [&](auto number) {
    using T = decltype(number);
    const raster::AdamNumbers<T> numbers{value.data_ptr<T>(), gradient.data_ptr<T>(), first.data_ptr<T>(), second.data_ptr<T>()};
    raster::adam<T>({of.rate, of.root, of.decay, of.beta1, of.beta2, of.epsilon}, numbers, value.numel(), threads());
  });
}

}  // namespace globalsplat
