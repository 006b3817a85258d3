// Arguments of the splat ops, and the interface of a backend, which implements them for one kind of device. splat.cpp does what is common to
// all backends: it checks the arguments, moves them, and integrates the ops with autograd.
#pragma once

#include <ATen/core/Tensor.h>

#include <memory>

#include "kernels/types.h"

namespace globalsplat {

using at::Tensor;

// Gaussians of all scenes, or their gradients; shapes as in Arguments.
struct Gaussians {
  Tensor means, scales, quaternions, opacities, sh;
};

// Inputs of an op: on the backend's device, contiguous, all float32 or all float64; shapes as in Arguments.
struct Inputs {
  Gaussians gaussians;
  Tensor w2c, intrinsics;
  int64_t width, height;  // pixels
  raster::ProjectionSettings projection;

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

// Outputs of project(), or their gradients, except that `visible`, `opacity` and `variance` have none; shapes as in splat.h.
// `opacity`, [B, C, N], is that of the splat, which antialiasing reduces, and `variance`, [B, C, N, 2], the diagonal of its covariance.
struct Projected {
  Tensor visible, mean2d, conic, depth, color, opacity, variance;
};

// State other than tensors that a backend's splat() passes to its splat_backward().
struct SavedState {
  virtual ~SavedState() = default;
};

struct SplatArguments;  // shared with Rust, see src/render.rs

// Gaussians and cameras of one call, borrowed:
//   means [B, N, 3], scales [B, N, 3], quaternions [B, N, 4], opacities [B, N], sh [B, N, bases, 3]
//   w2c [B, C, 4, 4], intrinsics [B, C, 3, 3] in pixels
struct Arguments {
  const Tensor &means, &scales, &quaternions, &opacities, &sh, &w2c, &intrinsics;
  int64_t width, height;
  raster::ProjectionSettings projection;

  // Throws if shapes or values are invalid.
  void check() const;

  // Returns contiguous inputs on `device`, all of one type: float64 if the means are, and float32 otherwise. Moving and converting are
  // differentiable, so gradients return to the caller's device and type. Intrinsics get no gradient.
  Inputs to_inputs(at::Device device) const;
};

Arguments borrowed(const SplatArguments& of);

// Functions of a backend. New tensors have the device and the type of the inputs. Incoming gradients are contiguous. Backward functions
// return gradients of all five Gaussian tensors, and those that are requested. Only splat_backward() computes `means2d`.
struct Backend {
  at::DeviceType device;
  RenderOutput (*splat)(const Inputs&, std::unique_ptr<const SavedState>& saved);
  Gradients (*splat_backward)(const Inputs&, const RenderOutput& outputs, const RenderOutput& gradients, const SavedState&, GradientRequest);
  Projected (*project)(const Inputs&);
  Gradients (*project_backward)(const Inputs&, const Projected& gradients, GradientRequest);
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

// Returns the device on which that backend computes: that of the means, unless the backend is for another kind of device.
at::Device backend_device(const Tensor& means);

}  // namespace globalsplat
