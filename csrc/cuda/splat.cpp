// The GPU backend, and the measurement of its kernels with events around every launch, which is off unless a benchmark turns it on.

#include <ATen/TensorOperators.h>
#include <ATen/ops/empty.h>
#include <ATen/ops/empty_like.h>
#include <ATen/ops/stack.h>
#include <ATen/ops/where.h>
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

// Σ2D⁻¹ = 2 ln 2·UᵀU with U = [[a, b], [0, c]].
Projected project(const Inputs& in) {
  constexpr double kTwoLn2 = 2 / raster::kLog2E;
  const auto device = kernel_device(in.gaussians.means);
  const ProjectedScenes projected(*device, arguments_of(in));
  // The fields of the splats in Splat's order, each [B, C, N].
  const std::vector<Tensor> s =
      tensor_of(projected.splats.get(), {in.scenes(), in.cameras(), in.count(), 16}, in.gaussians.means.options()).unbind(-1);
  const Tensor &u = s[0], &v = s[1], &a = s[2], &b = s[3], &c = s[4], &log2_opacity = s[5], &z = s[9], visible = z > 0;
  const auto shown = [&](const Tensor& t) { return at::where(t.dim() > visible.dim() ? visible.unsqueeze(-1) : visible, t, 0); };
  return {shown(at::stack({u, v}, -1)),
          shown(kTwoLn2 * at::stack({a * a, a * b, b * b + c * c}, -1)),
          shown(z),
          shown(log2_opacity.exp2()),
          shown(at::stack({(1 + (b / c).square()) / (kTwoLn2 * a * a), 1 / (kTwoLn2 * c * c)}, -1)),
          visible.to(at::kLong)};
}

struct MeasuredLaunch {
  const char* kernel;
  c10::Event begin, end;
};

// Not thread-local, because the backward pass launches from one of autograd's threads.
std::atomic<bool> measuring{false};
std::mutex launches_mutex;
std::vector<MeasuredLaunch> launches;

constexpr Backend backend_on(at::DeviceType device) { return {device, splat, splat_backward, project}; }

}  // namespace

void measured_launch(const char* kernel, const c10::Stream& stream, const std::function<void()>& launch) {
  if (!measuring) return launch();
  const auto event = [&] { return c10::Event(stream.device_type(), c10::EventFlag::BACKEND_DEFAULT); };
  MeasuredLaunch measured{kernel, event(), event()};
  measured.begin.record(stream);
  launch();
  measured.end.record(stream);
  const std::lock_guard<std::mutex> lock(launches_mutex);
  launches.push_back(std::move(measured));
}

const Backend backend = backend_on(at::kCUDA);

const Backend* emulated_backend() {
  static const Backend emulated = backend_on(at::kCPU);
  return emulation() != nullptr ? &emulated : nullptr;
}

}  // namespace globalsplat::cuda

namespace globalsplat {

void measure_kernels(bool on) {
  const std::lock_guard<std::mutex> lock(cuda::launches_mutex);
  cuda::launches.clear();
  cuda::measuring = on;
}

rust::Vec<KernelTime> kernel_times() {
  const std::lock_guard<std::mutex> lock(cuda::launches_mutex);
  rust::Vec<KernelTime> times;
  for (const cuda::MeasuredLaunch& launch : cuda::launches) {
    launch.end.synchronize();
    auto time = std::find_if(times.begin(), times.end(), [&](const KernelTime& t) { return t.kernel == launch.kernel; });
    if (time == times.end()) {
      times.push_back(KernelTime{launch.kernel, 0});
      time = times.end() - 1;
    }
    time->milliseconds += launch.begin.elapsedTime(launch.end);
  }
  return times;
}

}  // namespace globalsplat
