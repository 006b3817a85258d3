// Interface of a backend, which implements the splat ops for one kind of device. splat.cpp does what is common to all backends: it checks
// the arguments, moves them, and integrates the ops with autograd.
#pragma once

#include <ATen/core/Tensor.h>

#include <memory>

namespace globalsplat {

using at::Tensor;

// Gaussians of all scenes, or their gradients; shapes as in arguments.h.
struct Gaussians {
  Tensor means, scales, quaternions, opacities, sh;
};

// Inputs of an op: on the backend's device, contiguous, all float32 or all float64; shapes as in arguments.h.
struct Inputs {
  Gaussians gaussians;
  Tensor w2c, intrinsics;
  int64_t width, height;  // pixels
  double eps2d;           // pixels²
  bool antialiased;       // as in SplatArguments

  int64_t scenes() const { return w2c.size(0); }
  int64_t cameras() const { return w2c.size(1); }  // per scene
  int64_t count() const { return gaussians.means.size(1); }  // Gaussians per scene
};

// Results of a backward pass.
struct Gradients {
  Gaussians gaussians;
  Tensor w2c;  // [B, C, 4, 4] with last rows 0; undefined if not requested
};

// Outputs of splat(), or their gradients: [B, C, 3, H, W], [B, C, H, W], [B, C, H, W].
struct RenderOutput {
  Tensor rgb, alpha, depth;
};

// Outputs of project(), or their gradients, except that `visible` has none; shapes as in splat.h.
struct Projected {
  Tensor visible, mean2d, conic, depth, colour;
};

// State other than tensors that a backend's splat() passes to its splat_backward().
struct SavedState {
  virtual ~SavedState() = default;
};

// Functions of a backend. New tensors have the device and the type of the inputs. Incoming gradients are contiguous. Backward functions
// return gradients of all five Gaussian tensors, and of w2c if `of_cameras` is set.
struct Backend {
  at::DeviceType device;
  RenderOutput (*splat)(const Inputs&, std::unique_ptr<const SavedState>& saved);
  Gradients (*splat_backward)(const Inputs&, const RenderOutput& outputs, const RenderOutput& gradients, const SavedState&, bool of_cameras);
  Projected (*project)(const Inputs&);
  Gradients (*project_backward)(const Inputs&, const Projected& gradients, bool of_cameras);
};

}  // namespace globalsplat
