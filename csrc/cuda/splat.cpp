// The GPU backend, and the measurement of its kernels with events around every launch, which is off unless a benchmark turns it on.

#include <ATen/ops/clone.h>
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

struct SavedFrame : SavedState {
  SavedFrame(const Device& device, const Inputs& in, const globalsplat::RenderOutput& out)
      : frame(device, arguments_of<float>(in), pictures_of<float>(out)) {}
  Frame frame;
};

std::unique_ptr<const SavedState> splat(const Inputs& in, const globalsplat::RenderOutput& out) {
  return std::make_unique<SavedFrame>(*kernel_device(in.gaussians.means), in, out);
}

void splat_backward(const Inputs& in, const globalsplat::RenderOutput& outputs, const globalsplat::RenderOutput& gradients,
                    const SavedState& saved, const Gradients& out) {
  static_cast<const SavedFrame&>(saved).frame.backward(*kernel_device(in.gaussians.means), arguments_of<float>(in),
                                                       pictures_of<const float>(outputs), pictures_of<const float>(gradients),
                                                       gradients_of<float>(out), data<float>(out.w2c));
}

Tensor project(const Inputs& in) {
  const ProjectedScenes projected(*kernel_device(in.gaussians.means), arguments_of<float>(in));
  return tensor_of(projected.splats.get(), {in.scenes(), in.cameras(), in.count(), 16}, in.gaussians.means.options()).clone();
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
