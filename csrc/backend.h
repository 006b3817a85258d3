// Inputs of the splat ops, and the interface of a backend, which implements them for one kind of device. splat.cpp does what is common to
// all backends: it checks the inputs, moves them, and integrates the op with autograd.
#pragma once

#include <ATen/core/Tensor.h>

#include <memory>
#include <type_traits>

#include "kernels/types.h"

namespace globalsplat {

using at::Tensor;

// Gaussians of all scenes, or their gradients: means [B, N, 3], scales [B, N, 3], quaternions [B, N, 4], opacities [B, N], and sh [B, N,
// bases, 3].
struct Gaussians {
  Tensor means, scales, quaternions, opacities, sh;
};

// Gaussians and cameras of one call. A backend takes tensors on its device that are contiguous, and all float32 or all float64.
struct Inputs {
  Gaussians gaussians;
  Tensor w2c, intrinsics;  // [B, C, 4, 4], [B, C, 3, 3] in pixels
  int64_t width, height;   // pixels
  raster::ProjectionSettings projection;

  // Checks the inputs, and returns them as the backend for their device takes them: float64 if the means are, and float32 otherwise. Moving
  // and converting are differentiable, so gradients return to the caller's device and type. Intrinsics get no gradient. Throws if shapes or
  // values are invalid.
  Inputs to_backend() const;

  int64_t scenes() const { return w2c.size(0); }
  int64_t cameras() const { return w2c.size(1); }  // per scene
  int64_t count() const { return gaussians.means.size(1); }  // Gaussians per scene
};

// Gradients that a backward pass computes besides those of the Gaussians.
struct GradientRequest {
  bool w2c = false, means2d = false;
};

// Results of a backward pass. What isn't requested is undefined.
struct Gradients {
  Gaussians gaussians;
  Tensor w2c;      // [B, C, 4, 4] with last rows 0
  Tensor means2d;  // [B, C, N, 2], of the projected means in pixels
};

// Outputs of splat(), or their gradients: [B, C, 3, H, W], [B, C, H, W], [B, C, H, W].
struct RenderOutput {
  Tensor rgb, alpha, depth;
};

struct SplatArguments;  // shared with Rust, see src/render.rs

// Returns the arguments of a call from Rust.
Inputs borrowed(const SplatArguments& of);

// State other than tensors that a backend's splat() passes to its splat_backward().
struct SavedState {
  virtual ~SavedState() = default;
};

// Functions of a backend. Results have the device and the type of the inputs, and splat() and splat_backward() write them to allocated tensors.
// Incoming gradients are contiguous. splat_backward() computes those gradients whose tensors are defined. project(), the first step of splat()
// by itself, returns the projected Gaussians, [B, C, N, 16], with the fields of raster::Splat in their order.
struct Backend {
  at::DeviceType device;
  std::unique_ptr<const SavedState> (*splat)(const Inputs&, const RenderOutput& out);
  void (*splat_backward)(const Inputs&, const RenderOutput& outputs, const RenderOutput& gradients, const SavedState&, const Gradients& out);
  Tensor (*project)(const Inputs&);
};

namespace cpu {
extern const Backend backend;
}
namespace cuda {
extern const Backend backend;  // for tensors on CUDA devices
// Returns the backend that emulates a GPU for tensors on the CPU if the variable GLOBALSPLAT_CUDA_ON_CPU is set, and null otherwise. Its
// value is a number that seeds the order of blocks and threads.
const Backend* emulated_backend();
}  // namespace cuda

// Returns the backend for tensors of this device and type. The CPU backend also serves devices without a backend of their own, and float64,
// which exists to verify gradients.
const Backend& backend_of(const Tensor& means);

// Returns uninitialized outputs of the inputs' device and type.
RenderOutput empty_output(const Inputs&);

// Render the inputs with their backend, and compute the gradients of all five Gaussian tensors and those that are requested.
RenderOutput render(const Inputs&, std::unique_ptr<const SavedState>& saved);
Gradients render_backward(const Inputs&, const RenderOutput& outputs, const RenderOutput& gradients, const SavedState&, GradientRequest);

// ---- tensors as plain memory, for backends ----

// Returns the address of a tensor's elements; null if it is undefined.
template <class Number>
Number* data(const Tensor& t) {
  return t.defined() ? t.data_ptr<std::remove_const_t<Number>>() : nullptr;
}

template <class T>
raster::Arguments<T> arguments_of(const Inputs& in) {
  const auto& [means, scales, quaternions, opacities, sh] = in.gaussians;
  return {{data<T>(means), data<T>(scales), data<T>(quaternions), data<T>(opacities), data<T>(sh), in.count(), int(sh.size(2))},
          data<T>(in.w2c), data<T>(in.intrinsics), in.scenes(), in.cameras(), int(in.width), int(in.height), in.projection};
}

template <class Pixel>
raster::RenderOutput<Pixel> pictures_of(const RenderOutput& p) {
  return {data<Pixel>(p.rgb), data<Pixel>(p.alpha), data<Pixel>(p.depth)};
}

template <class T>
raster::GaussianGradients<T> gradients_of(const Gradients& of) {
  const auto& [means, scales, quaternions, opacities, sh] = of.gaussians;
  return {data<T>(means), data<T>(scales), data<T>(quaternions), data<T>(opacities), data<T>(sh), data<T>(of.means2d)};
}

}  // namespace globalsplat
