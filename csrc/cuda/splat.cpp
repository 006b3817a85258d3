// The GPU backend, and the measurement of its kernels with events around every launch, which is off unless a benchmark turns it on.

#include <ATen/TensorOperators.h>
#include <ATen/ops/cat.h>
#include <ATen/ops/cumsum.h>
#include <ATen/ops/empty.h>
#include <ATen/ops/empty_like.h>
#include <ATen/ops/stack.h>
#include <ATen/ops/where.h>
#include <ATen/ops/zeros.h>
#include <ATen/ops/zeros_like.h>
#include <c10/core/Event.h>

#include <algorithm>
#include <atomic>
#include <mutex>
#include <vector>

#include "../backend.h"
#include "../splat.h"
#include "frame.h"
#include "globalsplat-csrc/src/render.rs.h"
#include "torch_device.h"

namespace globalsplat::cuda {
namespace {

template <class T>
T* data(const Tensor& t) {
  return t.data_ptr<std::remove_const_t<T>>();
}

Arguments arguments_of(const Inputs& in) {
  const globalsplat::Gaussians& g = in.gaussians;
  return {{data<float>(g.means), data<float>(g.scales), data<float>(g.quaternions), data<float>(g.opacities),
           data<float>(g.sh), in.count(), int(g.sh.size(2))},
          data<float>(in.w2c), data<float>(in.intrinsics), in.scenes(), in.cameras(), int(in.width), int(in.height),
          in.projection};
}

template <class Number>
RenderOutput<Number> places_of(const globalsplat::RenderOutput& p) {
  return {data<Number>(p.rgb), data<Number>(p.alpha), data<Number>(p.depth)};
}

// Returns uninitialized gradients.
Gradients empty_gradients(const Inputs& in, GradientRequest request) {
  const auto empty = [](const Tensor& t) { return at::empty_like(t); };
  const globalsplat::Gaussians& g = in.gaussians;
  return {{empty(g.means), empty(g.scales), empty(g.quaternions), empty(g.opacities), empty(g.sh)},
          request.w2c ? empty(in.w2c) : Tensor(),
          request.means2d ? at::empty({in.scenes(), in.cameras(), in.count(), 2}, g.means.options()) : Tensor()};
}

GaussianGradients<float> places_of(const Gradients& of) {
  const globalsplat::Gaussians& g = of.gaussians;
  return {data<float>(g.means), data<float>(g.scales), data<float>(g.quaternions), data<float>(g.opacities),
          data<float>(g.sh), of.means2d.defined() ? data<float>(of.means2d) : nullptr};
}

float* place_of_cameras(const Gradients& g) { return g.w2c.defined() ? data<float>(g.w2c) : nullptr; }

struct SavedFrame : SavedState {
  SavedFrame(const Device& device, const Arguments& of, const RenderOutput<float>& out) : frame(device, of, out) {}
  Frame frame;
};

globalsplat::RenderOutput splat(const Inputs& in, std::unique_ptr<const SavedState>& saved) {
  const auto device = kernel_device(in.gaussians.means);
  const auto options = in.gaussians.means.options();
  const Tensor rgb = at::empty({in.scenes(), in.cameras(), 3, in.height, in.width}, options);
  const Tensor alpha = at::empty({in.scenes(), in.cameras(), in.height, in.width}, options);
  const globalsplat::RenderOutput out{rgb, alpha, at::empty_like(alpha)};
  saved = std::make_unique<SavedFrame>(*device, arguments_of(in), places_of<float>(out));
  return out;
}

Gradients splat_backward(const Inputs& in, const globalsplat::RenderOutput& outputs, const globalsplat::RenderOutput& gradients,
                         const SavedState& saved, GradientRequest request) {
  const auto device = kernel_device(in.gaussians.means);
  const Gradients out = empty_gradients(in, request);
  static_cast<const SavedFrame&>(saved).frame.backward(*device, arguments_of(in), places_of<const float>(outputs),
                                                     places_of<const float>(gradients), places_of(out),
                                                     place_of_cameras(out));
  return out;
}

// Returns the fields of the splats in Splat's order, each [B, C, N]. They are valid as long as `projected`.
std::vector<Tensor> numbers_of(const ProjectedScenes& projected, const Inputs& in) {
  return tensor_of(projected.splats.get(), {in.scenes(), in.cameras(), in.count(), 16}, in.gaussians.means.options()).unbind(-1);
}
constexpr size_t kU = 0, kV = 1, kA = 2, kB = 3, kC = 4, kLog2Opacity = 5, kRed = 6, kZ = 9;  // indices of fields
constexpr double kTwoLn2 = 2 / raster::kLog2E;

// Σ2D⁻¹ = 2 ln 2·UᵀU with U = [[a, b], [0, c]].
Projected project(const Inputs& in) {
  const auto device = kernel_device(in.gaussians.means);
  const ProjectedScenes projected(*device, arguments_of(in));
  const std::vector<Tensor> s = numbers_of(projected, in);
  const Tensor &a = s[kA], &b = s[kB], &c = s[kC], visible = s[kZ] > 0;
  const auto shown = [&](const Tensor& t) { return at::where(t.dim() > visible.dim() ? visible.unsqueeze(-1) : visible, t, 0); };
  return {visible.to(at::kLong), shown(at::stack({s[kU], s[kV]}, -1)),
          shown(kTwoLn2 * at::stack({a * a, a * b, b * b + c * c}, -1)), shown(s[kZ]),
          shown(at::stack({s[kRed], s[kRed + 1], s[kRed + 2]}, -1)), shown(s[kLog2Opacity].exp2()),
          shown(at::stack({(1 + (b / c).square()) / (kTwoLn2 * a * a), 1 / (kTwoLn2 * c * c)}, -1))};
}

// Creates one record per visible Gaussian, with the sums over pixels that are converted to exactly these gradients: ∂L/∂(u, v) = 2 ln
// 2·UᵀM, and W = 2UNUᵀ for N = ∂L/∂(Σ2D⁻¹), where the single value xy stands for two entries.
Gradients project_backward(const Inputs& in, const Projected& gradients, GradientRequest request) {
  const auto device = kernel_device(in.gaussians.means);
  const ProjectedScenes projected(*device, arguments_of(in));
  const std::vector<Tensor> s = numbers_of(projected, in);
  const Tensor &a = s[kA], &b = s[kB], &c = s[kC];
  const std::vector<Tensor> d_mean = gradients.mean2d.unbind(-1), d_conic = gradients.conic.unbind(-1);
  const std::vector<Tensor> d_color = gradients.color.unbind(-1);
  const Tensor p = d_mean[0] / (kTwoLn2 * a), r = (d_mean[1] - kTwoLn2 * b * p) / (kTwoLn2 * c);
  const Tensor all = at::stack({at::zeros_like(p), p, r, 2 * (a * a * d_conic[0] + a * b * d_conic[1] + b * b * d_conic[2]),
                                a * c * d_conic[1] + 2 * b * c * d_conic[2], 2 * c * c * d_conic[2], d_color[0], d_color[1],
                                d_color[2], gradients.depth},
                               -1);
  const Tensor visible = (s[kZ] > 0).flatten();
  const Tensor records = all.flatten(0, 2).index_select(0, visible.nonzero().squeeze(1)).contiguous();
  const Tensor first = at::cat({at::zeros({1}, visible.options().dtype(at::kInt)), visible.cumsum(0, at::kInt)});
  const Gradients out = empty_gradients(in, request);
  projected.backward(*device, arguments_of(in), reinterpret_cast<const SplatGradient<float>*>(data<float>(records)),
                reinterpret_cast<const uint32_t*>(data<int32_t>(first)), places_of(out), place_of_cameras(out));
  return out;
}

struct Launched {
  const char* kernel;
  c10::Event begin, end;
};

// Not thread-local, because the backward pass launches from one of autograd's threads.
std::atomic<bool> measuring{false};
std::mutex guard;
std::vector<Launched> launched;

constexpr Backend backend_on(at::DeviceType device) { return {device, splat, splat_backward, project, project_backward}; }

}  // namespace

void measured_launch(const char* kernel, const c10::Stream& stream, const std::function<void()>& launch) {
  if (!measuring) return launch();
  const auto event = [&] { return c10::Event(stream.device_type(), c10::EventFlag::BACKEND_DEFAULT); };
  Launched one{kernel, event(), event()};
  one.begin.record(stream);
  launch();
  one.end.record(stream);
  const std::lock_guard<std::mutex> lock(guard);
  launched.push_back(std::move(one));
}

const Backend backend = backend_on(at::kCUDA);

const Backend* emulated_backend() {
  static const Backend emulated = backend_on(at::kCPU);
  return emulation() != nullptr ? &emulated : nullptr;
}

}  // namespace globalsplat::cuda

namespace globalsplat {

void measure_kernels(bool on) {
  const std::lock_guard<std::mutex> lock(cuda::guard);
  cuda::launched.clear();
  cuda::measuring = on;
}

rust::Vec<KernelTime> kernel_times() {
  const std::lock_guard<std::mutex> lock(cuda::guard);
  rust::Vec<KernelTime> times;
  for (const cuda::Launched& one : cuda::launched) {
    one.end.synchronize();
    const auto same = [&](const KernelTime& time) { return time.kernel == one.kernel; };
    auto known = std::find_if(times.begin(), times.end(), same);
    if (known == times.end()) {
      times.push_back({one.kernel, 0});
      known = times.end() - 1;
    }
    known->milliseconds += one.begin.elapsedTime(one.end);
  }
  return times;
}

}  // namespace globalsplat
