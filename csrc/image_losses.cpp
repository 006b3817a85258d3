#include "tensor_ops.h"

#include <ATen/ops/empty.h>
#include <ATen/ops/empty_like.h>
#include <ATen/ops/mul.h>
#include <ATen/ops/sum.h>
#include <torch/csrc/autograd/custom_function.h>

#include <type_traits>

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

// Return the jobs of the losses.
template <class T>
raster::PhotometricJob<T> photometric_job(const Tensor& picture, const Tensor& photo) {
  const int64_t height = picture.size(-2), width = picture.size(-1);
  return {picture.data_ptr<T>(), photo.data_ptr<T>(), picture.numel() / (height * width), int(width), int(height)};
}
template <class T>
raster::SmoothnessJob<T> smoothness_job(const Tensor& depths, const Tensor& photos) {
  const int64_t height = depths.size(-2), width = depths.size(-1);
  return {depths.data_ptr<T>(), photos.data_ptr<T>(), depths.numel() / (height * width), int(width), int(height)};
}

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

// Computes a loss of `first` on its device if that is supported, and on the CPU otherwise; `second` is constant. on_device(device, first,
// second, gradient) and on_cpu(first, second, gradient) compute it; `gradient` points to its elements or is null. Returns the address of
// the result, which is on the device of `first` and belongs to the caller.
template <class OnDevice, class OnCpu>
size_t loss_of(const Tensor& first, const Tensor& second, const OnDevice& on_device, const OnCpu& on_cpu) {
  const auto type = first.scalar_type() == at::kDouble ? at::kDouble : at::kFloat;
  const bool is_on_gpu = type == at::kFloat && first.is_cuda() && cuda::emulation() == nullptr;
  const at::Device place = is_on_gpu ? first.device() : at::Device(at::kCPU);
  const auto there = [&](const Tensor& t) { return t.to(place, type).contiguous(); };
  const Tensor other = there(second.detach());
  const auto compute = [&](const Tensor& input, const Tensor& gradient) {
    const auto data = [&](auto number) { return gradient.defined() ? gradient.data_ptr<decltype(number)>() : nullptr; };
    if (const auto device = cuda::kernel_device(input)) {
      const cuda::PartialSums parts = on_device(*device, input, other, data(0.f));
      return cuda::tensor_of(parts.numbers.get(), {parts.count}, input.options().dtype(at::kDouble)).sum().to(type);
    }
    const double value = type == at::kDouble ? on_cpu(input, other, data(0.)) : on_cpu(input, other, data(0.f));
    return at::empty({}, input.options()).fill_(value);
  };
  const bool differentiable = at::GradMode::is_enabled() && first.requires_grad();
  return owned(LossFunction::apply(there(first), compute, differentiable).to(first.device()));
}

}  // namespace

size_t photometric(size_t picture_address, size_t photo_address, double l1_weight, double ssim_weight) {
  const Tensor &picture = borrowed(picture_address), &photo = borrowed(photo_address);
  TORCH_CHECK(picture.sizes() == photo.sizes(), "the picture has shape ", picture.sizes(), " and the photo ", photo.sizes());
  TORCH_CHECK(picture.dim() >= 2 && picture.size(-1) >= raster::kWindow && picture.size(-2) >= raster::kWindow && picture.numel() > 0,
              "the picture has shape ", picture.sizes(), ", expected [.., H, W] with H and W of ", raster::kWindow, " or more");
  return loss_of(
      picture, photo,
      [&](const cuda::Device& device, const Tensor& a, const Tensor& b, float* gradient) {
        return cuda::photometric(device, photometric_job<float>(a, b), l1_weight, ssim_weight, gradient);
      },
      [&](const Tensor& a, const Tensor& b, auto* gradient) {
        using T = std::remove_pointer_t<decltype(gradient)>;
        return raster::photometric<T>(photometric_job<T>(a, b), l1_weight, ssim_weight, gradient, get_num_threads());
      });
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
      [&](const cuda::Device& device, const Tensor& a, const Tensor& b, float* gradient) {
        return cuda::depth_smoothness(device, smoothness_job<float>(a, b), factor, gradient);
      },
      [&](const Tensor& a, const Tensor& b, auto* gradient) {
        using T = std::remove_pointer_t<decltype(gradient)>;
        return raster::depth_smoothness<T>(smoothness_job<T>(a, b), factor, gradient, get_num_threads());
      });
}

}  // namespace globalsplat
