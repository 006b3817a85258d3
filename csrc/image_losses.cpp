#include "tensor_ops.h"

#include <ATen/ops/empty.h>
#include <ATen/ops/empty_like.h>
#include <ATen/ops/mul.h>
#include <ATen/ops/sum.h>
#include <torch/csrc/autograd/custom_function.h>

#include "cuda/frame.h"
#include "cuda/torch_device.h"
#include "globalsplat-csrc/src/tensor_ops.rs.h"
#include "kernels/jobs.h"
#include "runtime.h"

namespace globalsplat {
namespace {

using at::Tensor;
using torch::autograd::AutogradContext;
using torch::autograd::tensor_list;

template <class Body>
auto dispatch_by_type(const Tensor& t, Body body) {
  return t.scalar_type() == at::kDouble ? body(0.) : body(0.f);
}

// Returns a scalar loss, and saves the gradient of its argument, if requested; it has already been computed.
Tensor save_gradient(AutogradContext* ctx, const Tensor& value, const Tensor& gradient) {
  if (gradient.defined()) ctx->save_for_backward({gradient});
  return value;
}

Tensor input_gradient(AutogradContext* ctx, const Tensor& g) {
  const Tensor gradient = ctx->get_saved_variables()[0];
  // The incoming gradient is usually 1, because the loss itself is differentiated: skip the product. On a GPU this check would have to
  // wait.
  return g.is_cpu() && g.item<double>() == 1 ? gradient : at::mul(gradient, g);
}

template <class T>
T* data_or_null(const Tensor& t) {
  return t.defined() ? t.data_ptr<T>() : nullptr;
}

Tensor scalar(double value, const Tensor& like) { return at::empty({}, like.options()).fill_(value); }

Tensor sum_of(const cuda::PartialSums& parts, const Tensor& like) {
  return cuda::tensor_of(parts.numbers.get(), {parts.count}, like.options().dtype(at::kDouble)).sum().to(like.scalar_type());
}

// Photometric loss of two contiguous tensors of one type and device: the CPU, or a GPU that our kernels support.
struct PhotometricFunction : torch::autograd::Function<PhotometricFunction> {
  template <class T>
  static raster::PhotometricJob<T> job_of(const Tensor& picture, const Tensor& photo) {
    const int64_t height = picture.size(-2), width = picture.size(-1);
    return {picture.data_ptr<T>(), photo.data_ptr<T>(), picture.numel() / (height * width), int(width), int(height)};
  }

  static Tensor forward(AutogradContext* ctx, Tensor picture, Tensor photo, double l1_weight, double ssim_weight, bool differentiable) {
    const Tensor gradient = differentiable ? at::empty_like(picture) : Tensor();
    if (const auto device = cuda::kernel_device(picture)) {
      const cuda::PartialSums parts =
          cuda::photometric(*device, job_of<float>(picture, photo), l1_weight, ssim_weight, data_or_null<float>(gradient));
      return save_gradient(ctx, sum_of(parts, picture), gradient);
    }
    const double value = dispatch_by_type(picture, [&](auto number) {
      using T = decltype(number);
      return raster::photometric<T>(job_of<T>(picture, photo), l1_weight, ssim_weight, data_or_null<T>(gradient), get_num_threads());
    });
    return save_gradient(ctx, scalar(value, picture), gradient);
  }

  static tensor_list backward(AutogradContext* ctx, tensor_list g) {
    return {input_gradient(ctx, g[0]), Tensor(), Tensor(), Tensor(), Tensor()};
  }
};

// Depth smoothness of contiguous tensors of one type and device: the CPU, or a GPU that our kernels support.
struct SmoothnessFunction : torch::autograd::Function<SmoothnessFunction> {
  template <class T>
  static raster::SmoothnessJob<T> job_of(const Tensor& depths, const Tensor& photos) {
    const int64_t height = depths.size(-2), width = depths.size(-1);
    return {depths.data_ptr<T>(), photos.data_ptr<T>(), depths.numel() / (height * width), int(width), int(height)};
  }

  static Tensor forward(AutogradContext* ctx, Tensor depths, Tensor photos, double factor, bool differentiable) {
    const Tensor gradient = differentiable ? at::empty_like(depths) : Tensor();
    if (const auto device = cuda::kernel_device(depths)) {
      const cuda::PartialSums parts =
          cuda::depth_smoothness(*device, job_of<float>(depths, photos), factor, data_or_null<float>(gradient));
      return save_gradient(ctx, sum_of(parts, depths), gradient);
    }
    const double value = dispatch_by_type(depths, [&](auto number) {
      using T = decltype(number);
      return raster::depth_smoothness<T>(job_of<T>(depths, photos), factor, data_or_null<T>(gradient), get_num_threads());
    });
    return save_gradient(ctx, scalar(value, depths), gradient);
  }

  static tensor_list backward(AutogradContext* ctx, tensor_list g) {
    return {input_gradient(ctx, g[0]), Tensor(), Tensor(), Tensor()};
  }
};

// Runs `Function` on the device of the first argument if it is supported, and on the CPU otherwise; the second argument is constant. The
// caller owns the result, which is on the device of the first argument.
template <class Function, class... Numbers>
void run(const Tensor& first, const Tensor& second, rust::Slice<size_t> out, Numbers... numbers) {
  const auto type = first.scalar_type() == at::kDouble ? at::kDouble : at::kFloat;
  const bool is_on_gpu = type == at::kFloat && first.is_cuda() && cuda::emulation() == nullptr;
  const at::Device device = is_on_gpu ? first.device() : at::Device(at::kCPU);
  const auto there = [&](const Tensor& t) { return t.to(device, type).contiguous(); };
  const bool differentiable = at::GradMode::is_enabled() && first.requires_grad();
  const Tensor value = Function::apply(there(first), there(second.detach()), numbers..., differentiable);
  out[0] = owned(value.to(first.device()));
}

}  // namespace

void photometric(size_t picture_address, size_t photo_address, double l1_weight, double ssim_weight, rust::Slice<size_t> out) {
  const Tensor &picture = borrowed(picture_address), &photo = borrowed(photo_address);
  TORCH_CHECK(picture.sizes() == photo.sizes(), "the picture has shape ", picture.sizes(), " and the photo ", photo.sizes());
  TORCH_CHECK(picture.dim() >= 2 && picture.size(-1) >= raster::kWindow && picture.size(-2) >= raster::kWindow && picture.numel() > 0,
              "the picture has shape ", picture.sizes(), ", expected [.., H, W] with H and W of ", raster::kWindow, " or more");
  run<PhotometricFunction>(picture, photo, out, l1_weight, ssim_weight);
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

}  // namespace globalsplat
