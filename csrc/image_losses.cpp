#include "tensor_ops.h"

#include <ATen/ops/empty.h>
#include <ATen/ops/empty_like.h>
#include <ATen/ops/mul.h>
#include <ATen/ops/sum.h>
#include <torch/csrc/autograd/custom_function.h>

#include "backend.h"
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

// Loss of a tensor, given by a function that computes its value, a scalar tensor, and writes its gradient to a tensor unless that is
// undefined. The gradient is computed in the forward pass.
struct LossFunction : torch::autograd::Function<LossFunction> {
  template <class Compute>
  static Tensor forward(AutogradContext* ctx, Tensor input, Compute compute, bool differentiable) {
    const Tensor gradient = differentiable ? at::empty_like(input) : Tensor();
    if (differentiable) ctx->save_for_backward({gradient});
    return compute(input, gradient);
  }

  static tensor_list backward(AutogradContext* ctx, tensor_list g) {
    const Tensor gradient = ctx->get_saved_variables()[0];
    // The incoming gradient is usually 1, because the loss itself is differentiated: skip the product. On a GPU this check would have to
    // wait.
    const bool is_one = g[0].is_cpu() && g[0].item<double>() == 1;
    return {is_one ? gradient : at::mul(gradient, g[0]), Tensor(), Tensor()};
  }
};

// Computes a loss of `images`, [.., H, W], on their device if that is supported, and on the CPU otherwise; `photos` are constant.
// on_device(device, job, gradient) and on_cpu(job, gradient) compute it; `gradient` points to its elements or is null. Returns the address of
// the result, which is on the device of `images` and belongs to the caller.
template <class OnDevice, class OnCpu>
size_t loss_of(const Tensor& images, const Tensor& photos, const OnDevice& on_device, const OnCpu& on_cpu) {
  const auto type = images.scalar_type() == at::kDouble ? at::kDouble : at::kFloat;
  const bool is_on_gpu = type == at::kFloat && images.is_cuda() && cuda::emulation() == nullptr;
  const at::Device place = is_on_gpu ? images.device() : at::Device(at::kCPU);
  const auto there = [&](const Tensor& t) { return t.to(place, type).contiguous(); };
  const Tensor other = there(photos.detach());
  const int64_t height = images.size(-2), width = images.size(-1), count = images.numel() / (height * width);
  const auto compute = [&](const Tensor& input, const Tensor& gradient) {
    const auto job = [&](auto number) {
      using T = decltype(number);
      return raster::LossJob<T>{data<T>(input), data<T>(other), count, int(width), int(height)};
    };
    if (const auto device = cuda::kernel_device(input)) {
      const cuda::PartialSums parts = on_device(*device, job(0.f), data<float>(gradient));
      return cuda::tensor_of(parts.numbers.get(), {parts.count}, input.options().dtype(at::kDouble)).sum().to(type);
    }
    const double value = type == at::kDouble ? on_cpu(job(0.), data<double>(gradient)) : on_cpu(job(0.f), data<float>(gradient));
    return at::empty({}, input.options()).fill_(value);
  };
  const bool differentiable = at::GradMode::is_enabled() && images.requires_grad();
  return owned(LossFunction::apply(there(images), compute, differentiable).to(images.device()));
}

}  // namespace

size_t photometric(size_t picture_address, size_t photo_address, double l1_weight, double ssim_weight) {
  const Tensor &picture = borrowed(picture_address), &photo = borrowed(photo_address);
  TORCH_CHECK(picture.sizes() == photo.sizes(), "the picture has shape ", picture.sizes(), " and the photo ", photo.sizes());
  TORCH_CHECK(picture.dim() >= 2 && picture.size(-1) >= raster::kWindow && picture.size(-2) >= raster::kWindow && picture.numel() > 0,
              "the picture has shape ", picture.sizes(), ", expected [.., H, W] with H and W of ", raster::kWindow, " or more");
  return loss_of(
      picture, photo,
      [&](const cuda::Device& device, const auto& job, float* gradient) {
        return cuda::photometric(device, job, l1_weight, ssim_weight, gradient);
      },
      [&](const auto& job, auto* gradient) { return raster::photometric(job, l1_weight, ssim_weight, gradient, get_num_threads()); });
}

size_t depth_smoothness(size_t depths_address, size_t photos_address, double factor) {
  const Tensor &depths = borrowed(depths_address), &photos = borrowed(photos_address);
  auto expected = depths.sizes().vec();
  TORCH_CHECK(depths.dim() >= 2 && depths.numel() > 0, "depths have shape ", depths.sizes(), ", expected [.., H, W]");
  expected.insert(expected.end() - 2, 3);
  TORCH_CHECK(photos.sizes() == at::IntArrayRef(expected), "photos have shape ", photos.sizes(), ", expected ",
              at::IntArrayRef(expected));
  return loss_of(
      depths, photos,
      [&](const cuda::Device& device, const auto& job, float* gradient) { return cuda::depth_smoothness(device, job, factor, gradient); },
      [&](const auto& job, auto* gradient) { return raster::depth_smoothness(job, factor, gradient, get_num_threads()); });
}

}  // namespace globalsplat
